"""Masks that are too wide or too narrow: found where they are, left alone where they are right."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion
from tiny import photographs, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.splats import Splats
from p2gs.models.mask_fit import edge_distances, growths_of, long_edge, regrown, signed_distance, try_masks
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase
from p2gs.models.view_fit import ViewErrors, ViewFitConfig
from p2gs.types import TwoStateScene

SIZE = 96
GROWN = [2, -2, 1, -1, 0, 2, -1, -1]  # pixels, mean zero


def scene():
    """Gaussians, their photographs with hard masks, and these with masks that are off by ``GROWN``."""
    g, labels = textured_panels(1200)
    views = photographs(g, labels, torch.eye(4).double(), 0, SIZE, len(GROWN))
    hard = [replace(v, alpha=(v.alpha > 127).to(torch.uint8) * 255) for v in views]
    return g, hard, [grown(v, k) for v, k in zip(hard, GROWN, strict=True)]


def grown(view, pixels: int):
    """Its mask wider by whole pixels; what comes in and what goes out is black."""
    was = view.alpha.numpy() > 127
    now = binary_dilation(was, iterations=pixels) if pixels > 0 else was
    now = binary_erosion(now, iterations=-pixels) if pixels < 0 else now
    image = np.where((was & now)[..., None], view.image.numpy(), 0).astype(np.uint8)
    return replace(view, image=torch.from_numpy(image), alpha=torch.from_numpy(now.astype(np.uint8) * 255))


def edges_of(g, views):
    shots = list(ViewErrors(len(views)).shots(TrainingViews(views, [SIZE], crop=False), SIZE, "cpu"))
    assert {long_edge(shot) for shot in shots} == {SIZE}
    return [edge_distances(g, shot, "auto") for shot in shots]


def test_distance_from_a_straight_edge():
    inside = np.zeros((5, 9), bool)
    inside[:, 4:] = True
    assert np.allclose(signed_distance(inside), np.arange(9) - 3.5)


def test_growths_are_measured_with_mean_zero():
    g, _, wrong = scene()
    found = growths_of(edges_of(g, wrong)) * SIZE
    assert abs(float(found.mean())) < 1e-12
    assert np.abs(found.numpy() - GROWN).max() < 0.5


def test_halves_of_edges_decide():
    g, right, wrong = scene()
    assert try_masks(edges_of(g, wrong)).passed(0.02)
    assert not try_masks(edges_of(g, right)).passed(0.02)


@pytest.mark.parametrize("pixels", [2, -2])
def test_a_mask_is_put_right(pixels):
    """To within a pixel at its corners, and what comes in has the colour beside it."""
    g, right, _ = scene()
    off = grown(right[0], pixels)
    got = regrown(off, pixels / SIZE)
    differ = [(v.alpha > 127) != (right[0].alpha > 127) for v in (off, got)]
    assert differ[1].sum() < 0.2 * differ[0].sum()
    if pixels < 0:
        came = ((got.alpha > 127) & (off.alpha <= 127)).numpy()
        apart = np.abs(got.image.numpy()[came].astype(float) - right[0].image.numpy()[came]).mean()
        assert came.any() and apart < 0.5 * right[0].image.numpy()[came].mean()


def test_masks_that_need_nothing_or_would_vanish_stay():
    view = scene()[1][0]
    assert regrown(view, 0.0) is view and regrown(view, 0.9) is view
    empty = replace(view, alpha=torch.zeros_like(view.alpha))
    assert regrown(empty, 0.01) is empty


def test_a_phase_decides_on_masks():
    g, right, wrong = scene()
    for photos, off in ((wrong, True), (right, False)):
        forgive = ViewFitConfig(masks="auto")
        config = SingleStateConfig(steps=10, levels=[SIZE], level_starts=[0.0], initial_gaussians=50, forgive=forgive)
        box = torch.tensor([[-0.6, -0.2, -0.6], [0.6, 0.9, 0.6]])
        whole = TrainingViews(photos, [SIZE], crop=False)
        phase = SingleStatePhase(config, {}, TwoStateScene("panels", tuple(photos), box=box), 0, whole)
        phase.splats = Splats(g)
        phase.forgive(round(forgive.bundled[0] * config.steps))
        assert phase.errors.on.tolist() == [False, False, off]
        assert (phase.errors.handed_over() is not None) == off
        if off:
            shots = phase.errors.views(photos)
            left = [((a.alpha > 127) != (b.alpha > 127)).sum() for a, b in zip(shots, right, strict=True)]
            were = [((a.alpha > 127) != (b.alpha > 127)).sum() for a, b in zip(photos, right, strict=True)]
            assert sum(left) < 0.5 * sum(were)
