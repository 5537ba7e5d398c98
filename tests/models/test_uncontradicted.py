"""Photographs do not overrule the surfaces of a plate of which the states show different sides."""

from types import SimpleNamespace

import torch

from p2gs.models.discovery.pipeline import SurfaceStacks
from p2gs.models.handover import PartMotions
from p2gs.models.refine_motions import NOISE, uncontradicted
from p2gs.ops import se3


class Told(SurfaceStacks):
    """Surfaces that land as the test says: cost by the motion's x, and what the other side saves."""

    def __init__(self, cost, saved):
        list.__init__(self, [None, None])
        self.cost, self.saved = cost, saved

    def surfel_labels(self, gaussians, labels):
        return labels

    def arrival(self, labels, transforms, types, part):
        return self.cost(float(transforms[part, 0, 3])), self.saved[part]


def slide(x: float) -> torch.Tensor:
    return se3.make(torch.eye(3).double(), torch.tensor([x, 0.0, 0.0]).double())


def taken(cost, saved, before: float = 0.125, after: float = 0.5) -> list[float]:
    states = [SimpleNamespace(gaussians=SimpleNamespace(means=torch.zeros(4, 3)))] * 2
    T = torch.stack([slide(before)] * 2)
    motions = PartMotions(["revolute"] * 2, T, torch.ones(2), [torch.ones(4, dtype=torch.long)] * 2, [torch.ones(4)] * 2)
    return uncontradicted(states, motions, torch.stack([slide(after)] * 2), Told(cost, saved))[:, 0, 3].tolist()


def test_a_plate_that_lands_worse_stays_and_a_part_of_one_side_follows_the_photographs():
    assert taken(lambda x: x, saved=[2 * NOISE, 0.5 * NOISE]) == [0.125, 0.5]


def test_what_lands_as_well_follows_the_photographs():
    assert taken(lambda x: 0.2 + 0.5 * NOISE * (x > 0.3), saved=[2 * NOISE] * 2) == [0.5, 0.5]
    assert taken(lambda x: -x, saved=[2 * NOISE] * 2) == [0.5, 0.5]
