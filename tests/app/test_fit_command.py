"""``p2gs fit`` from words to the pipeline, with fake phases: flags, print_config, plugins, movable."""

import sys
from types import SimpleNamespace

import pytest
import yaml

from p2gs import cli

CONFIG = "data: {format: folder, root: scene}\nphases: {first: {losses: {render: {}}}, second: {}}"

PLUGIN = """
from p2gs.losses.base import Loss, register_loss

@register_loss("mine")
class Mine(Loss):
    k: int = 3
"""


@pytest.fixture
def pipeline(monkeypatch):
    """In place of p2gs.runtime.pipeline: notes what it is given."""
    calls = []
    module = SimpleNamespace(run=lambda cfg, only=None, keep_stale=False: calls.append((cfg, only)) or cfg.run_dir)
    monkeypatch.setitem(sys.modules, "p2gs.runtime.pipeline", module)
    monkeypatch.setattr("p2gs.runtime.pipeline", module, raising=False)
    return calls


@pytest.fixture
def config(fakes, write):
    return write("c.yaml", CONFIG)


def test_fit_runs_the_pipeline_and_names_the_result(config, pipeline, capsys):
    assert cli.main(["fit", "-c", config, "--only", "first", "--run", "out/x", "--phases.first.steps", "3"]) == 0
    (cfg, only), *_ = pipeline
    assert only == "first" and cfg.phases["first"].config.steps == 3
    assert capsys.readouterr().out == "result: out/x\n"


def test_movable_counts_without_the_base(config, pipeline, capsys):
    assert cli.main(["fit", "-c", config, "--movable", "3"]) == 0
    assert pipeline[0][0].num_parts == 4
    assert cli.main(["fit", "-c", config, "--movable", "0"]) == 2
    assert "at least 1 moving part" in capsys.readouterr().err


def test_print_config_shows_defaults_and_reads_back(config, write, pipeline, capsys):
    assert cli.main(["fit", "-c", config, "--print_config", "--phases.first.losses.part", "{}"]) == 0
    text = capsys.readouterr().out
    tree = yaml.safe_load(text)
    assert tree["phases"]["first"]["losses"]["part"] == {
        "weight": 1.0,
        "start": 0.0,
        "end": 1.0,
        "end_weight": None,
        "every": 1,
        "temperature": 1.0,
        "variant": "sane",
    }
    assert tree["phases"]["first"]["losses"]["contact"] is None and tree["phases"]["first"]["rates"]["quats"] == 2e-3
    assert tree["data"]["downscale"] == 1.0 and tree["callbacks"] == {"progress": None, "count": None}
    assert cli.main(["fit", "-c", write("again.yaml", text), "--print_config"]) == 0
    assert capsys.readouterr().out == text and not pipeline


@pytest.mark.parametrize(
    "words, message",
    [
        (["--only", "firts"], "did you mean 'first'"),
        (["--phases.first", "null", "--phases.second", "null"], "nothing to fit"),
        (["--data.format", "made", "--data.root", "x"], "no option 'data.root'"),
    ],
)
def test_mistakes_before_anything_runs(config, pipeline, capsys, words, message):
    assert cli.main(["fit", "-c", config, *words]) == 2
    out, err = capsys.readouterr()
    assert message in err and err.count("\n") == 1 and not pipeline


def test_a_plugin_by_flag_by_key_and_by_environment(fakes, pipeline, write, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    on = "phases: {first: {losses: {mine: {k: 4}}}}\ndata: {format: made}\n"
    for n, (words, text, variable) in enumerate(
        [
            (["--plugins", "own_a"], on, ""),
            ([], on + "plugins: [own_b]", ""),
            (["--plugins", "own_c.py"], on, ""),
            ([], on, "own_d"),
        ]
    ):
        from p2gs.losses.base import LOSSES

        LOSSES._items.pop("mine", None)
        monkeypatch.setenv("P2GS_PLUGINS", variable)
        write(f"own_{'abcd'[n]}.py", PLUGIN)
        assert cli.main(["fit", "-c", write("p.yaml", text), *words]) == 0, capsys.readouterr().err
        assert pipeline[-1][0].phases["first"].losses["mine"].k == 4
        if not variable:  # the saved config names it, so `p2gs test` finds it again
            assert pipeline[-1][0].to_dict()["plugins"] == [f"own_{'abcd'[n]}" + (".py" if n == 2 else "")]


def test_a_plugin_by_entry_point(fakes, pipeline, write, tmp_path, monkeypatch):
    """A distribution on the path that declares the group, as pip would install it."""
    write("third_party.py", PLUGIN)
    write("third_party-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: third_party\nVersion: 1.0\n")
    write("third_party-1.0.dist-info/entry_points.txt", "[p2gs.plugins]\nthird = third_party\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert cli.main(["fit", "-c", write("p.yaml", CONFIG), "--phases.first.losses.mine.k", "9"]) == 0
    assert pipeline[-1][0].phases["first"].losses["mine"].k == 9


def test_a_plugin_that_is_not_there(config, pipeline, capsys):
    assert cli.main(["fit", "-c", config, "--plugins", "no_such_module_anywhere"]) == 2
    err = capsys.readouterr().err
    assert "plugin 'no_such_module_anywhere' cannot be imported" in err and err.count("\n") == 1
