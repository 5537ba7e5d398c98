"""A stranger's phase, loss, callback, dataset and rasterizer, each one file of theirs, through fit, test, export,
predict and bench."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from docs_pages import blocks

from p2gs.cli import main

REPO = Path(__file__).parents[2]

LOSS = """
from p2gs.losses.base import Loss, register_loss

@register_loss("own_grey")
class Grey(Loss):
    "Colours as grey as their mean: spread over the channels."
    needs = set()
    kind = "prior"

    def compute(self, inputs):
        return inputs.render.colour.var(dim=-1).mean()
"""

DATA = """
import json
from pathlib import Path

from p2gs.data.base import DATASETS, TwoStateData
from p2gs.data.generated.synthetic import make_object, synthetic_scene

@DATASETS.register("own_recipe")
class Recipe(TwoStateData):
    "A folder with recipe.json: size and views of the demo cabinet, drawn when read."

    def read(self):
        recipe = json.loads((Path(self.root) / "recipe.json").read_text())
        return synthetic_scene(make_object("demo", 0), recipe["size"], recipe["views"], 1, 0)
"""

RASTERIZER = """
import sys
from pathlib import Path

from p2gs.native import native
from p2gs.render.base import RASTERIZERS

if native is not None:
    from p2gs.render.cpu import rasterize_cpu as draw
else:
    from p2gs.render.torch_ref import rasterize_torch as draw
drew = set()

@RASTERIZERS.register("own_noted")
def rasterize_noted(a):
    "Another one's pictures; notes for which command it drew."
    if not drew:
        drew.add(1)
        with Path(__file__).with_name("drawn.txt").open("a") as file:
            file.write(" ".join(sys.argv[1:2]) + "\\n")
    return draw(a)
"""

OWN = """
rasterizer: own_noted
plugins: [my_phases, my_losses.py, my_callbacks, my_data, my_rasterizers]
num_parts: 3
data: {depth: never}
stages: [single_state, registration, sharpen, discovery, canonical_fusion, colours, articulation, finish]
phases:
  single_state:
    {steps: 150, initial_gaussians: 1500, levels: [32, 64], level_starts: [0.0, 0.3],
     losses: {own_grey: {weight: 0.01}}, callbacks: {densify: {budget: 2000, every: 20}}}
  discovery:
    {evidence_size: 64, reconsider: false, seek: 0, rounds: 1, survey: [], coarse: {steps: 5, levels: [64]},
     search: {surfels: 1500, samples: 80, searches: 1, candidates: 1}}
  canonical_fusion: {steps: 6, levels: [64], level_starts: [0.0], canonical: {match_size: 300}}
  colours: {steps: 6, levels: [64], level_starts: [0.0], losses: {render: {}}, callbacks: {joint_log: {every: 2}}}
  articulation: {steps: 6, levels: [64], level_starts: [0.0], callbacks: {joint_log: {every: 3}}}
  finish: {polish: {steps: 8, levels: [64], level_starts: [0.0]}, together: {steps: 4}, tune: {steps: 4}}
"""

BENCH = "{name: own, format: own_recipe, root: scenes, config: [preset/smoke.yaml, own.yaml], seeds: [0], threads: 1}"


def p2gs(folder: Path, *words: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO)}
    command = [sys.executable, "-m", "p2gs", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280)


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A stranger's working directory after one bench: five files of their own, a scene, runs/bench/own."""
    folder = tmp_path_factory.mktemp("own")
    pages = {"my_phases.py": "add_phase.md", "my_callbacks.py": "add_callback.md"}  # the docs' own examples
    texts = {
        name: next(b.text for b in blocks(REPO / "docs" / page) if b.title == name) for name, page in pages.items()
    }
    texts |= {
        "my_losses.py": LOSS,
        "my_data.py": DATA,
        "my_rasterizers.py": RASTERIZER,
        "own.yaml": OWN,
        "bench.yaml": BENCH,
    }
    texts["scenes/cabinet/recipe.json"] = json.dumps({"size": 64, "views": 10})
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    done = p2gs(folder, "bench", "-c", "bench.yaml")
    log = folder / "runs/bench/own/runs/full/cabinet/seed0/bench.log"
    assert done.returncode == 0, done.stdout + done.stderr + (log.read_text() if log.is_file() else "")
    return folder


@pytest.fixture
def run(desk) -> Path:
    return desk / "runs/bench/own/runs/full/cabinet/seed0"


def test_the_fit_used_all_five(desk, run):
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["rasterizer"] == "own_noted" and config["data"]["format"] == "own_recipe"
    log = (run / "bench.log").read_text()
    assert log.index("canonical_fusion: ") < log.index("colours 6/6") < log.index("articulation 6/6")
    told = json.loads((run / "diagnostics.json").read_text())["losses"]
    assert told["single_state_0"]["own_grey"][0] > 0 and "own_grey" not in told["articulation"]
    lines = [json.loads(line) for line in (run / "joints.jsonl").read_text().splitlines()]
    assert [(line["phase"], line["step"]) for line in lines] == [("colours", s) for s in (2, 4, 6)] + [
        ("articulation", s) for s in (3, 6)
    ]
    assert (run / "metrics.json").is_file() and (run / "meshes" / "end" / "whole.ply").is_file()
    drew = (desk / "drawn.txt").read_text().split()
    assert {"fit", "export", "test"} <= set(drew)


def test_the_phase_changed_colours_alone(run):
    from p2gs.gaussians import handover

    before, after = (handover.load(run / "checkpoints" / f"{n}.pt")[0] for n in ("canonical_fusion", "colours"))
    assert not torch.equal(before.gaussians.sh[:, 0], after.gaussians.sh[:, 0])
    assert all(
        torch.equal(getattr(before.gaussians, n), getattr(after.gaussians, n)) for n in ("means", "quats", "log_scales")
    )
    learned = handover.load(run / "checkpoints" / "articulation.pt")[0]
    assert len(learned.gaussians) == len(after.gaussians)


def test_predict_knows_the_plugins(desk, run):
    (desk / "drawn.txt").unlink()
    made = p2gs(desk, "predict", str(run), "--times", "0.5", "--out", "states", "--size", "48")
    assert made.returncode == 0, made.stderr
    assert list((desk / "states").glob("*.png")) and (desk / "drawn.txt").read_text().split() == ["predict"]


@pytest.mark.parametrize(
    "words", [["predict"], ["export", "--format", "urdf"], ["view"], ["test"]], ids=lambda words: words[0]
)
def test_a_plugin_out_of_reach_is_told_in_one_sentence(run, tmp_path, words, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([words[0], str(run), *words[1:]]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "plugin 'my_phases' cannot be imported" in told and "PYTHONPATH" in told


def test_an_edit_of_ones_own_phase_makes_it_again_and_nothing_before_it(desk, run):
    file = desk / "my_phases.py"
    text = file.read_text()
    try:
        file.write_text(text.replace("self.moves[visit.state]", "self.moves[1 - visit.state]"))
        words = ["-c", str(run / "config.yaml"), "--threads", "1", "--run", str(run), "--only", "articulation"]
        done = p2gs(desk, "fit", *words)
    finally:
        file.write_text(text)
    assert done.returncode == 2 and "colours: runs again: the code of my_phases changed" in done.stdout, (
        done.stdout + done.stderr
    )
    assert done.stdout.count("done before, unchanged") == 7, done.stdout
