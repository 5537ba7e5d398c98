"""What a bench file means: objects x settings x seeds as commands, and mistakes told in one sentence."""

from pathlib import Path

import pytest
import yaml

from p2gs.bench.plan import Scene, read_bench, resolve_parts
from p2gs.bench.published import paper_table, table_names
from p2gs.data.objects import benchmarks, pick_objects
from p2gs.types import UserError

CONFIGS = Path(__file__).parents[2] / "configs"
FILES = sorted(p.name for p in (CONFIGS / "bench").glob("*.yaml"))


def test_the_matrix_is_objects_times_settings_times_seeds(bench_file, tree, tmp_path):
    over = "{num_parts: gt+2, config: [ablation/no_repel.yaml], set: {phases.articulation.steps: 7}}"
    text = f"settings: {{full: {{}}, over: {over}}}\nseeds: [0, 3]\n"
    bench = read_bench([bench_file(text)], ["--phases.single_state.steps", "5"])
    expected = [(s, o, k) for s in ("full", "over") for o in ("cabinet", "laptop") for k in (0, 3)]
    assert [(c.setting, c.object, c.seed) for c in bench.cells] == expected
    last = bench.cells[-1]
    assert last.run == str(tmp_path / "out" / "runs" / "over" / "laptop" / "seed3") and last.parts == 2
    words = "-c preset/cpu.yaml -c ablation/no_repel.yaml --data.root {} --data.format artgs --seed 3 --num_parts 4"
    words += " --phases.single_state.steps 5 --phases.articulation.steps 7"
    assert " ".join(last.words) == words.format(tree / "laptop")
    assert (
        last.donors == (str(tmp_path / "out" / "runs" / "full" / "laptop" / "seed3"),) and bench.cells[0].donors == ()
    )
    assert len({c.key for c in bench.cells}) == len({c.run for c in bench.cells}) == 8
    bench.check_settings()


def test_the_key_follows_what_decides_the_result(bench_file, tmp_path):
    mine = tmp_path / "mine.yaml"
    text = f"settings: {{full: {{config: [{mine}]}}}}\nseeds: [0]\n"

    def keys(steps: int, *words: str) -> list[str]:
        mine.write_text(f"phases: {{articulation: {{steps: {steps}}}}}\n")
        return [c.key for c in read_bench([bench_file(text)], words).cells]

    assert keys(5) == keys(5) and not set(keys(5)) & set(keys(6))
    assert keys(5) == keys(5, "--processes", "2", "--executor", "ray", "--out", str(tmp_path / "elsewhere"))
    assert not set(keys(5)) & set(keys(5, "--phases.articulation.steps", "6"))


def test_parts_relative_to_the_truth():
    four = Scene("x", "x", "/x", parts=4)
    cases = {"gt": "4", "gt+2": "6", "GT - 1": "3", "gt-9": "2", 6: "6", "5": "5", "auto": "auto", None: None}
    assert {wanted: resolve_parts(wanted, four) for wanted in cases} == cases
    with pytest.raises(UserError, match="no ground truth"):
        resolve_parts("gt", Scene("x", "x", "/x"))
    with pytest.raises(UserError, match="gt or gt\\+N, got 'many'"):
        resolve_parts("many", four)


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        ("sedes: [1]", [], "no option 'sedes' \\(did you mean 'seeds'\\?\\)"),
        ("settings: {full: {konfig: [x]}}", [], "settings.full: no option 'konfig' \\(did you mean 'config'\\?\\)"),
        (
            "settings: {full: {config: [ablation/no_repell]}}",
            [],
            "'ablation/no_repell' is not there \\(did you mean 'ablation/no_repel.yaml'",
        ),
        ("settings: {a/b: {}}", [], "'a/b' names a folder"),
        ("settings: {full: 3}", [], "settings.full: expected options"),
        ("objects: [cabinett]", [], "no scene 'cabinett', and no benchmark has \\(did you mean 'cabinet'\\?\\)"),
        ("objects: [blade_103706, cabinet]", [], "lacks blade_103706 \\(p2gs data prepare"),
        ("executor: slrum", [], "one of local, slurm, ray"),
        ("processes: 0", [], "processes: expected at least 1, got 0"),
        ("", ["--root", "/nowhere"], "there is no folder /nowhere"),
    ],
)
def test_mistakes_are_told_in_one_sentence(bench_file, text, words, message):
    with pytest.raises(UserError, match=message):
        read_bench([bench_file(text + "\n")], words)


