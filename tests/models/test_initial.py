"""What a state starts from: depth points where the scene has depth, random ones else."""

from dataclasses import replace

import pytest
import torch

from p2gs.data.views import TrainingViews
from p2gs.models.initial import initial_points
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase
from p2gs.types import Camera, TwoStateScene, View

SIZE = 24


def wall_scene(distance: float = 3.0) -> TwoStateScene:
    """Two photographs a state of a wall of noise, seen straight on from ``distance``, with depth maps."""
    g = torch.Generator().manual_seed(0)
    K = torch.tensor([[30.0, 0, SIZE / 2], [0, 30.0, SIZE / 2], [0, 0, 1]])
    views = []
    for number in range(4):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([0.1 * number, 0.0, distance])
        image = (torch.rand(SIZE, SIZE, 3, generator=g) * 255).byte()
        alpha = torch.full((SIZE, SIZE), 255, dtype=torch.uint8)
        depth = torch.full((SIZE, SIZE), distance)
        depth[:, : SIZE // 4] = 0  # not known
        views.append(View(str(number), number % 2, "train", Camera(viewmat, K, SIZE, SIZE), image, alpha, depth))
    return TwoStateScene("wall", tuple(views), box=torch.tensor([[-1.5] * 3, [1.5] * 3]))


@pytest.mark.parametrize("init", ["auto", "agreed"])
def test_depth_points_lie_on_what_was_measured(init):
    scene = wall_scene()
    start = initial_points(scene, 0, (50, 300), init, torch.Generator().manual_seed(1))
    assert bool(start.known.all()) and start.points.shape == start.colours.shape == (300, 3)
    assert float(start.points[:, 2].abs().max()) < 1e-5  # the wall is the plane z = 0 of the world
    assert float(start.colours.std()) > 0.2


@pytest.mark.parametrize("init, depth", [("random", True), ("auto", False)])
def test_random_points_where_depth_is_not_wanted_or_not_there(init, depth):
    scene = wall_scene()
    if not depth:
        scene = replace(scene, views=tuple(replace(v, depth=None) for v in scene.views))
    start = initial_points(scene, 0, (50, 300), init, torch.Generator().manual_seed(1))
    assert not bool(start.known.any()) and len(start.points) == 50 and float(start.points[:, 2].abs().max()) > 0.1


def test_depth_points_have_a_number_and_an_opacity_of_their_own():
    scene = wall_scene()
    config = SingleStateConfig(
        levels=[SIZE], level_starts=[0.0], initial_gaussians=60, initial_opacity=0.02, depth_gaussians=200,
        depth_opacity=0.8,
    )  # fmt: skip
    views = TrainingViews(scene.select(state=0, split="train"), [SIZE])
    for init, count, opacity in (("auto", 200, 0.8), ("random", 60, 0.02)):
        phase = SingleStatePhase(replace(config, init=init), {}, scene, 0, views, seed=0, rasterizer="auto")
        assert len(phase.splats) == count
        torch.testing.assert_close(torch.sigmoid(phase.splats.opacity_logits), torch.full((count,), opacity))
