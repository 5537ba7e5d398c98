"""p2gs table: means and spreads, F, floors, best, footnotes, tests, in every layout and format."""

import csv
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats as scipy_stats

from p2gs.bench import plots
from p2gs.bench.published import paper_table, table_names
from p2gs.bench.report import write_tables
from p2gs.bench.stats import Sample, printed, sample, welch
from p2gs.types import UserError


def scores(ang=0.05, kinds=("revolute", "prismatic"), failures=0, cd=0.9, **more):
    """A metrics.json as p2gs test writes it."""
    joints = [{"gt": i, "type": k, "pred": i, "pred_type": k, "errors": None} for i, k in enumerate(kinds)]
    means = {"axis_angle_mean": ang, "pos_mean_artgs": 0.02, "pos_mean_revolute": 0.04, "motion_mean": 0.03}
    surfaces = {name: {"value": cd, "floor": 0.21} for name in ("static", "movable", "whole")}
    return {
        "joints": {"joints": joints, "failures": failures, "extra": [], **means},
        "chamfer": {**surfaces, "parts": [cd] * len(kinds), "failures": failures},
        "views": {"mean": {"psnr_white": 31.0, "ssim_white": 0.96}},
        "penetration": {"mean": 0.01, "max": 0.1},
        **more,
    }


@pytest.fixture(autouse=True)
def drawn(monkeypatch, request):
    """What would have been plotted: matplotlib takes a second a picture. The test of the plots draws."""
    asked = []
    if "plots_are_drawn" not in request.node.name:
        monkeypatch.setattr(plots, "plot", lambda path, grids: asked.append(grids) or False)
    return asked


@pytest.fixture
def bench(tmp_path):
    """``bench(tables, {(setting, object id, column, parts): [metrics of each seed, or an error's text]})`` -> the
    folder."""

    def make(tables, runs):
        cells, scenes = [], {}
        for (setting, object, column, parts), results in runs.items():
            scenes[object] = {"name": object, "column": column, "parts": parts}
            for seed, result in enumerate(results):
                where = Path("runs") / setting / object / f"seed{seed}"
                folder = tmp_path / where
                (folder / "logs").mkdir(parents=True)
                if isinstance(result, str):
                    (folder / "cell.json").write_text(json.dumps({"status": "failed", "error": result}))
                else:
                    (folder / "cell.json").write_text(json.dumps({"status": "done"}))
                    (folder / "metrics.json").write_text(json.dumps(result))
                    (folder / "logs" / "stages.json").write_text(json.dumps({"a": {"seconds": 90.0}}))
                cells.append({"object": object, "setting": setting, "seed": seed, "run": str(where)})
        about = {
            "name": "b",
            "tables": tables,
            "scenes": list(scenes.values()),
            "cells": cells,
            "p2gs": {"version": "1"},
        }
        (tmp_path / "cells.json").write_text(json.dumps(about))
        return tmp_path

    return make


def table_of(text: str) -> dict[tuple[str, ...], dict[str, str]]:
    """The first Markdown table of a text: row labels -> column -> cell, first labels filled in."""
    lines = [line for line in text.split("\n\n")[1].splitlines() if line.startswith("|")]
    rows = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    heads, columns = rows[1].count("---"), rows[0]
    out, first = {}, ""
    for row in rows[2:]:
        first = row[0] or first
        labels = (first, *row[1:heads])
        out[tuple(label.strip("*") for label in labels)] = dict(zip(columns[heads:], row[heads:], strict=True))
    return out


def read(folder, name="main_result"):
    write_tables(folder)
    return (folder / "tables" / f"{name}.md").read_text()


def test_mean_spread_best_floor_and_dashes_beside_the_published_rows(bench):
    blade = [scores(a, ("prismatic",)) for a in (0.03, 0.05)]
    folder = bench(
        ["main_result"],
        {("full", "fold", "Foldchair", 2): [scores(0.002, ("revolute",))], ("full", "blade", "Blade", 2): blade},
    )
    rows = table_of(read(folder))
    assert (
        rows["Ang Err", "p2gs"]["Foldchair"] == "**0.00**" and rows["Ang Err", "Part2GS"]["Foldchair"] == "0.01 ± 0.00"
    )
    assert (
        rows["Ang Err", "p2gs"]["Blade"] == "0.04 ± 0.01" and rows["Ang Err", "Part2GS"]["Blade"] == "**0.01 ± 0.00**"
    )
    assert (
        rows["Pos Err", "p2gs"]["Blade"] == "-"
        and rows["Pos Err", "Ditto"]["Blade"] == "-"
        and rows["Motion Err", "Ditto"]["Blade"] == "F"
    )
    assert rows["CD whole", "sampling floor"]["Blade"] == "*0.21*" and rows["Ang Err", "p2gs"]["Oven"] == ""
    assert list(rows["Ang Err", "p2gs"]) == paper_table("main_result").objects


