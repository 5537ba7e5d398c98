"""The paper's numbers as data, a few checked by hand against the paper, and the contradictions that the footnotes
tell."""

import statistics

import pytest

from p2gs.bench.published import METRICS, footnotes, paper_table, table_names
from p2gs.types import UserError

COUNTS = {
    "main_result": 360,
    "complex_main_result": 126,
    "main_ablation_v2": 48,
    "main_ablation": 60,
    "pc_ablation": 48,
    "beta_ablation": 36,
    "k_ablation": 90,
    "k_sensitivity": 72,
    "repel_num_ablation": 12,
    "repel_noise_robustness": 96,
    "fixed_dynamic_repel_per_object": 96,
    "repel_exponent_ablation": 9,
    "trans_rotate": 48,
    "inferenceT": 51,
    "photometric_eval": 36,
}
# read off the paper by eye: table, row, object, metric, value, spread
BY_HAND = [
    ("main_result", "Ditto", "Foldchair", "ang", 89.35, None),
    ("main_result", "PARIS", "Washer", "cd_movable", 379.40, None),
    ("main_result", "DTA", "Scissor", "cd_static", 3.55, 6.10),
    ("main_result", "ArtGS", "Real-Storage", "cd_movable", 6.28, 3.60),
    ("main_result", "Part2GS", "Real-Fridge", "pos", 0.13, 0.00),
    ("main_result", "Part2GS", "Storage", "cd_whole", 2.87, 0.01),
    ("complex_main_result", "DTA", "Storage (7 parts)", "cd_movable", 476.91, None),
    ("complex_main_result", "ArtGS", "Table (4 parts)", "ang", 1.16, None),
    ("complex_main_result", "Part2GS", "Oven (4 parts)", "motion", 0.18, None),
    ("main_ablation_v2", "+ part parameters", "Storage (7 parts)", "cd_movable", 15.68, None),
    ("main_ablation", "- canonical init", "Storage (7 parts)", "ang", 22.15, None),
    ("main_ablation", "- repel points", "Table (5 parts)", "pos", 0.16, None),
    ("pc_ablation", "+ contact loss", "Table (5 parts)", "cd_movable", 1.78, None),
    ("beta_ablation", "Motion-Aware Per-Part beta", "Storage (7 parts)", "motion", 0.52, None),
    ("beta_ablation", "Uniform Interpolation", "Table (5 parts)", "cd_whole", 1.20, None),
    ("k_ablation", "K = 2", "Table (4 parts)", "cd_static", 14.80, None),
    ("k_ablation", "K = 6", "Oven (4 parts)", "cd_whole", 1.99, None),
    ("k_sensitivity", "K_GT + 4", "Oven (4 parts)", "motion", 0.22, None),
    ("repel_num_ablation", "N_R = 4000", "Storage (7 parts)", "motion", 0.58, None),
    ("repel_noise_robustness", "sigma 0.05", "Stapler", "cd_whole", 1.51, None),
    ("fixed_dynamic_repel_per_object", "Noisy + Dynamic", "Stapler", "cd_whole", 1.43, None),
    ("repel_exponent_ablation", "p = 4", "average", "penetration", 0.012, None),
    ("trans_rotate", "Translation", "average", "cd_movable", 0.68, None),
    ("inferenceT", "DTA", "Storage (7 parts)", "minutes", 45, None),
    ("photometric_eval", "Part2GS", "Blade", "psnr", 32.9, None),
    ("photometric_eval", "ArtGS", "Storage (7 parts)", "lpips", 0.072, None),
]


def value(table, row, object, metric):
    return paper_table(table).numbers[row, object, metric].value


def test_all_rows_of_all_tables_are_there():
    assert {name: len(paper_table(name).numbers) for name in table_names()} == COUNTS
    for name in table_names():
        table = paper_table(name)
        assert set(table.metrics) <= set(METRICS)
        assert {row for row in table.ours.values() if row} <= set(table.rows), name
        if table.layout != "groups":
            assert len(table.numbers) == len(table.rows) * len(table.objects) * len(table.metrics), name


