"""An object of which nothing stands still, the whole way: no Gaussian is the base's, and every file is written."""

import json
from dataclasses import replace
from pathlib import Path

import torch
from one_stage import REPO, SMALL_PHASES

from p2gs.app import run as p2gs
from p2gs.data.generated.articulated import SyntheticObject, SyntheticPart, prismatic
from p2gs.data.generated.shapes import box
from p2gs.data.generated.textures import Texture
from p2gs.data.generated.write import write_scene
from p2gs.gaussians import handover

SMALL = """
include: [{repo}/configs/preset/smoke.yaml]
data: {{format: artgs, root: {root}, depth: never}}
num_parts: 2
phases:
{phases}  finish: {{polish: {{steps: 8, levels: [64], level_starts: [0.0]}}, part_penalty: 0, exports: [all]}}
"""


def all_ones(path: Path, **changed) -> None:
    """Let a stage have handed over that everything is the moving part's, whatever so small a run has found."""
    made, header = handover.load(path)
    labels = [torch.ones_like(x) for x in made.labels] if "types" in changed else torch.ones_like(made.labels)
    handover.save(replace(made, labels=labels, **changed), path, key=header["key"], made_of=header["made_of"])


def test_an_object_of_which_nothing_stands_still(tmp_path, capsys):
    checks, wood = ((0.9, 0.3, 0.2), (0.2, 0.4, 0.8), 0.25, 1), ((0.2, 0.8, 0.3), (0.1, 0.5, 0.2), 0.1, 2)
    pieces = [box((-0.4, -0.3, -0.3), (0.4, 0.3, 0.3), Texture("checks", *checks))]
    pieces.append(box((0.4, -0.05, -0.05), (0.5, 0.05, 0.05), Texture("wood", *wood)))
    parts = (SyntheticPart("base", ()), SyntheticPart("box", tuple(pieces), prismatic((1, 0, 0), (0, 0, 0), 0.0, 0.5)))
    thing, run = SyntheticObject("thing", parts).fitted(), tmp_path / "run"
    write_scene(thing, tmp_path / "scene", size=64, train_views=12, test_views=2, depth=False)
    (tmp_path / "small.yaml").write_text(SMALL.format(repo=REPO, phases=SMALL_PHASES, root=tmp_path / "scene"))
    fit = ["fit", "-c", str(tmp_path / "small.yaml"), "--run", str(run)]
    for stage in ("single_state", "registration", "sharpen", "discovery"):
        assert p2gs([*fit, "--only", stage]) == 0
    slide = torch.tensor(thing.joints[0].transform(thing.joints[0].end))[None]
    all_ones(run / "checkpoints" / "discovery.pt", types=["prismatic"], transforms=slide, confidence=torch.ones(1))
    assert p2gs([*fit, "--only", "canonical_fusion"]) == 0
    all_ones(run / "checkpoints" / "canonical_fusion.pt")
    assert p2gs(fit) == 0
    twin = json.loads((run / "twin.json").read_text())
    assert [p["kind"] for p in twin["parts"]] == ["static", "movable"] and twin["parts"][0]["gaussians"] == 0
    assert twin["parts"][1]["joint"]["type"] == "prismatic"
    for name in ("twin.urdf", "twin.xml", "twin.usda", "twin.glb", "splats.glb", "splats.spz", "report.html"):
        assert (run / name).is_file(), name
    assert (run / "diagnostics.html").is_file() and not (run / "parts" / "base.ply").exists()
    capsys.readouterr()
    assert p2gs(["test", str(run)]) == 0 and "static part has no surface" in " ".join(capsys.readouterr().out.split())
    scores = json.loads((run / "metrics.json").read_text())
    assert scores["chamfer"]["static"]["value"] is None and scores["chamfer"]["movable"]["value"] > 0
    assert scores["penetration"] == {"mean": 0.0, "max": 0.0}
    assert p2gs(["predict", str(run), "--times", "0", "0.5", "--size", "64"]) == 0
    assert p2gs(["export", str(run)]) == 0, capsys.readouterr().out  # engines and validators: tests/export