def test_joints_that_were_not_found_are_counted_and_do_not_compete(bench):
    runs = [scores(0.001, failures=1), scores(0.001), "the sky fell"]
    lost = scores(None, failures=2, cd=None)
    lost["joints"] |= {"pos_mean_artgs": None, "motion_mean": None}
    folder = bench(
        ["complex_main_result"],
        {("full", "f", "Fridge (3 parts)", 3): runs, ("full", "s", "Storage (3 parts)", 3): [lost, lost]},
    )
    text = read(folder, "complex_main_result")
    rows = table_of(text)
    assert rows["Ang Err", "p2gs"]["Fridge (3 parts)"] == "0.00 ± 0.00 F 3/6"  # one, and both of the run that failed
    assert rows["Ang Err", "Part2GS"]["Fridge (3 parts)"] == "**0.01**"
    assert rows["Ang Err", "p2gs"]["Storage (3 parts)"] == rows["CD movable", "p2gs"]["Storage (3 parts)"] == "F 4/4"
    page = (folder / "tables" / "index.md").read_text()
    assert "- f full seed 2: the sky fell" in page and "5 runs (4 done, 1 failed), seeds 0, 1, 2" in page
    with open(folder / "tables" / "runs.csv") as file:
        assert [(r["status"], r["joints_lost"], r["joints"]) for r in csv.DictReader(file)][:3] == [
            ("done", "1", "2"),
            ("done", "0", "2"),
            ("failed", "2", "2"),
        ]


def test_settings_stand_below_the_row_of_the_paper_that_they_are(bench):
    runs = {(s, "t", "Table (5 parts)", 5): [scores(a)] for s, a in (("full", 0.02), ("no_part", 0.4))}
    rows = table_of(read(bench(["main_ablation"], runs), "main_ablation"))
    labels = [label for object, label in rows if object == "Table (5 parts)"]
    assert labels[:2] == ["- part parameters", "- part parameters (p2gs)"] and labels[-3:] == [
        "Part2GS (all)",
        "Part2GS (all) (p2gs)",
        "sampling floor",
    ]
    assert rows["Table (5 parts)", "- part parameters (p2gs)"]["Ang Err"] == "0.40"
    assert rows["Table (5 parts)", "Part2GS (all) (p2gs)"]["Ang Err"] == "**0.02**"
    assert "0.55<sup>" in rows["Storage (7 parts)", "Part2GS (all)"]["Motion Err"]


def test_objects_of_ones_own_get_a_table_of_their_own(bench):
    runs = {(s, "mine", "mine", 3): [scores(a), scores(a + 0.02)] for s, a in (("full", 0.02), ("vanilla", 0.4))}
    text = read(bench(["main_ablation_v2"], runs), "main_ablation_v2")
    rows = table_of(text)
    assert set(rows) == {("mine", "Vanilla"), ("mine", "+ physical constraints"), ("mine", "sampling floor")}
    assert rows["mine", "+ physical constraints"]["Ang Err"] == "**0.03 ± 0.01**"
    assert "as published" in text and "17.32" in text


@pytest.mark.parametrize("name", table_names())
def test_every_table_fills_in_every_format(bench, name, drawn):
    table = paper_table(name)
    columns = [o for o in table.objects if o != "average"] or ["Blade", "Oven"]
    runs = {(s, c, c, 3): [scores(0.05), scores(0.06)] for c in columns for s in table.ours}
    folder = bench([name], runs)
    files = write_tables(folder)
    tables = folder / "tables"
    assert {p.name for p in files} == {"index.md", "runs.csv", "tests.csv"} | {
        f"{n}{s}" for n in ("summary", name) for s in (".md", ".tex", ".csv")
    }
    with open(tables / f"{name}.csv") as file:
        lines = list(csv.DictReader(file))
    published = [line for line in lines if line["source"] == "paper"]
    assert len(published) == len(table.numbers)
    assert sorted(float(line["mean"]) for line in published if line["mean"]) == sorted(
        p.value for p in table.numbers.values() if p.value is not None
    )
    assert any(line["source"] == "ours" and line["mean"] for line in lines)
    tex = (tables / f"{name}.tex").read_text()
    plain = tex.replace("% made by", "").replace("{!}{%", "")
    assert tex.count("\\begin{tabular}") == tex.count("\\end{tabular}") and not re.search(
        r"(?<!\\)[%#_](?!{)", re.sub(r"label{.*?}", "", plain)
    )
    widths = {len(re.split(r"(?<!\\)&", line)) for line in tex.splitlines() if line.endswith("\\\\")}
    assert len(widths) == 1
    assert "No plots: matplotlib is not installed." in (tables / "index.md").read_text()
    assert all(plots.series(grid, m) for grids in drawn[1:] for grid in grids for m in table.metrics if m != "lpips")