def test_a_wrong_option_of_a_run_is_told_before_anything_runs(bench_file):
    bench = read_bench([bench_file("settings: {full: {set: {phases.articulation.stepps: 3}}}\n")])
    with pytest.raises(UserError, match="settings.full: no option 'phases.articulation.stepps'"):
        bench.check_settings()


def test_a_format_of_ones_own_takes_the_folders_right_below_the_root(bench_file, tmp_path):
    for name in ("b", "a", ".hidden"):
        (tmp_path / "own" / name).mkdir(parents=True)
    (tmp_path / "own" / "notes.txt").touch()
    words = ["--root", str(tmp_path / "own"), "--format", "mine", "--seeds", "[0]"]
    cells = read_bench([bench_file("settings: {full: {}}")], words, objects=["b", "a"]).cells
    assert [c.object for c in cells] == ["b", "a"] and cells[0].parts is None
    assert f"--data.root {tmp_path / 'own' / 'b'} --data.format mine" in " ".join(cells[0].words)
    with pytest.raises(UserError, match="no folder 'c'"):
        read_bench([bench_file("settings: {full: {}}")], words, objects=["c"])


def test_objects_and_settings_can_be_chosen(bench_file):
    bench = read_bench([bench_file()], [], ["laptop"], ["no_repel"])
    assert {(c.object, c.setting) for c in bench.cells} == {("laptop", "no_repel")} and bench.cells[0].donors == ()
    with pytest.raises(UserError, match="no 'no_repl' \\(did you mean 'no_repel'"):
        read_bench([bench_file()], [], None, ["no_repl"])


@pytest.mark.parametrize("name", FILES)
def test_the_benches_that_come_with_p2gs_name_what_there_is(name):
    tree = yaml.safe_load((CONFIGS / "bench" / name).read_text())
    assert tree["name"] == Path(name).stem
    if name == "zoo.yaml":  # scene folders of the user's own, of no benchmark
        assert len(set(tree["objects"])) == len(tree["objects"]) == 48 and not tree.get("tables")
        return
    columns = {o.column for o in pick_objects(tree["objects"] or [])}
    for table in map(paper_table, tree.get("tables", [])):
        assert set(tree["settings"]) & set(table.ours), table.name
        assert columns & set(table.objects) or table.layout == "average", table.name
    for setting in tree["settings"].values():
        for config in setting.get("config", []):
            assert (CONFIGS / config).is_file(), config


def test_every_table_of_the_paper_has_a_bench_that_fills_it():
    filled: dict[str, set] = {}
    for name in FILES:
        tree = yaml.safe_load((CONFIGS / "bench" / name).read_text())
        for table in tree.get("tables", []):
            filled.setdefault(table, set()).update(tree["settings"])
    assert set(filled) == set(table_names())
    for table in table_names():
        assert set(paper_table(table).ours) <= filled[table], table


def test_every_benchmark_object_is_a_column_of_the_paper():
    lists = benchmarks()
    assert [len(lists[n]) for n in ("paris", "dta_multi", "artgs_multi")] == [12, 2, 5]
    assert [o.column for o in lists["paris"]] == paper_table("main_result").objects
    assert {o.column for o in (*lists["dta_multi"], *lists["artgs_multi"])} == set(
        paper_table("complex_main_result").objects
    )
    for o in (*lists["dta_multi"], *lists["artgs_multi"]):
        assert f"({o.parts} parts)" in o.column, o.id


def test_a_bench_takes_another_preset_and_says_which(bench_file, tmp_path):
    text = "config: [preset/cpu.yaml, preset/../base.yaml]\nsettings: {full: {}, two: {num_parts: 2}}\nseeds: [0]\n"
    plain, literal = (
        read_bench([bench_file(text)], words) for words in ((), ("--preset", "paper_literal", "--num_parts", "gt"))
    )
    assert plain.options.presets == ["cpu"] and literal.options.presets == ["paper_literal"]
    assert literal.cells[0].words[:4] == ("-c", "preset/paper_literal.yaml", "-c", "preset/../base.yaml")
    given = {c.setting: c.words[c.words.index("--num_parts") + 1] for c in literal.cells if c.object == "cabinet"}
    assert given == {"full": "3", "two": "2"} and "--num_parts" not in plain.cells[0].words
    assert literal.options.folder != plain.options.folder or plain.options.out is not None
    literal.check_settings()
