"""Exposure and camera of single photographs: found where they are wrong, left alone where they are right."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import photographs, textured_panels

from p2gs.data.exposure import corrected
from p2gs.data.views import TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import StateGaussians, ViewCorrections, load, save
from p2gs.gaussians.splats import Splats
from p2gs.models.registered import correct_views
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase
from p2gs.models.trial import halves
from p2gs.models.view_fit import ViewErrors, ViewFitConfig, measure_gains, try_cameras, try_gains
from p2gs.ops import se3
from p2gs.ops.decay import exponential
from p2gs.ops.ssim import l1_ssim
from p2gs.types import TwoStateScene

SIZE = 64
CONFIG = ViewFitConfig()


def scene(count: int = 8):
    g, labels = textured_panels(1200)
    return g, photographs(g, labels, torch.eye(4).double(), 0, SIZE, count)


def moved(views, size: float, seed: int = 0):
    """Cameras off by twists of mean zero and ``size`` (rms of each entry)."""
    twists = size * torch.randn(len(views), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    twists -= twists.mean(0)
    return correct_views(views, ViewCorrections(se3.exp(twists), torch.zeros(len(views), 3), torch.zeros(len(views))))


def exposed(views, size: float):
    gains = size * np.random.default_rng(0).normal(size=(len(views), 3))
    gains -= gains.mean(0)
    shots = [
        replace(v, image=torch.from_numpy(corrected(v.image.numpy(), -g))) for v, g in zip(views, gains, strict=True)
    ]
    return shots, torch.from_numpy(gains)


def pyramid(views) -> TrainingViews:
    return TrainingViews(views, [SIZE], crop=False)


def test_gains_are_measured():
    g, views = scene()
    shots, gains = exposed(views, 0.06)
    known = ViewErrors(len(views))
    found = measure_gains(g, pyramid(shots), known, SIZE, "auto")
    assert (found - gains).abs().max() < 0.015 and found.mean(0).abs().max() < 1e-12
    assert try_gains(g, pyramid(shots), known, SIZE, "auto").passed(CONFIG.least)
    assert not try_gains(g, pyramid(views), known, SIZE, "auto").passed(CONFIG.least)


def test_only_real_errors_of_cameras_are_seen():
    g, views = scene()
    assert try_cameras(g, pyramid(moved(views, 0.006)), SIZE, "auto").passed(CONFIG.least)
    assert not try_cameras(g, pyramid(views), SIZE, "auto").passed(CONFIG.least)


def test_cameras_are_learned():
    """Forty looks at each photograph, the Gaussians frozen; the errors' mean is nobody's and stays."""
    g, views = scene()
    shots = moved(views, 0.006)
    seen, errors, total = pyramid(shots), ViewErrors(len(views)), 40 * len(views)
    errors.on[1] = True
    for step in range(total):
        index = step % len(views)
        shot = seen.get(index, 0, torch.full((3,), 0.5))
        out = render_gaussians(g, errors.camera(index, shot.camera), torch.full((3,), 0.5))
        l1_ssim(out.colour, shot.image, 0.2).backward()
        errors.learn(exponential(1e-3, 1e-5, step / total))
    assert errors.twists.mean(0).abs().max() < 1e-9
    right = correct_views(shots, errors.handed_over())
    before, after = (off_by(v, views, g.means) for v in (shots, right))
    assert before > 0.2 and after < 0.35 * before, (before, after)


def off_by(shots, views, points) -> float:
    """Root mean square distance in pixels between where two sets of cameras see points, over all of them."""
    apart = []
    for a, b in zip(shots, views, strict=True):
        at = [(points @ c.viewmat[:3, :3].T + c.viewmat[:3, 3]) @ c.K.T for c in (a.camera, b.camera)]
        apart.append(at[0][:, :2] / at[0][:, 2:] - at[1][:, :2] / at[1][:, 2:])
    return float(torch.stack(apart).square().sum(-1).mean().sqrt())


def test_nothing_is_on():
    g, views = scene(3)
    errors = ViewErrors(3)
    camera = views[0].camera
    assert errors.camera(0, camera) is camera and errors.handed_over() is None
    errors.learn(1e-3)
    assert not errors.twists.any() and correct_views(views, None) == views


@pytest.mark.parametrize("shape", [(64, 64), (37, 61)])
def test_halves(shape):
    a, b = halves(*shape)
    assert torch.equal(a + b, torch.ones(shape)) and 0.3 < a.mean() < 0.7
    for half in (a, b):  # some of every quarter
        assert all(q.any() for rows in half.tensor_split(2, 0) for q in rows.tensor_split(2, 1))


def test_handed_over(tmp_path):
    g, _ = textured_panels(10)
    given = StateGaussians(
        1,
        g,
        ViewCorrections(
            se3.exp(torch.full((2, 6), 0.01).double()), torch.tensor([[0.1, 0, -0.1]] * 2), torch.tensor([0.01, -0.01])
        ),
    )
    save(given, tmp_path / "s.pt")
    read = load(tmp_path / "s.pt")[0]
    for name in ("motions", "log_gains", "growths"):
        assert torch.equal(getattr(read.corrections, name), getattr(given.corrections, name))


def test_a_phase_decides():
    """Darker and brighter photographs are put right for training; where nothing is wrong, nothing is handed over."""
    g, views = scene()
    shots, gains = exposed(views, 0.06)
    for photos, wrong in ((shots, True), (views, False)):
        forgive = ViewFitConfig("auto", "never")
        config = SingleStateConfig(steps=10, levels=[SIZE], level_starts=[0.0], initial_gaussians=50, forgive=forgive)
        box = torch.tensor([[-0.6, -0.2, -0.6], [0.6, 0.9, 0.6]])
        phase = SingleStatePhase(config, {}, TwoStateScene("panels", tuple(photos), box=box), 0, pyramid(photos))
        phase.splats = Splats(g)
        phase.forgive(round(config.forgive.measured[0] * config.steps))
        assert bool(phase.errors.decided[0]) and bool(phase.errors.on[0]) == wrong
        found = phase.errors.handed_over()
        assert (found is None) != wrong
        if wrong:
            assert (found.log_gains - gains).abs().max() < 0.015
            trained = phase.views[0].get(0, 0, torch.zeros(3)).image
            assert (trained - TrainingViews(views, [SIZE]).get(0, 0, torch.zeros(3)).image).abs().max() < 0.03
