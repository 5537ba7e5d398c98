"""A tree of scenes that are scenes in name only, and a program that answers to fit, export and test in no time."""

import json
import sys
from pathlib import Path

import pytest

FAKE = Path(__file__).parent / "fake_p2gs.py"


@pytest.fixture
def program(monkeypatch, tmp_path):
    """The words in place of ``python -m p2gs``; what it was asked for is in ``calls()``."""
    log = tmp_path / "calls.txt"
    monkeypatch.setenv("FAKE_P2GS_LOG", str(log))
    words = (sys.executable, "-S", str(FAKE))

    class Program(tuple):
        def calls(self, command: str = "") -> list[str]:
            lines = log.read_text().splitlines() if log.exists() else []
            return [line for line in lines if line.startswith(command)]

    return Program(words)


def joint(kind: str, motion: float = 1.0) -> dict:
    return {"type": kind, "axis": {"o": [0, 0, 0], "d": [0, 0, 1]}, kind: {"l": 0.0, "r": motion}}


def _write_scene(folder: Path, joints: list[str]) -> Path:
    """A folder that looks like a scene in the ArtGS layout, with ground truth."""
    (folder / "gt").mkdir(parents=True)
    (folder / "transforms_train_start.json").write_text("{}")
    (folder / "gt" / "trans.json").write_text(json.dumps({"trans_info": [joint(kind) for kind in joints]}))
    return folder


@pytest.fixture
def write_scene():
    """``write_scene(folder, ["rotate", "translate"])``."""
    return _write_scene


@pytest.fixture
def tree(tmp_path, write_scene) -> Path:
    """Two scenes, cabinet (three parts) and laptop (two)."""
    write_scene(tmp_path / "scenes" / "cabinet", ["rotate", "translate"])
    write_scene(tmp_path / "scenes" / "laptop", ["rotate"])
    return tmp_path / "scenes"


@pytest.fixture
def bench_file(tmp_path, tree):
    """``bench_file(text)`` -> path of a bench over the tree with its results in tmp_path/out."""

    def write(text: str = "settings: {full: {}, no_repel: {config: [ablation/no_repel.yaml]}}\nseeds: [0, 1]\n") -> str:
        path = tmp_path / "bench.yaml"
        path.write_text(f"name: tiny\nout: {tmp_path / 'out'}\nroot: {tree}\n{text}")
        return str(path)

    return write
