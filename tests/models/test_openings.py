"""Lids before openings give way to the walls behind them, things that photographs tell do not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import look_at

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3
from p2gs.ops.sh import dc_to_rgb, rgb_to_dc
from p2gs.parts.patches import patches
from p2gs.render import rasterize_stored
from p2gs.surface.openings import BASE, DOOR, DRAWER, OpeningsConfig, kinds, open_up, unconfirmed
from p2gs.surface.walls import Backdrop, Walls, over_surface
from p2gs.types import GaussianTensors, View
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.evidence import gather_evidence

SIZE = 96


def panel(corner, u, v, colour, step=0.035) -> GaussianTensors:
    """A flat rectangle of Gaussians from ``corner`` along u and v. colour: [3], or a function of points [N, 3]."""
    corner, u, v = (torch.tensor(x, dtype=torch.float32) for x in (corner, u, v))
    a, b = (torch.linspace(0, 1, max(2, round(float(w.norm()) / step))) for w in (u, v))
    points = (corner + a[:, None, None] * u + b[None, :, None] * v).reshape(-1, 3)
    thin = (u == 0) & (v == 0)
    scales = torch.where(thin, 0.003, 0.5 * step).log().expand(len(points), 3).clone()
    rgb = colour(points) if callable(colour) else torch.tensor(colour).expand(len(points), 3)
    sh = rgb_to_dc(rgb)[:, None]
    return GaussianTensors(
        points, torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1), scales, torch.full((len(points),), 4.0), sh
    )


def speckled(points):
    return torch.rand(len(points), 3, generator=torch.Generator().manual_seed(1))


OUTSIDE, DARK = [0.8, 0.5, 0.2], [0.1, 0.1, 0.15]
BOX = [  # a chest: back (y = -0.3), sides, bottom, top
    ([-0.4, -0.3, -0.3], [0.8, 0, 0], [0, 0, 0.6]),
    ([-0.4, -0.3, -0.3], [0, 0.6, 0], [0, 0, 0.6]),
    ([0.4, -0.3, -0.3], [0, 0.6, 0], [0, 0, 0.6]),
    ([-0.4, -0.3, -0.3], [0.8, 0, 0], [0, 0.6, 0]),
    ([-0.4, -0.3, 0.3], [0.8, 0, 0], [0, 0.6, 0]),
]
INSIDE = [  # the same 0.03 further in
    ([-0.37, -0.27, -0.27], [0.74, 0, 0], [0, 0, 0.54]),
    ([-0.37, -0.27, -0.27], [0, 0.57, 0], [0, 0, 0.54]),
    ([0.37, -0.27, -0.27], [0, 0.57, 0], [0, 0, 0.54]),
    ([-0.37, -0.27, -0.27], [0.74, 0, 0], [0, 0.57, 0]),
    ([-0.37, -0.27, 0.27], [0.74, 0, 0], [0, 0.57, 0]),
]
HINGE = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([-0.4, 0.3, 0]).double(), 1.7)


def outer():
    return GaussianTensors.cat([panel(*side, OUTSIDE) for side in BOX])


def door():
    return panel([-0.4, 0.3, -0.3], [0.8, 0, 0], [0, 0, 0.6], OUTSIDE)


def photograph(g: GaussianTensors, state: int) -> list[View]:
    views = []
    for k in range(16):
        angle = torch.tensor(k * 2 * torch.pi / 16)
        camera = look_at(torch.stack([2.2 * angle.sin(), 2.2 * angle.cos(), torch.tensor(0.5 if k % 2 else 0.1)]), SIZE)
        out = rasterize_stored(
            g.means, g.quats, g.log_scales, g.opacity_logits, g.sh, None, camera.viewmat, camera.K, SIZE, SIZE
        )
        colour = (out.colour / out.alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
        views.append(
            View(
                f"{state}_{k}", state, "train", camera, (colour * 255).round().byte(), (out.alpha * 255).round().byte()
            )
        )
    return views


def opened(g: GaussianTensors) -> GaussianTensors:
    """Swung about the hinge; round, so that how they turn does not matter."""
    means = se3.apply(HINGE, g.means.double()).float()
    return GaussianTensors(means, g.quats, torch.full_like(g.log_scales, float(np.log(0.016))), g.opacity_logits, g.sh)


def scene(lid: GaussianTensors, truth: list[GaussianTensors]):
    """The shut and the open chest as trained (the open one with ``lid``), photographs of what it is (``truth`` inside),
    motions, depth."""
    swung = opened(door())
    trained = [GaussianTensors.cat([outer(), door()]), GaussianTensors.cat([outer(), swung, lid])]
    real = [trained[0], GaussianTensors.cat([outer(), swung, *truth])]
    photos = [photograph(g, s) for s, g in enumerate(real)]
    views = {s: TrainingViews(photos[s], levels=(SIZE,)) for s in (0, 1)}
    n = len(outer()), len(door()), len(lid)
    labels = [torch.cat([torch.full((m,), k) for m, k in zip(n[:2], (0, 1), strict=True)]) for _ in (0, 1)]
    labels[1] = torch.cat([labels[1], torch.zeros(n[2], dtype=torch.int64)])
    motions = PartMotions(["revolute"], HINGE[None], torch.ones(1), labels, [torch.ones(len(x)) for x in labels])
    seen = [gather_evidence(g, photos[s], SIZE, 0.5) for s, g in enumerate(trained)]
    stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in seen]
    return [StateGaussians(s, g) for s, g in enumerate(trained)], motions, views, stacks


def test_a_lid_gives_way_to_the_walls_behind_it():
    lid = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)
    states, motions, views, stacks = scene(lid, [panel(*side, DARK) for side in INSIDE])
    out, told, depth, counted = open_up(states, motions, views, stacks, OpeningsConfig(), backend="auto")
    assert (
        counted[0]["removed"] == 0
        and out[0].kept.all()
        and len(out[0].of(states[0]).gaussians) == len(states[0].gaussians)
    )
    # what shows through the opening is gone; the lid's rim, which stands before a wall, may stay
    assert counted[1]["removed"] > 0.6 * len(lid) and counted[1]["added"] > 100
    g, kept = out[1].of(states[1]).gaussians, len(states[1].gaussians) - counted[1]["removed"]
    assert len(g) == len(told.labels[1]) == len(told.margin[1]) == kept + counted[1]["added"]
    room, colour = g.means[kept:], dc_to_rgb(g.sh[kept:, 0])
    assert (told.labels[1][kept:] == 0).all()
    walls = torch.cat([panel(*side, DARK).means for side in INSIDE])
    assert float(torch.cdist(room, walls).min(1).values.quantile(0.95)) < 0.06  # a wall's thickness is assumed
    assert float((colour - torch.tensor(DARK)).abs().mean()) < 0.05
    # between lid and back wall: hidden before, seen through now
    deeper = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.1, 0.0]])
    assert (stacks[1].counts(deeper, 0.02)[0] == 0).all() and (depth[1].counts(deeper, 0.02)[0] > 0).all()
    again = open_up(states, motions, views, stacks, OpeningsConfig(), backend="auto")
    assert torch.equal(again[0][1].of(states[1]).gaussians.means, g.means)
    further = replace(
        states[1], gaussians=states[1].gaussians.placed(states[1].gaussians.means + 1.0, states[1].gaussians.quats)
    )
    assert torch.equal(out[1].of(further).gaussians.means[:kept], g.means[:kept] + 1.0)


def test_what_the_photographs_tell_stays():
    shelf = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], speckled)
    states, motions, views, stacks = scene(shelf, [shelf])
    out, told, _, counted = open_up(states, motions, views, stacks, OpeningsConfig(), backend="auto")
    assert counted[1]["unconfirmed"] > 0.7 * len(shelf) and counted[1]["patches"] > 3
    assert counted[1]["removed"] <= 0.1 * len(shelf)


@pytest.mark.parametrize("kind", ["base", "revolute", "prismatic"])
def test_each_kind_may_be_explained_worse_by_its_own_measure(kind):
    lid = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)
    states, motions, views, stacks = scene(lid, [panel(*side, DARK) for side in INSIDE])
    if kind != "base":
        forth = torch.eye(4).double()
        forth[1, 3] = 0.1
        motions = replace(
            motions, types=["revolute", kind], transforms=torch.stack([HINGE, forth]), confidence=torch.ones(2)
        )
        motions.labels[1][-len(lid) :] = 2
    names = {"base": "may_lose", "revolute": "doors", "prismatic": "drawers"}
    for told in names:
        config = OpeningsConfig(**{name: 100.0 if k == told else 1e-3 for k, name in names.items()})
        removed = open_up(states, motions, views, stacks, config, backend="auto")[3][1]["removed"]
        assert (removed > 0) == (told == kind), told


def test_what_hangs_apart_from_a_drawer_is_taken_for_a_doors():
    groups = [
        outer(),
        panel([0, 0.5, 0], [0.5, 0, 0], [0, 0, 0.3], DARK),
        panel([0, 0.8, 0], [0.1, 0, 0], [0, 0, 0.1], DARK),
        door(),
    ]
    labels = torch.cat([torch.full((len(g),), k) for g, k in zip(groups, (0, 1, 1, 2), strict=True)])
    want = torch.cat([torch.full((len(g),), k) for g, k in zip(groups, (BASE, DRAWER, DOOR, DOOR), strict=True)])
    assert torch.equal(kinds(GaussianTensors.cat(groups), labels, ["prismatic", "revolute"]), want)


def test_states_without_an_object_are_left_to_fusion():
    lid = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)
    states, motions, views, stacks = scene(lid, [lid])
    states[0].gaussians.opacity_logits.fill_(-4.0)
    out, told, _, counted = open_up(states, motions, views, stacks, OpeningsConfig(), backend="auto")
    assert all(o.kept.all() for o in out) and told is motions and all(c["removed"] == 0 for c in counted)


def test_unconfirmed_is_what_is_hidden_and_far_from_what_the_other_state_shows_of_its_part():
    lid = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)
    states, motions, _, stacks = scene(lid, [lid])
    (other, g), n = (s.gaussians for s in states), len(lid)

    def asked(apart: float, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        away = se3.inverse(motions.transforms)
        return unconfirmed(g, motions.labels[1], away, other, labels, stacks[0], apart)

    found, beside = asked(0.035, motions.labels[0])
    assert not beside.any()
    inner = (lid.means[:, [0, 2]].abs() < torch.tensor([0.33, 0.23])).all(1)  # its rim is beside the sides
    assert found[-n:][inner].all() and found[: len(g) - n].float().mean() < 0.02
    assert not asked(0.5, motions.labels[0])[0].any()  # the sides are within 0.5 of the lid
    doors, beside = asked(0.5, torch.ones_like(motions.labels[0]))  # so is the shut door, which it does not belong to
    assert doors[-n:][inner].all() and not doors[motions.labels[1] == 1].any()
    assert torch.equal(beside, doors)


def test_what_lies_on_a_moving_part_is_that_parts_and_no_lid():
    lid = panel([-0.37, 0.38, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)  # farther out than the shut door
    states, motions, views, stacks = scene(lid, [lid])
    door_rows, means = (motions.labels[0] == 1).nonzero().squeeze(1), states[0].gaussians.means
    seam = door_rows[(means[door_rows, 0].abs() < 0.03) & (means[door_rows, 2].abs() < 0.2)]
    motions.labels[0][seam] = 0
    config = OpeningsConfig(apart=0.05)

    _, told, _, counted = open_up(states, motions, views, stacks, config, backend="auto")
    assert len(seam) > 10 and counted[0]["unconfirmed"] == 0
    assert bool((told.labels[0][seam] == 1).all()) and bool((motions.labels[0][seam] == 0).all())
    states[0].gaussians.opacity_logits[motions.labels[0] == 1] = -4.0  # no door there
    counted = open_up(states, motions, views, stacks, config, backend="auto")[3]
    assert counted[0]["unconfirmed"] == len(seam)


def test_walls_are_met_where_they_stand_and_at_the_box():
    wall = panel([-0.5, 0.0, -0.5], [1.0, 0, 0], [0, 0, 1.0], DARK)
    walls = Walls(over_surface(wall), torch.tensor([-0.5, -0.5, -0.5]), torch.tensor([0.5, 0.5, 0.5]), 0.02)
    ways = torch.nn.functional.normalize(torch.tensor([[0.0, -1, 0], [0, 1, 0], [0.6, -0.8, 0]]), dim=1)
    far = walls.meet(torch.tensor([[0.0, 0.3, 0], [0.0, 0.3, 0], [0.0, 0.2, 0]]), ways)
    assert torch.allclose(far, torch.tensor([0.3, 0.2, 0.25]).double(), atol=0.05)
    assert walls.meet(torch.tensor([[0.0, 3.0, 0]]), torch.tensor([[0.0, 1.0, 0]])).isinf().all()
    assert len(walls.meet(torch.zeros(0, 3), torch.zeros(0, 3))) == 0


def test_the_backdrop_is_painted_by_the_chosen_rays_and_filled_beside_them():
    points = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [0.9, 0, 0]])
    where, patch = torch.tensor([0, 0, 1, 2]), torch.tensor([0, 0, 1, 1])
    colours = torch.tensor([[0.2, 0.2, 0.2], [0.4, 0.4, 0.4], [0.9, 0.9, 0.9], [0.9, 0.9, 0.9]])
    backdrop = Backdrop(points, where, colours, patch, 0.02)
    g, near = backdrop.gaussians(torch.tensor([True, False]), 4)
    assert g.sh.shape == (2, 4, 3) and near.tolist() == [True, True]  # the third point is out of reach
    assert torch.allclose(dc_to_rgb(g.sh[:, 0]), torch.full((2, 3), 0.3), atol=1e-6)
    both, _ = backdrop.gaussians(torch.tensor([True, True]), 1)
    assert torch.allclose(dc_to_rgb(both.sh[:, 0])[1], torch.full((3,), 0.9), atol=1e-6)


def test_patches_are_small_and_of_one_kind():
    a, b = panel([0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], OUTSIDE), panel([0, 0, 0.12], [0.5, 0, 0], [0, 0.5, 0], DARK)
    g = GaussianTensors.cat([a, b])
    patch = patches(g, 15)
    assert len(patch) == len(g) and 0.5 < (len(g) / 15) / (int(patch.max()) + 1) < 2
    first = torch.bincount(patch[: len(a)], minlength=int(patch.max()) + 1) > 0
    second = torch.bincount(patch[len(a) :], minlength=int(patch.max()) + 1) > 0
    assert not (first & second).any()  # one behind the other
