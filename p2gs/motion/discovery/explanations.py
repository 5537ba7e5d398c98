"""From sets of motions to explanations: labelled, fitted, scored, without what they do not need."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.motion.discovery.amounts import parted
from p2gs.motion.discovery.finish import Explanation, settle_parts
from p2gs.motion.discovery.labels import Graph, Labelling, label
from p2gs.motion.discovery.pool import plausibility
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions, axes_used, without
from p2gs.motion.discovery.search import Search
from p2gs.motion.discovery.verify import image_score

HINGE = 0.5  # cost of moved surface that turns about a line that no hinge would have; what is empty costs 1


def finish(problem: Problem, graphs: list[Graph], motions: Motions, limit: int, axes: Tensor) -> Explanation:
    """Label and fit a chosen set; drop parts without mass, and those that the score is better without."""
    motions, labelling = settle_parts(problem, graphs, motions, axes)
    while (pair := twins(problem, motions, labelling)) is not None:
        motions, labelling = settle_parts(problem, graphs, without(motions, pair), axes)
    while len(motions):
        mass = masses(problem, labelling)
        k = min(range(len(mass)), key=lambda i: mass[i])
        if mass[k] >= problem.config.min_mass:
            break
        motions, labelling = settle_parts(problem, graphs, without(motions, k), axes, rounds=1)
    return prune(problem, graphs, motions, labelling, limit, axes)


def extended(
    problem: Problem, graphs: list[Graph], search: Search, found: Explanation, limit: int, axes: Tensor
) -> Explanation:
    """Parts added, up to ``limit``, while the score falls: of the motions of the pool that promise most for what is
    left over the one with which, all fitted and labelled anew, it falls most.

    The search values a set by what its motions explain where they are, and may do without one that they come near.
    """
    while 0 < len(found.motions) < limit:
        best = found
        for _, more in search.additions(search.pool.add(found.motions).tolist()):
            added = Motions.cat([found.motions, search.pool.motions[torch.tensor(more[-1:])]])
            motions, labelling = settle_parts(problem, graphs, added, axes)
            score = total_score(problem, motions, labelling)
            if len(motions) > len(found.motions) and score < best.score:
                best = Explanation(motions, labelling, score)
        if best is found:
            break
        found = best
    return found


def divided(problem: Problem, graphs: list[Graph], found: Explanation, limit: int, axes: Tensor) -> Explanation:
    """Parts made two by amounts of their own about one axis (``parted``), up to ``limit`` parts, while the score
    falls."""
    while 0 < len(found.motions) < limit:
        best = found
        for k in range(len(found.motions)):
            for motions in parted(problem, graphs, found.labelling, found.motions, k, axes):
                labelling = label(problem, motions, graphs)
                score = total_score(problem, motions, labelling)
                if score < best.score:
                    best = Explanation(motions, labelling, score)
        if best is found:
            break
        motions, labelling = settle_parts(problem, graphs, best.motions, axes, rounds=1)
        score = total_score(problem, motions, labelling)
        found = min(best, Explanation(motions, labelling, score), key=lambda e: e.score)
    return found


def again(
    problem: Problem, graphs: list[Graph], search: Search, found: list[Explanation], limit: int, axes: Tensor
) -> list[Explanation]:
    """What the search makes of the best explanations once their motions are fitted: sets that are new to it, finished.

    A wrong motion is often there because a rough one left over what it explains.
    """
    known = [search.pool.add(e.motions).tolist() for e in found]
    out = []
    for start in sorted(range(len(found)), key=lambda i: found[i].score)[:2]:
        chosen = search.improve(search.refit(known[start]))
        if chosen and not any(search.same(chosen, other) for other in known):
            known.append(chosen)
            motions = search.pool.motions[torch.tensor(chosen)]
            out.append(finish(problem, graphs, motions, limit, axes))
    return out


def ranked(search: Search, found: list[Explanation]) -> list[Explanation]:
    """Best first, without those whose motions all agree with a better one's."""
    out: list[Explanation] = []
    for e in sorted(found, key=lambda e: e.score):
        if not any(search.agree(e.motions, better.motions) for better in out):
            out.append(e)
    return out


def prune(
    problem: Problem, graphs: list[Graph], motions: Motions, labelling: Labelling, limit: int, axes: Tensor
) -> Explanation:
    """Drop parts, the least needed first, down to ``limit`` and while the explanation of both states' images gets no
    worse without them."""
    score = total_score(problem, motions, labelling)
    while len(motions) > 1:
        tried = []
        for k in range(len(motions)):
            fewer = without(motions, k)
            tried.append((total_score(problem, fewer, label(problem, fewer, graphs)), k, fewer))
        least, _, fewer = min(tried, key=lambda t: t[:2])
        if least > score and len(motions) <= limit:
            break
        motions, labelling = settle_parts(problem, graphs, fewer, axes, rounds=1)
        score = total_score(problem, motions, labelling)
    return Explanation(motions, labelling, score)


def total_score(problem: Problem, motions: Motions, labelling: Labelling) -> float:
    """Image-space violation, the price of the parts and what hinges cost that no hinge would be. Lower is better.

    A further slide along the very direction of another costs a third: of its three freedoms it takes one.
    """
    axes = axes_used(motions)
    price = problem.config.part_cost * (axes + (len(motions) - axes) / 3)
    return image_score(problem, motions, labelling) + price + HINGE * unlikely_hinges(problem, motions, labelling)


def unlikely_hinges(problem: Problem, motions: Motions, labelling: Labelling) -> float:
    """Share of the moved surface that turns about lines that no hinge would have (``plausibility``). 0..1.

    A plain flap turned over lands on itself as well as one that turned about its hinge, beside which it hardly moves.
    """
    turns = motions[motions.turn]
    if not len(turns):
        return 0.0
    pays = [p for p, _ in problem.pay(turns)]
    doubt = 1 - plausibility(problem, turns, pays, problem.samples, False)
    return float((torch.tensor(masses(problem, labelling))[motions.turn] * doubt).sum())


def twins(problem: Problem, motions: Motions, labelling: Labelling) -> int | None:
    """The smaller part of two that touch and whose motions carry their points to the same places, to within the
    tolerance across surfaces: surfaces cannot tell them apart (the photographs are asked later). None where there are
    no such two."""
    mass = masses(problem, labelling)
    for small in sorted(range(len(motions)), key=mass.__getitem__):
        for large in (k for k in range(len(motions)) if k != small):
            for s in (0, 1):
                a, b = (problem.surfels[s].points[labelling.labels(s) == k + 1] for k in (small, large))
                if len(a) and len(b) and touching(a, b, problem.scale.spacing):
                    gap = motions[small : small + 1].apply(a, s == 1) - motions[large : large + 1].apply(a, s == 1)
                    if float(gap.pow(2).sum(-1).mean().sqrt()) < problem.scale.tp:
                        return small
    return None


def touching(a: Tensor, b: Tensor, spacing: float) -> bool:
    """Do some of the surfels a [N, 3] lie as near to b [M, 3] as neighbours on one surface do?"""
    return bool((cKDTree(b.numpy()).query(a.numpy())[0] < 2 * spacing).sum() > 2)


def masses(problem: Problem, labelling: Labelling) -> list[float]:
    """Share of the moved surface of both states of each part."""
    out = torch.zeros(labelling.probability[0].shape[1])
    for s in (0, 1):
        out.index_add_(0, labelling.labels(s), problem.trust[s] * problem.moved[s])
    return (out[1:] / out.sum().clamp_min(1e-9)).tolist()
