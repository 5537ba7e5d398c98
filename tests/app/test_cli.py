"""The three spellings of the command, lightning-sdk's share of the name, help without torch, errors of one line."""

import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import SimpleNamespace

import pytest

from p2gs import app, cli


def spellings():
    scripts = Path(sys.executable).parent
    return [[str(scripts / "p2gs")], [str(scripts / "lightning")], [sys.executable, "-m", "p2gs"]]


def call(command, *words, **kwargs):
    if not Path(command[0]).exists():
        pytest.skip(f"{command[0]} is not installed (make setup)")
    return subprocess.run([*command, *words], capture_output=True, text=True, timeout=120, **kwargs)


def test_both_scripts_are_declared():
    try:
        points = {p.name: p.value for p in distribution("p2gs").entry_points if p.group == "console_scripts"}
    except PackageNotFoundError:
        pytest.skip("p2gs is not installed (make setup)")
    assert points == {"p2gs": "p2gs.cli:main", "lightning": "p2gs.cli:lightning_main"}


@pytest.mark.parametrize("command", spellings(), ids=["p2gs", "lightning", "python -m p2gs"])
def test_every_spelling_answers(command):
    done = call(command, "fit", "--help")
    assert done.returncode == 0 and "--print_config" in done.stdout and done.stderr == ""
    wrong = call(command, "fit", "-c", "nowhere.yaml")
    assert wrong.returncode == 2 and wrong.stdout == ""
    assert wrong.stderr.startswith("error: config file 'nowhere.yaml' is not there") and wrong.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "words", [["--help"], ["version"], ["fit", "--help"], ["data", "check", "--help"], ["fitt"], []]
)
def test_help_and_typos_do_not_wait_for_torch(words):
    code = f"""
import sys
from p2gs.cli import main
code = main({words!r})
loaded = {{"torch", "lightning", "numpy", "yaml", "jsonargparse", "rich"}} & set(sys.modules)
assert not loaded, loaded
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def one_line_error(capsys, *words) -> str:
    assert cli.main(list(words)) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    return err


def test_mistakes_get_one_line(capsys, tmp_path):
    assert "invalid choice: 'fitt'" in one_line_error(capsys, "fitt")
    assert "did you mean '--times'" in one_line_error(capsys, "predict", str(tmp_path), "--time", "3")
    assert "no such result folder" in one_line_error(capsys, "predict", str(tmp_path / "no"))
    assert "it is no result folder" in one_line_error(capsys, "test", str(tmp_path))
    assert "expected one argument" in one_line_error(capsys, "fit", "--only")
    assert "not allowed with" in one_line_error(capsys, "fit", "--num_parts", "3", "--movable", "2")
    (tmp_path / "config.yaml").write_text("seed: 0")
    assert "has not finished" in one_line_error(capsys, "export", str(tmp_path))


def test_lightning_words_that_are_not_ours_go_to_lightning_sdk(monkeypatch):
    seen = []
    monkeypatch.setattr(
        cli, "_sdk_entry_point", lambda: SimpleNamespace(load=lambda: lambda: seen.append(list(sys.argv)) or 7)
    )
    monkeypatch.setattr(sys, "argv", ["lightning"])
    assert cli.lightning_main(["studio", "list"]) == 7
    assert seen == [["lightning", "studio", "list"]]


def test_lightning_words_that_are_nobodys(monkeypatch, capsys):
    monkeypatch.setattr(cli, "_sdk_entry_point", lambda: None)
    assert cli.lightning_main(["studio", "list"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: 'studio' is no command of p2gs") and "lightning-sdk" in err and err.count("\n") == 1


def test_the_sdk_entry_point_is_found_by_name(monkeypatch):
    from importlib import metadata

    points = [
        SimpleNamespace(group="console_scripts", name="sandbox"),
        SimpleNamespace(group="console_scripts", name="lightning-sdk"),
    ]

    def fake(name):
        if name != "lightning-sdk":
            raise PackageNotFoundError(name)
        return SimpleNamespace(entry_points=points)

    monkeypatch.setattr(metadata, "distribution", fake)
    assert cli._sdk_entry_point() is points[1]


@pytest.mark.parametrize("raised", [KeyboardInterrupt(), SystemExit(1)])
def test_an_interrupt_says_how_to_go_on(monkeypatch, capsys, raised):
    def work(args, rest):
        if isinstance(raised, SystemExit):  # what Lightning's Trainer makes of Ctrl-C
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt:
                raise raised  # noqa: B904
        raise raised

    monkeypatch.setattr(app, "_carry_out", work)
    assert app.run(["fit"]) == 130
    assert "same command again" in capsys.readouterr().err


def test_an_error_of_ours_is_no_user_mistake(monkeypatch):
    def work(args, rest):
        raise RuntimeError("a defect")

    monkeypatch.setattr(app, "_carry_out", work)
    with pytest.raises(RuntimeError):
        app.run(["fit"])
