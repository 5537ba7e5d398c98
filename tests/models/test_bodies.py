"""A part is one body."""

from __future__ import annotations

import torch

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3
from p2gs.ops.components import components
from p2gs.parts.bodies import FEWEST, Surfaces, bodies_of, one_part_a_body
from p2gs.types import GaussianTensors


class Seen:
    """A state's depth: empty where ``free`` [N, 3] -> [N] bool says so, unknown elsewhere."""

    def __init__(self, free):
        self.free = free

    def counts(self, points, tau, views=None):
        free = 9.0 * self.free(points)
        return free, torch.zeros_like(free), torch.zeros_like(free)


def plate(x: float) -> torch.Tensor:
    """10 x 10 points, 0.02 apart, of a plate in the plane z = 0 that begins at ``x``."""
    g = torch.arange(10) * 0.02
    return torch.cartesian_prod(g + x, g, torch.zeros(1))


def slide(z: float = 0.3) -> torch.Tensor:
    return se3.make(torch.eye(3).double(), torch.tensor([0.0, 0.0, z]).double())


def surfaces(points: torch.Tensor, labels: torch.Tensor, free) -> Surfaces:
    end = points + torch.tensor([0.0, 0.0, 0.3]) * (labels == 1)[:, None]
    return Surfaces([points, end], [labels, labels], 0.02, [Seen(free), Seen(free)], 0.01)


def nowhere(points):
    return torch.zeros(len(points), dtype=torch.bool)


def between(points):
    return (points[:, 0] > 0.2) & (points[:, 0] < 0.39)


TWO = torch.cat([plate(0.0), plate(0.4)])  # 0.22 of nothing between them


def test_pieces_are_what_touches():
    assert components(TWO.double(), 0.05).max() == 1 and components(TWO.double(), 0.25).max() == 0


def test_plates_that_a_look_goes_between_are_two_bodies():
    ones = torch.ones(200, dtype=torch.long)
    assert [len(r[0]) for r in bodies_of(surfaces(TWO, ones, between), 0, slide(), True)] == [100, 100]


def test_plates_that_may_hang_together_unseen_are_one():
    ones = torch.ones(200, dtype=torch.long)
    assert [len(r[0]) for r in bodies_of(surfaces(TWO, ones, nowhere), 0, slide(), True)] == [200]


def test_what_stands_between_parts_them():
    """No look goes through, but another part's surface fills the gap; it may have a slot."""
    wall = torch.cat([plate(0.21)])
    labels = torch.cat([torch.ones(200), torch.zeros(100)]).long()
    both = surfaces(torch.cat([TWO, wall]), labels, nowhere)
    assert [len(bodies_of(both, 0, slide(), held)) for held in (True, False)] == [2, 1]


def test_two_like_bodies_of_a_small_part_are_two():
    """Latches of a box: a dozen points each."""
    small = torch.cat([plate(0.0)[: FEWEST - 5], plate(0.4)[: FEWEST - 8]])
    ones = torch.ones(len(small), dtype=torch.long)
    assert [len(r[0]) for r in bodies_of(surfaces(small, ones, between), 0, slide(), True)] == [FEWEST - 5, FEWEST - 8]


def test_crumbs_are_no_bodies():
    few = torch.cat([plate(0.0), plate(0.4)[: FEWEST - 1]])
    rows = bodies_of(surfaces(few, torch.ones(len(few), dtype=torch.long), between), 0, slide(), True)
    assert len(rows) == 1 and len(rows[0][0]) == len(few)


def state(number: int, means: torch.Tensor) -> StateGaussians:
    n = len(means)
    g = GaussianTensors(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), -4.0),
        torch.full((n,), 4.0),
        torch.zeros(n, 1, 3),
    )
    return StateGaussians(number, g)


def test_each_body_is_a_part_and_every_gaussian_goes_to_the_next_one():
    ones = torch.ones(200, dtype=torch.long)
    seen = surfaces(TWO, ones, between)
    extra = torch.tensor([[0.25, 0.1, 0.0], [0.36, 0.1, 0.0]])  # crumbs
    states = [state(s, torch.cat([seen.points[s], extra + torch.tensor([0.0, 0.0, 0.3 * s])])) for s in (0, 1)]
    labels = [torch.ones(202, dtype=torch.long)] * 2
    motions = PartMotions(["prismatic"], slide()[None], torch.tensor([0.7]), labels, [torch.ones(202)] * 2)
    parted, log = one_part_a_body(states, motions, seen, limit=5)
    assert len(parted) == 2 and parted.types == ["prismatic"] * 2 and len(parted.confidence) == 2 and len(log) == 1
    for of in parted.labels:
        first, second = of[:100].unique(), of[100:200].unique()
        assert len(first) == len(second) == 1 and first != second
        assert of[200] == first and of[201] == second
    same, log = one_part_a_body(states, motions, seen, limit=1)
    assert len(same) == 1 and not log
