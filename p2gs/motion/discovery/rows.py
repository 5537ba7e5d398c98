"""Drawers in a row: each body that slid along one direction has an amount of its own, found from its own surface.

Like drawers that went about as far are one motion to a search that asks what explains most: along a drawer's sides
nothing tells its amount, and the fronts that do are few. But a front lies in a plane of its own, and that plane is
either where it was or where it came to.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.motion.discovery.amounts import amounts_of
from p2gs.motion.discovery.labels import Labelling
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions
from p2gs.ops.components import TOUCH, components

FACING = 0.95  # cosine: within 18 degrees a surface stands across the direction


def rows(problem: Problem, labelling: Labelling, motions: Motions, axes: Tensor) -> list[Motions]:
    """For each direction of ``axes`` [D, 3] along which several bodies slid: their motions instead of the slides along
    it. And for each part, instead of its motion, each slide along one of them that its own surface asks for: a tray
    that is turned into the body lands on surface, too, but its front stands where no turn takes it."""
    out = []
    for axis in axes:
        along = ~motions.turn & ((motions.axis @ axis).abs() > FACING)
        bodies = slid(problem, labelling, along, axis)
        if len(bodies) > max(int(along.sum()), 1):
            out.append(Motions.cat([motions[~along], bodies]))
        for k in range(len(motions)):
            own = slid(problem, labelling, torch.arange(len(motions)) == k, axis)
            out += [Motions.cat([motions[:k], own[i : i + 1], motions[k + 1 :]]) for i in range(len(own))]
    return out


def slid(problem: Problem, labelling: Labelling, along: Tensor, axis: Tensor) -> Motions:
    """Slides along ``axis`` [3] or against it, one for each different amount that a moved surface across it asks for.

    Of two that are nearer than what tells two places apart the one that more surface asks for stays. Surface of parts
    that ``along`` [K] leaves out has its motion."""
    amounts, sizes = [], []
    for s in (0, 1):
        surfels, labels = problem.surfels[s], labelling.labels(s)
        theirs = torch.cat([torch.tensor([True]), along])[labels]
        index = (problem.moved[s] & theirs & ((surfels.normals @ axis).abs() > FACING)).nonzero()[:, 0]
        for body in planes(surfels.points[index], axis, problem.scale.spacing, problem.scale.apart):
            if len(body) < problem.config.min_moved:
                continue
            amount, cost = own_amount(problem, s, index[body], axis)
            if cost < problem.config.unexplained:
                amounts.append(amount)
                sizes.append(len(body))
    kept: list[float] = []
    for i in sorted(range(len(amounts)), key=lambda i: -sizes[i]):
        if all(abs(amounts[i] - a) > problem.scale.apart for a in kept):
            kept.append(amounts[i])
    n = len(kept)
    return Motions(
        torch.zeros(n, dtype=torch.bool), axis.expand(n, 3), torch.zeros(n, 3), torch.tensor(kept), torch.zeros(n)
    )


def planes(points: Tensor, axis: Tensor, spacing: float, apart: float) -> list[Tensor]:
    """Connected pieces of points [N, 3] that lie in one plane across ``axis``: indices of each. Neighbours are within
    ``TOUCH`` ``spacing`` along the plane and ``apart`` across it."""
    reach = TOUCH * spacing
    flat = points + axis * ((reach / apart - 1) * (points @ axis))[:, None]
    piece = torch.from_numpy(components(flat.double(), reach))
    return [(piece == k).nonzero()[:, 0] for k in piece.unique()]


def own_amount(problem: Problem, state: int, index: Tensor, axis: Tensor) -> tuple[float, float]:
    """The amount along ``axis``, of either sign, under which surfels ``index`` of a state cost least, and that cost
    (0..1)."""
    best = (0.0, 1.0)
    points = problem.surfels[state].points[index]
    for sign in (1.0, -1.0):
        one = Motions(torch.tensor([False]), axis[None], torch.zeros(1, 3), torch.tensor([sign]), torch.zeros(1))
        many = amounts_of(problem, one, 1.0)
        cost, met = problem.cost(many, state, index)
        k = int(cost.mean(1).argmin())
        if float(cost[k].mean()) < best[1]:
            # within a tolerance all amounts cost next to nothing: from plane to plane says which
            way = (problem.surfels[1 - state].points[met[k].long()] - points) @ axis
            best = (float(way.median()) * (1 if state == 0 else -1), float(cost[k].mean()))
    return best
