"""A joint that is askew to the object is laid along one of the object's directions where photographs hardly tell."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.directions import (
    axis_of,
    common_normal,
    directions_of,
    hinged_directions,
    shared_axes,
    squared,
    turned_onto,
)
from p2gs.motion.motion_steps import allowed_step, along_axes, apply_step
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3, so3
from p2gs.parts.askew import keep_axes, lay_axes, on_axes
from p2gs.types import GaussianTensors

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def degrees_between(a, b) -> float:
    return math.degrees(math.acos(min(1.0, abs(float(a @ b)))))


def plate(normal: int, offset: float, n: int = 20) -> torch.Tensor:
    side = torch.linspace(-0.5, 0.5, n)
    return torch.cat([torch.full((n * n, 1), offset), torch.cartesian_prod(side, side)], 1).roll(normal, 1)


def cube(state: int) -> StateGaussians:
    """The six faces of a cube: flat Gaussians off their plane by thousandths, whose facing is off by degrees."""
    g = torch.Generator().manual_seed(state)
    points, quats = [], []
    for normal in range(3):
        turn = torch.zeros(400, 4)
        turn[:, 0] = 1
        if normal:  # the shortest axis, x, onto y or z
            turn[:, 0], turn[:, 4 - normal] = math.sqrt(0.5), math.sqrt(0.5)
        for offset in (-0.5, 0.5):
            points.append(plate(normal, offset))
            quats.append(turn + 0.03 * torch.randn(400, 4, generator=g))
    means = torch.cat(points) + 0.002 * torch.randn(2400, 3, generator=g)
    scales = torch.tensor([0.001, 0.02, 0.02]).log().repeat(2400, 1)
    return StateGaussians(
        state, GaussianTensors(means, torch.cat(quats), scales, torch.full((2400,), 4.0), torch.zeros(2400, 1, 3))
    )


def test_two_hinges_agree_on_a_direction():
    def hinge(axis, origin, degrees):
        axis = torch.nn.functional.normalize(torch.tensor(axis).double(), dim=0)
        return se3.from_screw(axis, torch.tensor(origin).double(), math.radians(degrees))

    def found(*hinges, kinds=None):
        return hinged_directions(
            PartMotions(kinds or ["revolute"] * len(hinges), torch.stack(hinges), torch.ones(len(hinges)), [], [])
        )

    left, right = hinge([0.005, 0, 1.0], [0.0, -0.4, 0.0], 60), hinge([0, 0.005, -1.0], [0.0, 0.4, 0.3], 50)
    (both,) = found(left, right)
    assert degrees_between(both, torch.tensor([0.0025, -0.0025, 1.0]).double()) < 0.01
    assert len(found(left, hinge([0.005, 0, 1.0], [0.0, -0.39, 0.2], 50))) == 0  # the left one, found twice
    (line,) = found(left, hinge([-0.005, 0, -1.0], [0.0, -0.39, 0.2], 50))  # two on one line, the second turns back
    assert degrees_between(line, torch.tensor([0.005, 0, 1.0]).double()) < 0.01
    assert len(found(left, hinge([0.0, 0.04, 1.0], [0.0, 0.4, 0.0], 50))) == 0  # two degrees apart
    assert len(found(left)) == 0 and len(found(left, right, kinds=["revolute", "prismatic"])) == 0


def test_directions_of_a_cube_are_its_axes_to_a_tenth_of_a_degree():
    labels = [torch.zeros(2400, dtype=torch.long)] * 2
    nothing = PartMotions([], torch.zeros(0, 4, 4).double(), torch.zeros(0), labels, [])
    found = directions_of([cube(0), cube(1)], nothing)
    assert len(found) == 3
    assert {int(d.abs().argmax()) for d in found} == {0, 1, 2}
    assert max(degrees_between(d, torch.eye(3).double()[int(d.abs().argmax())]) for d in found) < 0.1
    # what slides faces the same way in both states, what turns does not and has no say
    for kind, count in (("prismatic", 3), ("revolute", 0)):
        all_of_it = nothing.with_motion(0, kind, torch.eye(4).double())
        all_of_it.labels = [torch.ones_like(x) for x in labels]
        assert len(directions_of([cube(0), cube(1)], all_of_it)) == count


def test_common_normal_is_that_of_several_planes_at_once():
    truth = torch.nn.functional.normalize(torch.tensor([0.03, -0.02, 1.0]).double(), dim=0)
    g = torch.Generator().manual_seed(1)
    xy = torch.rand(900, 2, generator=g).double() - 0.5
    z = torch.tensor([0.0, 0.3, 0.7]).double().repeat(300) - xy @ truth[:2] / truth[2]
    points = torch.cat([xy, z[:, None] + 0.001 * torch.randn(900, 1, generator=g).double()], 1)
    points[::50, 2] += 0.02  # some lie off their plane
    normals = UP.expand(900, 3)
    assert degrees_between(UP, truth) > 2
    found, known = common_normal(points, normals, UP, 0.05)
    assert degrees_between(found, truth) < 0.1
    assert float((known @ found).norm()) < 1e-6 * float(known.norm())  # of its tilt alone, not of its length
    found, known = common_normal(points, normals.roll(1, 1), UP, 0.05)
    assert torch.equal(found, UP) and not known.any()  # no plane faces that way


def test_directions_near_right_angles_are_at_right_angles():
    """Two are known well, the third a hundred times worse and 1.5 degrees off; a fourth is of a slanted side."""
    frame = so3.rotvec_to_matrix(torch.tensor([0.3, -0.2, 0.5]).double()).T
    bad = so3.rotvec_to_matrix(1.5 * torch.pi / 180 * frame[0]) @ frame[2]
    slanted = torch.nn.functional.normalize(frame[0] + 0.3 * frame[1], dim=0)
    directions = torch.stack([frame[0], frame[1], bad, slanted])
    known = torch.eye(3).double() - directions[:, :, None] * directions[:, None]
    found = squared(directions, known * torch.tensor([1.0, 1, 0.01, 1])[:, None, None])
    assert (found[:3] @ found[:3].T - torch.eye(3)).abs().max() < 1e-9 and torch.equal(found[3], slanted)
    assert max(degrees_between(found[i], frame[i]) for i in range(3)) < 0.05
    assert torch.equal(squared(directions[3:], known[3:]), directions[3:])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_motion_that_is_turned_onto_a_direction_goes_as_far_along_it(kind):
    tilted = torch.nn.functional.normalize(torch.tensor([0.05, 0.1, -1.0]).double(), dim=0)
    middle = torch.tensor([0.4, 0.1, 0.3]).double()
    origin = torch.tensor([0.1, 0.1, 0.3]).double()
    if kind == "revolute":
        T = se3.from_screw(tilted, origin, torch.tensor(0.7).double())
    else:
        T = torch.eye(4).double()
        T[:3, 3] = 0.3 * tilted
    laid = turned_onto(kind, T, UP, middle)
    assert float(axis_of(kind, laid) @ UP) == pytest.approx(-1)  # the same way round
    if kind == "revolute":
        angle, there = float(se3.screw_parameters(laid).angle.abs()), se3.apply(T, middle[None])[0]
        for other in (angle - 0.01, angle + 0.01):  # no other turn about it is nearer to the one that there was
            assert so3.rotation_angle(laid[:3, :3], T[:3, :3]) < so3.rotation_angle(
                so3.rotvec_to_matrix(-other * UP), T[:3, :3]
            )
        assert float((se3.apply(laid, middle[None])[0] - there)[:2].norm()) < 1e-9  # as far across it
    else:
        assert float(laid[:3, 3].norm()) == pytest.approx(0.3 * abs(float(tilted @ UP)))


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_steps_along_a_held_axis_leave_it_and_others_are_free(kind):
    g = torch.Generator().manual_seed(2)
    T = torch.eye(4).double()[None].repeat(2, 1, 1)
    if kind == "revolute":
        T[:] = se3.from_screw(UP, torch.tensor([0.3, 0.2, 0.0]).double(), torch.tensor(0.8).double())
    else:
        T[:, :3, 3] = 0.4 * UP
    axes = torch.stack([UP, torch.full((3,), math.nan).double()])
    centre, radius = torch.rand(2, 3, generator=g).double(), torch.tensor([0.5, 0.5]).double()
    for _ in range(5):
        step = allowed_step([kind] * 2, T, centre, radius, 0.05 * torch.randn(2, 6, generator=g).double())
        T = apply_step(T, centre, radius[:, None], along_axes([kind] * 2, axes, step))
    assert degrees_between(axis_of(kind, T[0]), UP) < 1e-4
    assert degrees_between(axis_of(kind, T[1]), UP) > 0.5
    if kind == "revolute":
        assert abs(float(T[0, :3, 3] @ UP)) < 1e-9  # no pitch either


@dataclass
class Told:
    """A judge whose energy is ``slope`` times the angle (degrees) of the first axis to ``best``; it refines nothing."""

    states: list
    best: torch.Tensor
    slope: float
    config: PolishConfig
    own: float = 1.0  # times what it costs in all pixels it costs in a part's own
    found = None

    def __call__(self, motions):
        return self.slope * degrees_between(axis_of(motions.types[0], motions.transforms[0]), self.best), 1.0

    def gain(self, tried, than):
        return self(than)[0] - self(tried)[0]

    def own_share(self, tried, than):
        return self.own * self.gain(tried, than)

    def refine(self, motions, axes=None):
        return motions


def askew(degrees: float) -> PartMotions:
    T = torch.eye(4).double()[None].clone()
    T[0, :3, 3] = 0.3 * torch.tensor([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])
    labels = torch.zeros(2400, dtype=torch.long)
    labels[:50] = 1
    return PartMotions(["prismatic"], T, torch.ones(1), [labels] * 2, [torch.ones(2400)] * 2)


@pytest.mark.parametrize(
    "degrees, slope, own, laid",
    [
        (5.0, 0.001, 1.0, True),  # photographs hardly tell: half a hundredth is lost
        (5.0, 0.001, 20.0, True),  # a tenth in the part's own pixels
        (5.0, 0.01, 1.0, False),  # they do
        (0.8, 0.001, 1.0, False),  # directions are not known better than that
        (25.0, 0.0002, 2.0, True),  # however far off
        (25.0, 0.0002, 20.0, False),  # but not if its own pixels lose a tenth
        (25.0, 0.001, 1.0, False),
    ],
)
def test_an_axis_askew_is_laid_where_that_costs_next_to_nothing(degrees, slope, own, laid):
    motions = askew(degrees)
    judge = Told([cube(0), cube(1)], axis_of("prismatic", motions.transforms[0]), slope, PolishConfig(), own)
    found, axes, log = lay_axes(judge, motions, 0.01, 0.02)
    off = degrees_between(axis_of("prismatic", found.transforms[0]), UP)
    assert off < 0.1 if laid else off == pytest.approx(degrees, abs=1e-4)
    assert len(log) == (degrees > 1) and bool(axes.isnan().any()) != laid
    assert torch.equal(on_axes(found, axes).nan_to_num(), axes.nan_to_num())
    assert lay_axes(judge, motions, 0.0, 0.02)[::2] == (motions, [])  # switched off
    judge.config = PolishConfig(steps=0)
    assert lay_axes(judge, motions, 0.01, 0.02)[::2] == (motions, [])  # screws stay as they were learned


def test_of_several_measures_of_a_direction_the_one_that_explains_most_is_taken():
    """A hinge agrees with surfaces to half a degree and knows the direction better."""
    best = torch.nn.functional.normalize(torch.tensor([0.0, math.radians(0.5), 1.0]).double(), dim=0)
    hinge = se3.from_screw(best, torch.tensor([0.3, 0.0, 0.0]).double(), torch.tensor(0.5).double())
    motions = askew(6.0).with_motion(1, "revolute", hinge)
    motions.labels = [torch.where(torch.arange(2400) > 2350, 2, of) for of in motions.labels]
    judge = Told([cube(0), cube(1)], best, 0.001, PolishConfig())
    found, axes, log = lay_axes(judge, motions, 0.01, 0.02)
    assert [told["part"] for told in log] == [0] and torch.equal(found.transforms[1], hinge)
    assert degrees_between(axis_of("prismatic", found.transforms[0]), best) < 1e-4
    assert degrees_between(axes[0], best) < 1e-4 and bool(axes[1].isnan().all())


def slide(x, y, z):
    T = torch.eye(4).double()
    T[:3, 3] = torch.tensor([x, y, z])
    return T


def test_slides_along_the_very_same_direction_share_it_and_others_are_free():
    T = torch.stack([slide(0.2, 0, 0), slide(-0.3, 0, 0), slide(0.1, 0.0005, 0), slide(0, 0, 0.2)])
    axes = shared_axes(T, ["prismatic"] * 4)
    assert axes[0].abs().tolist() == axes[1].abs().tolist() == [1, 0, 0]
    assert bool(axes[2:].isnan().all())  # 0.3 degrees off was fitted by itself, and one alone shares nothing
    assert bool(shared_axes(T[:2], ["prismatic", "revolute"]).isnan().all())


def test_a_shared_direction_is_kept_by_all_where_photographs_take_one_more_than_a_degree_from_it():
    T = torch.stack([slide(0.2, 0, 0), slide(0.3, 0.003, 0), slide(0.3, 0.03, 0), slide(0.1, 0.1, 0)])
    labels = [torch.zeros(2400, dtype=torch.long)] * 2
    motions = PartMotions(["prismatic"] * 4, T, torch.ones(4), labels, [])
    axes = torch.tensor([[1.0, 0, 0]]).double().repeat(4, 1)
    axes[3] = math.nan
    held = []
    judge = SimpleNamespace(states=[cube(0)], refine=lambda m, a: held.append(a) or m)
    kept = keep_axes(judge, motions, axes)
    assert torch.equal(kept.transforms[3], T[3])
    for k in range(3):
        assert kept.transforms[k, :3, 3].tolist() == pytest.approx([float(T[k, 0, 3]), 0, 0])
    assert torch.equal(held[0].nan_to_num(), axes.nan_to_num())
    fewer = replace(motions, types=["prismatic"] * 2, transforms=T[:2])
    assert keep_axes(judge, fewer, axes[:2]) is fewer  # a fraction of a degree is theirs
    assert keep_axes(judge, kept, axes) is kept and len(held) == 1
