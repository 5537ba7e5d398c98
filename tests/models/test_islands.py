"""Pieces of a part that hang apart from it, and shifted parts that cover themselves."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from test_finish import two_states
from tiny import hinge, look_at, slide

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.part_pull import facing
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import PolishConfig
from p2gs.motion.survey import leave_false_minima, survey
from p2gs.ops import se3
from p2gs.parts.islands import find_islands, pieces, settle_islands, settle_twin_islands
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack


def sheet(corner, n=20, step=0.02):
    """A square of n x n points in the plane x = corner[0]."""
    y, z = torch.meshgrid(torch.arange(n) * step, torch.arange(n) * step, indexing="ij")
    return torch.stack([torch.zeros(n * n), y.reshape(-1), z.reshape(-1)], 1) + torch.tensor(corner)


def solid(points, opacity=0.9):
    n = len(points)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return GaussianTensors(
        points, quats, torch.full((n, 3), -4.0), torch.logit(torch.full((n,), opacity)), torch.zeros(n, 1, 3)
    )


def push(x):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


def test_pieces_are_parted_by_labels_and_by_gaps():
    points = torch.cat([sheet([0.0, 0, 0]), sheet([0.0, 0, 1.0])])
    labels = torch.zeros(len(points), dtype=torch.int64)
    assert len(pieces(points, labels).unique()) == 2
    labels[:200] = 1  # one half of the first sheet
    assert len(pieces(points, labels).unique()) == 3


def test_only_small_pieces_of_moving_parts_are_islands():
    points = torch.cat([sheet([0.0, 0, 0]), sheet([0.0, 0, 1.0], 5), sheet([0.0, 0, 2.0], 5)])
    labels = torch.tensor([1] * 400 + [1] * 25 + [0] * 25)
    found = find_islands(points, labels, 0.25) >= 0
    assert found.tolist() == [False] * 400 + [True] * 25 + [False] * 25
    assert not (find_islands(points, labels, 0.05) >= 0).any()


def islands_case():
    """Base, part 1 (sheet at z = 1), a patch amid the base that is labelled 1 in the end state alone."""
    base, part = sheet([0.0, 0, 0]), sheet([0.0, 0, 1.0])
    start = torch.cat([base, part])
    end = torch.cat([base, part + torch.tensor([0.3, 0, 0])])
    labels = torch.tensor([0] * 400 + [1] * 400)
    wrong = labels.clone()
    wrong[150:160] = 1
    return [solid(start), solid(end)], labels, wrong, push(0.3)[None]


def test_an_island_goes_to_what_it_touches():
    states, labels, wrong, T = islands_case()
    settled, count = settle_islands(states, [labels, wrong], T, 0.25)
    assert count == [0, 10] and torch.equal(settled[1], labels) and torch.equal(settled[0], labels)
    assert settle_islands(states, [labels, wrong], T, 0.0)[1] == [0, 0]


def test_an_island_that_lands_on_its_part_stays():
    """What the front hides in one state (a gap in the end's part) makes an island of its rest; the start shows that it
    is none."""
    states, labels, _, T = islands_case()
    gap = torch.ones(800, dtype=torch.bool)
    gap[400 + 6 * 20 : 400 + 12 * 20] = False  # six rows of the end's part are not there
    end = states[1][gap]
    settled, count = settle_islands([states[0], end], [labels, labels[gap]], T, 0.9)
    assert count == [0, 0] and torch.equal(settled[1], labels[gap])


def test_faint_ones_go_with_their_surface():
    states, labels, wrong, T = islands_case()
    faint = states[1].means[155:156] + 0.001
    end = GaussianTensors.cat([states[1], solid(faint, 0.05)])
    settled, _ = settle_islands([states[0], end], [labels, torch.cat([wrong, torch.tensor([1])])], T, 0.25)
    assert int(settled[1][-1]) == 0


def test_seen_from_is_the_mean_direction_to_the_cameras_that_see_a_point():
    eyes = [torch.tensor([3.0, 0.0, 0.0]), torch.tensor([2.4, 1.8, 0.0]), torch.tensor([-3.0, 0.0, 0.0])]
    cameras = [look_at(e, 32) for e in eyes]
    # the third sees a wall before the point
    depths = [torch.full((32, 32), 3.0), torch.full((32, 32), 3.0), torch.full((32, 32), 2.0)]
    stack = DepthStack(depths, [torch.ones(32, 32)] * 3, cameras)
    found = stack.seen_from(torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]]), 0.02)
    mean = (eyes[0] / 3 + eyes[1] / 3) / 2
    assert torch.allclose(found[0], mean / mean.norm(), atol=1e-5) and found[1].abs().max() == 0


def test_facing_turns_with_the_part():
    camera = look_at(torch.tensor([3.0, 0.0, 0.0]), 32)
    x, z = torch.tensor([[1.0, 0.0, 0.0]]), se3.from_screw(torch.tensor([0.0, 0, 1]), torch.zeros(3), torch.pi)[:3, :3]
    assert float(facing(x, torch.eye(3), torch.zeros(1, 3), camera.position)) == pytest.approx(1.0)
    assert float(facing(x, z, torch.zeros(1, 3), camera.position)) == pytest.approx(-1.0, abs=1e-6)


def shifted(truth, labels, means, size):
    """The motion, and a place beside its own along the part's long direction, ``size`` away."""
    points = se3.apply(truth, means[labels == 1].double())
    long, axis = torch.linalg.svd(points - points.mean(0), full_matrices=False)[2][0], se3.screw_parameters(truth).axis
    long = long - (axis * (long @ axis) if se3.screw_parameters(truth).angle > 0.1 else 0)
    off = truth.clone()
    off[:3, 3] += size * long / long.norm()
    return off


SURVEYED = PolishConfig(
    steps=60, levels=[64], level_starts=[0.0], rate=5e-3, min_margin=0.0, free_static=0.0, front=-1.0
)


@pytest.mark.parametrize("kind, truth", [("prismatic", slide()), ("revolute", hinge())])
def test_survey_leaves_a_false_minimum(kind, truth):
    states, labels, views = two_states(truth)
    off = shifted(truth, labels, states[0].gaussians.means, 0.12)
    motions = PartMotions([kind], off[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
    stacks = [None, None]  # not looked at: nothing is left out, all views count
    judge = Judge(None, states, views, SURVEYED, stacks, 0, "auto")
    assert survey(judge, motions, [])[1] == []
    moved, which = survey(judge, motions, [0.06, 0.12])
    error = [float((T[:3, 3] - truth[:3, 3]).norm()) for T in (off, moved.transforms[0])]
    assert which == [0] and error[1] < 0.5 * error[0]
    better, which = leave_false_minima(judge, motions, [0.06, 0.12])
    assert which == [0] and float((better.transforms[0, :3, 3] - truth[:3, 3]).norm()) < 0.02
    assert leave_false_minima(judge, motions, []) == (motions, [])


def test_a_place_that_small_photographs_like_less_is_refined_all_the_same(monkeypatch):
    """Of a thin part large photographs alone tell the true place; small ones have it beside."""
    truth = slide()
    states, labels, views = two_states(truth)
    off = shifted(truth, labels, states[0].gaussians.means, 0.12)
    motions = PartMotions(["prismatic"], off[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
    judge = Judge(None, states, views, SURVEYED, [None, None], 0, "auto")  # type: ignore[list-item]
    looked = []

    def blind(tried):  # likes where the part is best, and else what is near the truth
        away = float((tried.transforms[0] - truth)[:3, 3].norm())
        looked.append(away)
        return 0.0 if tried is motions else 1.0 + away

    monkeypatch.setattr(Judge, "at_a_glance", lambda self, steps: SimpleNamespace(cost=blind))
    better, which = leave_false_minima(judge, motions, [0.06])
    assert which == [0] and min(looked) > 0.02  # none of the tries is the place itself
    assert float((better.transforms[0, :3, 3] - truth[:3, 3]).norm()) < 0.02


def test_a_part_at_its_place_stays_there():
    truth = hinge()
    states, labels, views = two_states(truth)
    motions = PartMotions(["revolute"], truth[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
    judge = Judge(None, states, views, SURVEYED, [None, None], 0, "auto")  # type: ignore[list-item]
    kept, _ = leave_false_minima(judge, motions, [0.06, 0.12])
    assert float((kept.transforms[0] - truth).abs().max()) < 0.01


def test_survey_chooses_labels_anew_for_what_surfaces_like_best(monkeypatch):
    """A motion's false place keeps the labels that suit it: of the part only what arrives on the true one."""
    truth, asked = slide(), []
    states, labels, views = two_states(truth)
    means = states[0].gaussians.means
    off = shifted(truth, labels, means, 0.12)
    place = se3.apply(truth, means[labels == 1].double())

    def chosen(found, states, motions):
        at = se3.apply(motions.transforms[0], means.double())
        arrives = torch.cdist(at, place).min(1).values < 0.03
        asked.append(float((motions.transforms[0] - truth)[:3, 3].norm()))
        new = torch.where(arrives, labels, 0)
        return replace(motions, labels=[new, labels])

    def liked(found, transforms, types):
        return float((transforms[0] - truth)[:3, 3].norm())

    monkeypatch.setattr("p2gs.motion.survey.relabelled", chosen)
    monkeypatch.setattr("p2gs.motion.refine_motions.surface_energy", liked)
    margins = [torch.ones(len(labels))] * 2
    motions = chosen(None, states, PartMotions(["prismatic"], off[None], torch.ones(1), [labels, labels], margins))
    assert int((motions.labels[0] == 1).sum()) < 0.9 * int((labels == 1).sum())
    judge = Judge(object(), states, views, SURVEYED, [None, None], 0, "auto")  # type: ignore[arg-type]
    asked.clear()
    moved, which = survey(judge, motions, [0.06, 0.12], candidates=2)
    assert which == [0] and asked == sorted(asked) and len(asked) == 2 and asked[0] < 0.02
    assert torch.equal(moved.labels[0], labels) and float((moved.transforms[0] - truth).norm()) < 0.02


@pytest.mark.parametrize("wall_in_front", [True, False])
def test_a_twins_island_goes_to_what_it_touches_unless_that_is_seen_through(wall_in_front):
    """A patch amid the base is labelled as the part; the other state's camera sees a wall before it all, or looks past
    everything."""
    base, part = sheet([0.0, 0, 0]), sheet([0.0, 0, 1.0])
    points = torch.cat([base, part])
    right = torch.tensor([0] * 400 + [1] * 400)
    wrong = right.clone()
    wrong[150:160] = 1
    away = torch.stack([torch.eye(4).double(), push(-2.0)])  # the part's motion hides what has its label
    camera = look_at(torch.tensor([3.0, 0.0, 0.0]), 32)
    depth = torch.full((32, 32), 2.0 if wall_in_front else 4.0)
    stack = DepthStack([depth] * 3, [torch.ones(32, 32)] * 3, [camera] * 3)
    found = settle_twin_islands(solid(points), wrong, 0.25, away, stack, 0.02)
    assert torch.equal(found, right if wall_in_front else wrong)
    assert settle_twin_islands(solid(points), wrong, 0.0, away, stack, 0.02) is wrong
    held = torch.zeros(len(points), dtype=torch.bool)
    held[wrong != right] = True  # known to be its part's
    assert torch.equal(settle_twin_islands(solid(points), wrong, 0.25, away, stack, 0.02, held), wrong)
    assert torch.equal(settle_twin_islands(solid(points), wrong, 0.25, away, stack, 0.02, ~held), found)