@pytest.mark.parametrize("number", BY_HAND)
def test_numbers_as_they_are_printed(number):
    table, row, object, metric, mean, std = number
    found = paper_table(table).numbers[row, object, metric]
    assert (found.value, found.std) == (mean, std)


def test_dashes_and_failures():
    table = paper_table("tab:main_result")
    assert {k[:2] for k, p in table.numbers.items() if p.text == "F"} == {("Ditto", "Fridge"), ("Ditto", "Blade")}
    dashes = {k[1] for k, p in table.numbers.items() if p.text == "-"}
    assert dashes == {"Blade", "Storage", "Real-Storage"}
    with pytest.raises(UserError, match="no table 'main_results' \\(did you mean 'main_result'"):
        paper_table("main_results")


def test_the_marked_numbers_are_the_best_but_where_a_footnote_says_otherwise():
    for name in (
        "main_result",
        "complex_main_result",
        "main_ablation_v2",
        "beta_ablation",
        "k_sensitivity",
        "photometric_eval",
    ):
        table = paper_table(name)
        for p in table.numbers.values():
            if p.marked != "best" or p.value is None:
                continue
            column = [table.numbers[row, p.object, p.metric].value for row in table.rows]
            best = (max if METRICS[p.metric].higher_is_better else min)(v for v in column if v is not None)
            if p.value != best:
                assert any(n.applies(name, p.row, p.object, p.metric) for n in footnotes()), (name, p)


def test_the_contradictions_are_real():
    """Each footnote's claim, recomputed from the data."""
    main, multi = paper_table("main_result"), paper_table("complex_main_result")
    for object in ("Blade", "Storage", "Laptop"):
        for metric in ("cd_static", "cd_movable", "cd_whole"):
            group = "Rotation" if object == "Laptop" else "Translation"
            assert value("main_result", "Part2GS", object, metric) != value("trans_rotate", group, object, metric)
    for metric in ("cd_static", "cd_movable", "cd_whole"):
        table4 = value("complex_main_result", "Part2GS", "Table (4 parts)", metric)
        assert value("trans_rotate", "Translation", "Table (5 parts)", metric) == table4
        full = value("main_ablation", "Part2GS (all)", "Storage (7 parts)", metric)
        assert value("pc_ablation", "+ vector-field alignment", "Storage (7 parts)", metric) != full
    assert value("repel_noise_robustness", "sigma 0.00", "Table (5 parts)", "ang") == 0.30
    assert value("k_sensitivity", "K_GT", "Table (5 parts)", "ang") == 0.03
    assert value("complex_main_result", "Part2GS", "Table (5 parts)", "ang") == 0.03
    without, full = (
        value("main_ablation", row, "Storage (7 parts)", "motion")
        for row in ("- physical constraints", "Part2GS (all)")
    )
    assert without < full
    ours = [p for t in (main, multi) for p in t.numbers.values() if p.row == "Part2GS"]
    assert statistics.mean(p.value for p in ours if p.metric == "cd_whole") == pytest.approx(1.13, abs=0.005)
    assert statistics.mean(p.value for p in ours if p.metric == "motion") == pytest.approx(0.084, abs=0.0005)
    simple = main.objects[:10]
    minutes = {o: [value("inferenceT", row, o, "minutes") for row in ("DTA", "ArtGS", "Part2GS")] for o in simple}
    assert sum(times[2] == min(times) for times in minutes.values()) == 6


def test_every_footnote_stands_somewhere():
    for note in footnotes():
        places = [(n, *key) for n in table_names() for key in paper_table(n).numbers if note.applies(n, *key)]
        assert places, note.text
        for at in note.at:
            assert set(at) <= {"table", "row", "object", "metric"}
