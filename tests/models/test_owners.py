"""What is hidden in the other state goes to the drawer whose front hides it, and to nothing else."""

import torch
from test_openings import DARK, OUTSIDE, SIZE, outer, panel, photograph

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3
from p2gs.parts.owners import hidden_to_owners, hiders, label_maps, owners
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.evidence import gather_evidence

OUT = 0.25  # how far the drawers come out, along y


def front(left: bool) -> GaussianTensors:
    return panel([-0.4 if left else 0.02, 0.3, -0.3], [0.38, 0, 0], [0, 0, 0.6], OUTSIDE)


def floor(left: bool) -> GaussianTensors:
    return panel([-0.35 if left else 0.07, -0.1, -0.2], [0.28, 0, 0], [0, 0.35, 0], DARK)


def moved(g: GaussianTensors) -> GaussianTensors:
    return g.placed(g.means + torch.tensor([0.0, OUT, 0.0]), g.quats)


def chest(kinds=("prismatic", "prismatic")):
    """A chest with two drawers side by side, shut (their floors unseen) and open; the right one's floor is labelled as
    the left one's."""
    pieces = [
        [outer(), front(True), front(False)],
        [outer(), *(moved(x) for x in (front(True), front(False), floor(True), floor(False)))],
    ]
    given = [[0, 1, 2], [0, 1, 2, 1, 1]]
    states = [GaussianTensors.cat(p) for p in pieces]
    labels = [
        torch.cat([torch.full((len(g),), k) for g, k in zip(p, ks, strict=True)])
        for p, ks in zip(pieces, given, strict=True)
    ]
    slide = torch.eye(4).double()
    slide[1, 3] = OUT
    motions = PartMotions(
        list(kinds), torch.stack([slide, slide]), torch.ones(2), labels, [torch.ones(len(x)) for x in labels]
    )
    stacks = []
    for s, g in enumerate(states):
        e = gather_evidence(g, photograph(g, s), SIZE, 0.5)
        stacks.append(DepthStack(e.depths, e.alphas, e.cameras))
    return [StateGaussians(s, g) for s, g in enumerate(states)], motions, stacks, [len(x) for x in pieces[1]]


def test_a_drawers_floor_goes_to_the_front_that_hides_it():
    states, motions, stacks, sizes = chest()
    told, changed = hidden_to_owners(states, motions, stacks, backend="auto")
    base, left, right, left_floor, right_floor = torch.split(told.labels[1], sizes)
    assert (right_floor == 2).float().mean() > 0.7 and (
        left_floor == 1
    ).float().mean() > 0.95  # its far end lies behind both
    assert (base == 0).all() and (left == 1).all() and (right == 2).all()
    assert torch.equal(told.labels[0], motions.labels[0]) and changed == [
        0,
        int((right_floor == 2).sum() + (left_floor != 1).sum()),
    ]
    assert (motions.labels[1][-sizes[-1] :] == 1).all()  # what was given is not written to


def test_doors_take_nothing():
    for kinds in (("revolute", "revolute"), ("prismatic", "revolute")):
        states, motions, stacks, _ = chest(kinds)
        told, changed = hidden_to_owners(states, motions, stacks, backend="auto")
        assert changed == [0, 0] and torch.equal(told.labels[1], motions.labels[1])


def test_what_belongs_to_the_base_or_is_seen_stays():
    states, motions, stacks, sizes = chest()
    g, away = states[1].gaussians, se3.inverse(motions.transforms)
    maps = label_maps(states[0].gaussians, motions.labels[0], 3, stacks[0], "auto", "cpu")
    rows = torch.arange(len(g) - sizes[-1], len(g))
    takers = torch.tensor([False, True, True])
    base = motions.labels[1].clone()
    base[rows] = 0
    one = torch.zeros(len(rows), dtype=torch.int64)
    assert torch.equal(owners(g, base, away, stacks[0], maps, one, rows, takers), base)
    shown = g.placed(g.means + torch.tensor([0.0, 0.5, 0.0]), g.quats)  # before the fronts: views see it would be there
    assert torch.equal(owners(shown, motions.labels[1], away, stacks[0], maps, one, rows, takers), motions.labels[1])


def test_what_its_part_never_hides_need_not_have_moved():
    states, motions, stacks, sizes = chest()
    # all of it the base's
    maps = label_maps(states[0].gaussians, torch.zeros_like(motions.labels[0]), 3, stacks[0], "auto", "cpu")
    g, away = states[1].gaussians, se3.inverse(motions.transforms)
    inside = g.placed(g.means - torch.tensor([0.0, 0.18, 0.0]), g.quats)  # the floors, hidden where they are as well
    rows = torch.arange(len(g) - sizes[-1], len(g))
    rows = rows[(inside.means[rows, 1] > 0.0) & (inside.means[rows, 1] < 0.25)]
    group, takers = torch.zeros(len(rows), dtype=torch.int64), torch.tensor([False, True, True])
    assert (
        len(rows) > 20
        and (owners(inside, motions.labels[1], away, stacks[0], maps, group, rows, takers)[rows] == 0).all()
    )
    # hidden once carried back as far, but seen to be empty where they are
    out = g.placed(g.means + torch.tensor([0.0, 0.3, 0.0]), g.quats)
    away[:, 1, 3] -= 0.45
    assert (owners(out, motions.labels[1], away, stacks[0], maps, group, rows, takers)[rows] == 1).all()


def test_what_views_see_before_a_point():
    states, motions, stacks, _ = chest()
    maps = label_maps(states[0].gaussians, motions.labels[0], 3, stacks[0], "auto", "cpu")
    points = torch.tensor([[-0.2, 0.25, 0.0], [0.2, 0.25, 0.0], [0.2, 0.6, 0.0], [0.2, 0.25, 90.0]])
    hidden, seen = hiders(points, stacks[0], maps, 3)
    views = len(stacks[0])
    assert hidden[0, 1] > 3 * hidden[0, 2] and hidden[1, 2] > 3 * hidden[1, 1] and seen[0] == seen[1] == 0
    assert hidden[:2].sum(1).tolist() == [views, views]  # the chest's sides hide them from behind
    assert seen[2] >= 4 and hidden[3].sum() + seen[3] == 0  # out in front; in no picture
    K, pose, depth = stacks[0].K[0], stacks[0].viewmat[0], stacks[0].depth[0]  # one view, by hand
    local = pose[:3, :3] @ points[0] + pose[:3, 3]
    x, y = ((K @ local)[:2] / local[2]).long().tolist()
    assert depth[y, x] < local[2] - 0.015 and hiders(points[:1], stacks[0], maps[:1], 3)[0][0].argmax() == maps[0][y, x]
