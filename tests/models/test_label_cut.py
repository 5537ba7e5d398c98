"""Which Gaussians move with a part, by one least cut: against every labelling of a few nodes, and on a plain cap that
is pulled up along itself."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.ops.graph_cut import cut_of_edges
from p2gs.ops.sh import rgb_to_dc
from p2gs.parts.expand import expansions
from p2gs.parts.label_cut import Nodes, least_border, spread
from p2gs.types import GaussianTensors

ROUND, STEP = 24, 0.1  # points of a ring, distance of rings and points
BODY, CAP, LIFT = 12, 5, 2  # rings of each, and how far the cap goes up
WHITE, BROWN, BLACK = 0.9, 0.3, 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_cut_of_twelve_nodes_is_the_least_of_all_labellings(seed):
    rng = np.random.default_rng(seed)
    n, e = 12, 40
    tail, head, capacity = rng.integers(0, n, e), rng.integers(0, n, e), rng.integers(0, 9, e)
    pull = rng.integers(-6, 7, n)

    def cost(side):
        return capacity[side[tail] & ~side[head]].sum() + pull[~side & (pull > 0)].sum() - pull[side & (pull < 0)].sum()

    least = min(cost(np.array(side)) for side in product([False, True], repeat=n))
    flow, side = cut_of_edges(tail, head, capacity, pull)
    assert flow == least == cost(side == 1) == cost(side != 0)


def bottle(lifted: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points [N, 3], brightness [N] and whether of the cap [N] of a bottle's side: a brown body with a black band at
    its foot, its rings hidden where a white cap stands on them, ``lifted`` rings up."""
    ring = torch.arange(ROUND) * STEP
    rows = [(z, BLACK if 2 <= z < 4 else BROWN, False) for z in range(BODY + lifted)]
    rows += [(BODY + lifted + z, WHITE, True) for z in range(CAP)]
    points = torch.cat([torch.stack([ring, torch.zeros(ROUND), torch.full((ROUND,), z * STEP)], 1) for z, _, _ in rows])
    of_ring = [torch.tensor([of[i] for of in rows]).repeat_interleave(ROUND) for i in (1, 2)]
    return points, of_ring[0], of_ring[1].bool()


def lift() -> torch.Tensor:
    T = torch.eye(4).double()
    T[2, 3] = LIFT * STEP
    return T


def torn() -> tuple[list[Nodes], list[torch.Tensor]]:
    """Nodes of both states of which the part has the cap's uppermost ring alone, and what is the cap's."""
    nodes, true = [], []
    for state in (0, 1):
        points, bright, cap = bottle(LIFT * state)
        row = (points[:, 2] / STEP).round()
        has = row == row.max()
        cannot = (bright == BLACK) | (row < 2)  # the band would not fit, nor would what is under it
        nodes.append(Nodes(torch.arange(len(points)), points, bright[:, None].expand(-1, 3), has, cannot))
        true.append(cap)
    return nodes, true


def test_a_cap_that_slides_along_itself_is_found_whole():
    nodes, true = torn()
    mine = least_border(nodes, lift(), 0.2, 0.3 * STEP)
    assert [bool((a == b).all()) for a, b in zip(mine, true, strict=True)] == [True, True]


def test_states_exchanged_give_the_same_labels():
    nodes, _ = torn()
    there = least_border(nodes, lift(), 0.2, 0.3 * STEP)
    back = least_border(nodes[::-1], torch.linalg.inv(lift()), 0.2, 0.3 * STEP)
    assert all(bool((a == b).all()) for a, b in zip(there, back[::-1], strict=True))


def test_without_a_step_in_colour_the_part_keeps_what_it_has():
    nodes, _ = torn()
    for of in nodes:
        of.colours = torch.full_like(of.colours, BROWN)
    mine = least_border(nodes, lift(), 0.2, 0.3 * STEP)
    assert all(bool((m >= of.has).all()) and not bool((m & of.cannot).any()) for m, of in zip(mine, nodes, strict=True))


def judge_of_the_bottle() -> tuple[SimpleNamespace, PartMotions, list[torch.Tensor]]:
    """A judge of the bottle's Gaussians, an explanation by two slides of which the second has the cap's lowest rings,
    and what is the cap's."""
    states, labels, kept, true = [], [], [], []
    for (nodes, cap), state in zip(zip(*torn(), strict=True), (0, 1), strict=True):
        n = len(nodes.points)
        sh = rgb_to_dc(nodes.colours)[:, None]
        g = GaussianTensors(
            nodes.points, torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4), torch.zeros(n, 3), torch.full((n,), 4.0), sh
        )
        g.opacity_logits[::7] = -2.0  # faint ones go with the nearest solid one
        row = (nodes.points[:, 2] / STEP).round()
        second = cap & (row < row[cap].min() + 2) & (state == 0)
        second |= cap & (row == row.max() - 1) & (state == 1)
        labels.append(torch.where(nodes.has, 1, torch.where(second, 2, 0)))
        kept.append(~nodes.cannot)
        states.append(SimpleNamespace(gaussians=g, state=state))
        true.append(cap)
    T = torch.stack([lift(), lift() @ lift()])
    motions = PartMotions(["prismatic"] * 2, T, torch.ones(2), labels, [torch.ones(len(own)) for own in labels])
    seen = [SimpleNamespace(kept=k, lit=SimpleNamespace(sh=s.gaussians.sh)) for k, s in zip(kept, states, strict=True)]
    config = SimpleNamespace(other_colour=0.2, free_static=0.3 * STEP)
    judge = SimpleNamespace(states=states, seen=lambda motions: seen, config=config)
    return judge, motions, true


def test_a_part_is_tried_with_another_ones_surface_where_it_then_has_most_of_it():
    judge, motions, true = judge_of_the_bottle()
    tried = {(how, k): m for how, k, m in expansions(judge, motions)}
    whole = tried["took part 1", 0]
    assert len(whole) == 1
    assert [int((own == 1).ne(cap).sum()) for own, cap in zip(whole.labels, true, strict=True)] == [0, 0]
    held = spread(judge, motions, 0)
    assert all(bool((a == 2).eq(b == 2).all()) for a, b in zip(held.labels, motions.labels, strict=True))


def test_few_gaussians_stay_as_they_are():
    judge, motions, _ = judge_of_the_bottle()
    for state in judge.states:
        state.gaussians.opacity_logits[:] = -2.0
    assert spread(judge, motions, 0) is motions
