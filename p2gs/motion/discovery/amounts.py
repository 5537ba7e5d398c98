"""Bodies that move about one axis by amounts of their own: which two amounts explain what one does not.

Stacked doors and neighbouring drawers share an axis and differ in how far they went. One free motion imitates two of
them: the hinge of two stacked doors tilts a little, and the upper turns farther than the lower. So pairs are sought
about the part's own axis and about directions that the object has anyway.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from p2gs.motion.discovery.finish import snapped
from p2gs.motion.discovery.labels import Graph, Labelling, unary
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions, without

STEPS = 200  # at most


def arm_of(problem: Problem, labelling: Labelling, motion: Motions, k: int) -> float:
    """Root mean square distance of part k's surfels from the axis of ``motion`` [1]; 1 for a slide (scene units)."""
    if not bool(motion.turn):
        return 1.0
    d = torch.cat([problem.surfels[s].points[labelling.labels(s) == k + 1] for s in (0, 1)]) - motion.centre
    away = d.pow(2).sum(1) - (d @ motion.axis[0]).pow(2)
    return max(float(away.mean().clamp_min(0).sqrt()), problem.scale.tp) if len(away) else problem.scale.diag


def amounts_of(problem: Problem, motion: Motions, arm: float) -> Motions:
    """``motion`` [1] by every amount of its sign that the search considers, as far apart as surfaces tell at ``arm``
    from the axis: [D]."""
    cfg, scale = problem.config, problem.scale
    most = math.radians(cfg.max_angle) if bool(motion.turn) else cfg.max_slide * problem.scale.diag
    least = scale.tp / arm
    n = min(max(int((most - least) / (scale.apart / arm)), 2), STEPS)
    amount = torch.linspace(least, most, n) * torch.sign(motion.amount)
    return Motions(
        motion.turn.expand(n), motion.axis.expand(n, 3), motion.centre.expand(n, 3), amount, motion.thick.expand(n)
    )


def best_pair(
    problem: Problem, graphs: list[Graph], labelling: Labelling, motions: Motions, k: int, axis: Motions
) -> Motions:
    """The two amounts [2] about the axis of ``axis`` [1] that leave least of the moved surface unexplained, beside all
    motions but ``k``.

    A surfel costs what it does under the better of the two or under what else there is, averaged over its neighbours.
    """
    many = amounts_of(problem, axis, arm_of(problem, labelling, axis, k))
    rest = without(motions, k)
    total = torch.zeros(len(many), len(many))
    for s in (0, 1):
        index = problem.moved[s].nonzero()[:, 0]
        if not len(index):
            continue
        cost = averaged(problem.cost(many, s, index)[0].T, index, graphs[s])
        other = averaged(unary(problem, rest, s)[index].amin(1, keepdim=True), index, graphs[s])
        cost, weight = torch.minimum(cost, other), problem.trust[s][index]
        for a in range(len(many)):
            total[a] += weight @ torch.minimum(cost, cost[:, a : a + 1])
    total.fill_diagonal_(torch.inf)
    return many[torch.tensor(divmod(int(total.argmin()), len(many)))]


def averaged(values: Tensor, index: Tensor, graph: Graph, rounds: int = 8) -> Tensor:
    """values [M, D] of surfels ``index`` [M], half of each its own and half its neighbours' of these, ``rounds``
    times."""
    full, have = torch.zeros(len(graph.neighbours), values.shape[1]), torch.zeros(len(graph.neighbours), 1)
    full[index], have[index] = values, 1.0
    mass = graph.average(have).clamp_min(1e-3)
    for _ in range(rounds):
        full = graph.average(full) / mass * have
        full[index] = 0.5 * full[index] + 0.5 * values
    return full[index]


def parted(
    problem: Problem, graphs: list[Graph], labelling: Labelling, motions: Motions, k: int, axes: Tensor
) -> list[Motions]:
    """The motions with the best pair of amounts instead of part k's one, the second last: about its own axis, and about
    it turned onto directions ``axes`` [D, 3] that the object has."""
    own = motions[k : k + 1]
    mine = torch.cat(
        [
            problem.surfels[0].points[labelling.labels(0) == k + 1],
            own.apply(problem.surfels[1].points[labelling.labels(1) == k + 1], True)[0],
        ]
    )
    if not len(mine):
        return []
    on = snapped(problem, own, mine.mean(0), axes)
    out = []
    for axis in [own, *(on[i : i + 1] for i in range(len(on)))]:
        pair = best_pair(problem, graphs, labelling, motions, k, axis)
        out.append(Motions.cat([motions[:k], pair[:1], motions[k + 1 :], pair[1:]]))
    return out