def test_plots_are_drawn(bench):
    pytest.importorskip("matplotlib")
    import cv2

    folder = bench(
        ["main_ablation"],
        {(s, "t", "Table (5 parts)", 5): [scores(a), scores(2 * a)] for s, a in (("full", 0.02), ("no_part", 0.4))},
    )
    files = write_tables(folder)
    picture = cv2.imread(str(next(p for p in files if p.name == "main_ablation.png")))
    assert picture.shape[0] > 500 and picture.std() > 20
    assert "![main_ablation](main_ablation.png)" in (folder / "tables" / "index.md").read_text()


def test_mistakes_are_told(bench, tmp_path):
    with pytest.raises(UserError, match="no result folder of p2gs bench"):
        write_tables(tmp_path)
    folder = bench([], {("full", "x", "x", 2): [scores()]})
    with pytest.raises(
        UserError, match="beta_ablation: its rows are the settings beta_uniform, .* this bench has full"
    ):
        write_tables(folder, ["beta_ablation"])
    assert (folder / "tables").exists() is False


# -- statistics -------------------------------------------------------------------------------------------------------


def test_welch_agrees_with_scipy():
    rng = np.random.default_rng(0)
    for n, m in ((2, 3), (3, 3), (5, 9)):
        a, b = rng.normal(0, 1, n), rng.normal(0.5, 3, m)
        expected = scipy_stats.ttest_ind(a, b, equal_var=False)
        found = welch(sample(list(a)), sample(list(b)))
        assert (
            found.t == pytest.approx(expected.statistic)
            and found.p == pytest.approx(expected.pvalue)
            and found.degrees == pytest.approx(expected.df)
        )


def test_spreads_of_nothing():
    assert sample([]) is None and welch(Sample(1, None, 1), Sample(1, 0.1, 3)) is None
    assert printed(0.01, 0.0).std == 0.005 and printed(0.01, 0.3).std == 0.3
    same = welch(Sample(1.0, 0.0, 3), Sample(1.0, 0.0, 3))
    assert same.p == 1.0 and same.verdict(False) == "no difference" and math.isfinite(same.t)
    sure = welch(Sample(1.0, 0.0, 3), Sample(2.0, 0.0, 3))
    assert sure.verdict(False) == "better" and sure.verdict(True) == "worse"


def test_ours_against_each_published_method_and_each_setting_against_the_reference(bench):
    runs = [scores(a, ("revolute",), cd=1.0) for a in (0.049, 0.05, 0.051)]
    folder = bench(["main_result"], {("full", "u", "USB", 2): runs})
    write_tables(folder)
    with open(folder / "tables" / "tests.csv") as file:
        tests = {(t["b"], t["metric"]): t for t in csv.DictReader(file)}
    assert {b for b, _ in tests} == {"DTA", "ArtGS", "Part2GS"}  # Ditto and PARIS print no spread
    assert tests["Part2GS", "ang"]["verdict"] == "worse" and tests["DTA", "ang"]["verdict"] == "better"
    assert tests["ArtGS", "ang"]["verdict"] == "no difference"  # 0.05 against 0.04 +- 0.00, which may be 0.045
    assert "| main_result | p2gs full | ArtGS |" in (folder / "tables" / "index.md").read_text()


def test_a_setting_that_loses_joints_is_not_tested(bench):
    good, bad = [scores(0.05), scores(0.06)], [scores(0.01), scores(0.01, failures=1)]
    folder = bench(
        ["main_ablation"],
        {
            ("full", "x", "x", 3): good,
            ("no_part", "x", "x", 3): bad,
            ("no_phys", "x", "x", 3): [scores(0.9), scores(0.91)],
        },
    )
    write_tables(folder)
    with open(folder / "tables" / "tests.csv") as file:
        tests = {(t["a"], t["metric"]): t["verdict"] for t in csv.DictReader(file)}
    assert (
        tests["p2gs no_phys", "ang"] == "worse"
        and ("p2gs no_part", "ang") not in tests
        and ("p2gs no_part", "cd_whole") in tests
    )
