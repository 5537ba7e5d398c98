"""``preset/smoke.yaml`` has a surface to show to discovery, whatever it is trained on: a thin object fills a twentieth
of a picture. Whole runs over all kinds of objects: tests/faults/test_smoke_on_any_scene.py."""

import torch

from p2gs.cli import main
from p2gs.data.generated.generate import synthesize
from p2gs.gaussians import handover
from p2gs.visibility.evidence import gather_evidence


def test_a_thin_object_is_opaque(tmp_path, capsys):
    scene = synthesize(tmp_path / "scene", seed=4, size=64, train_views=8, test_views=1, depth=False)
    words = ["-c", "preset/smoke.yaml", "--data.root", str(scene), "--run", str(tmp_path / "run"), "--threads", "1"]
    assert main(["fit", *words, "--data.depth", "never", "--only", "single_state"]) == 0, capsys.readouterr()
    from p2gs.config.run import load_config

    views = load_config([], ["--data.root", str(scene), "--data.depth", "never"]).data.scene()
    for state in (0, 1):
        found, _ = handover.load(tmp_path / "run" / "checkpoints" / f"single_state_{state}.pt")
        gaussians = found.gaussians
        assert bool((torch.sigmoid(gaussians.opacity_logits) > 0.5).all())
        evidence = gather_evidence(gaussians, views.select(state=state, split="train"), 100, 0.5)
        assert len(evidence.points) > 100 and all(bool((d > 0).any()) for d in evidence.depths)
