"""Losses, callbacks and data of the user's by class_path and init_args, and the round trip through a run's
config.yaml."""

import json
import sys

import pytest
import yaml

from p2gs.config.run import load_config, save_config
from p2gs.types import UserError

CLASSES = """
from p2gs.callbacks.base import Callback
from p2gs.data.base import TwoStateData
from p2gs.losses.base import Loss

class Even(Loss):
    "Not registered, not a dataclass."
    needs = set()
    power: float = 2.0

class Count(Callback):
    changes_result = False
    every: int = 3

class Folder(TwoStateData):
    def __init__(self, root: str, views: int = 4):
        super().__init__(root)
        self.views = views

class Stranger:
    pass
"""


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A working directory with own_classes.py; nothing of it stays in the registries."""
    from p2gs.callbacks.base import CALLBACKS
    from p2gs.config.run import import_builtins
    from p2gs.data.base import DATASETS
    from p2gs.losses.base import LOSSES

    import_builtins()
    for registry in (LOSSES, CALLBACKS, DATASETS):
        monkeypatch.setattr(registry, "_items", dict(registry.items()))
        monkeypatch.setattr(registry, "paths", {})
    (tmp_path / "own_classes.py").write_text(CLASSES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("own_classes", None)


def load(text: str, *words: str):
    with open("own.yaml", "w") as file:
        file.write(text)
    return load_config(["preset/smoke.yaml", "own.yaml"], words)


OWN = """
data: {class_path: own_classes.Folder, init_args: {root: somewhere, views: 7}}
phases:
  sharpen:
    losses: {even: {class_path: own_classes.Even, init_args: {power: 3}}}
callbacks: {count: {class_path: own_classes.Count, init_args: {every: 5}}}
"""


def test_they_are_sections_like_any_other(desk):
    cfg = load(OWN, "--phases.sharpen.losses.even.weight", "0.5", "--data.views", "9")
    loss, callback = cfg.phases["sharpen"].losses["even"], cfg.phases["sharpen"].callbacks["count"]
    assert (type(loss).__name__, loss.power, loss.weight) == ("Even", 3.0, 0.5)
    assert callback.every == 5 and cfg.data.views == 9 and cfg.data.root == "somewhere"
    assert "even" not in cfg.phases["articulation"].losses
    off = load(OWN, "--phases.sharpen.losses.even", "null")
    assert "even" not in off.phases["sharpen"].losses


def test_a_runs_config_is_read_back(desk, monkeypatch):
    from p2gs.losses.base import LOSSES

    cfg = load(OWN)
    save_config(cfg, desk / "config.yaml")
    saved = yaml.safe_load((desk / "config.yaml").read_text())
    assert saved["phases"]["sharpen"]["losses"]["even"]["class_path"] == "own_classes.Even"
    assert saved["data"]["format"] == "own_classes.Folder" and saved["callbacks"]["count"]["init_args"] == {"every": 5}
    for name in ("even",):  # as in a new process
        LOSSES._items.pop(name), LOSSES.paths.pop(name)
    again = load_config([str(desk / "config.yaml")])
    assert again.phases["sharpen"].losses["even"].power == 3.0
    assert json.dumps(again.to_dict(), default=str) == json.dumps(cfg.to_dict(), default=str)


@pytest.mark.parametrize(
    "text, message",
    [
        (
            "phases: {sharpen: {losses: {even: {class_path: own_classes.Odd}}}}",
            "class_path 'own_classes.Odd' cannot be imported",
        ),
        ("phases: {sharpen: {losses: {even: {class_path: nothere.Even}}}}", "No module named 'nothere'"),
        ("phases: {sharpen: {losses: {even: {class_path: own_classes.Stranger}}}}", "is no p2gs.losses.base.Loss"),
        (
            "phases: {sharpen: {losses: {render: {class_path: own_classes.Even}}}}",
            "'render' is the name of a loss already",
        ),
        ("phases: {sharpen: {losses: {even: {class_path: own_classes.Even, init_args: {powr: 1}}}}}", "did you mean"),
        (
            "phases: {sharpen: {losses: {even: {class_path: own_classes.Even, init_args: 3}}}}",
            "init_args: {NAME: VALUE}",
        ),
        ("callbacks: {count: {class_path: lightning.pytorch.callbacks.Timer}}", "is no p2gs.callbacks.base.Callback"),
        ("data: {class_path: own_classes.Even}", "is no p2gs.data.base.TwoStateData"),
        ("data: {format: own_classes.Foldr, root: x}", "cannot be imported"),
    ],
)
def test_mistakes_are_one_sentence(desk, text, message):
    with pytest.raises(UserError) as told:
        load(text)
    assert message in str(told.value) and "\n" not in str(told.value)
    assert "own.yaml" in str(told.value)
