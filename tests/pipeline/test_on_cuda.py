"""A whole fit on a CUDA device with gsplat, from photographs to scores: no stage may mix devices."""

import json

import pytest
import torch

from p2gs.cli import main
from p2gs.data.generated.generate import synthesize

pytest.importorskip("gsplat")
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def test_every_stage_runs(tmp_path, capsys):
    scene = synthesize(tmp_path / "scene", seed=4, size=100, train_views=12, test_views=2, depth=False)
    run = str(tmp_path / "run")
    # observed pairs are made anew while the screws move, which so short a phase else never comes to
    pairs = ["--phases.articulation.refresh", "5", "--phases.articulation.nearest_from", "0.2"]
    words = ["-c", "preset/smoke.yaml", "--data.root", str(scene), "--run", run, "--data.depth", "never", *pairs]
    assert main(["fit", *words, "--device", "cuda", "--rasterizer", "gsplat"]) == 0, capsys.readouterr()
    assert main(["test", run]) == 0, capsys.readouterr()
    assert "parts" in json.loads((tmp_path / "run" / "twin.json").read_text())
