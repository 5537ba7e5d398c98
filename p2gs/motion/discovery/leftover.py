"""What no motion explains, searched by itself: amid all that moved, a part of a hundredth of it is next to nothing."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.motion.discovery.hypotheses import angles_of, directions, static_axes, sweep
from p2gs.motion.discovery.labels import label
from p2gs.motion.discovery.problem import Problem, resampled, smooth_mask
from p2gs.motion.discovery.proposals import as_motions, sided, stacked
from p2gs.motion.discovery.result import Discovery
from p2gs.motion.discovery.rigid import Motions
from p2gs.motion.discovery.search import ExclusiveGain, Search
from p2gs.motion.discovery.verify import light_of, violation

SETS = 2  # best sets of motions that are taken from


def left_over(found: Discovery, transforms: Tensor, types: list[str]) -> list[tuple[Tensor, str]]:
    """Motions [4, 4] that best explain the surface that ``transforms`` [K, 4, 4] of ``types`` do not explain, and their
    types: the search of ``discover`` among that surface alone. For a slide the turns, too, that take its middle to the
    same place: of a small part that hardly turns they differ by little. Empty where next to nothing is left."""
    if found.search is None:
        return []
    config = found.problem.config
    unexplained = contradicted(found, as_motions(transforms, types))
    if min(int(m.sum()) for m in unexplained) < config.min_moved:
        return []
    problem = resampled(replace(found.problem, moved=unexplained), 0)
    axes = torch.cat([directions(problem), static_axes(problem)])
    search = Search(problem, sweep(problem, axes), config.max_parts - 1, config.part_cost)
    chosen = sorted({k for _, some in search.solve()[:SETS] for k in some})
    if not chosen:
        return []
    motions = search.pool.motions[torch.tensor(chosen)]
    gain = ExclusiveGain(problem, problem.samples, problem.weights)
    for k in (~motions.turn).nonzero()[:, 0].tolist():
        turns = as_turns(problem, motions[k : k + 1], axes)
        if len(turns):
            motions = Motions.cat([motions, search.sharpened(turns, gain, 2)[0]])
    return list(zip(*stacked(motions), strict=True))


def contradicted(found: Discovery, motions: Motions) -> list[Tensor]:
    """[N] bool by state: the moved surfels that these motions and the best labels leave where something contradicts
    them, single ones left out."""
    problem, out = found.problem, []
    motions = sided(problem, motions)
    labelling = label(problem, motions, found.graphs, revealed=True)
    light = light_of(problem, motions, labelling)
    for s, surfels in enumerate(problem.surfels):
        cost = violation(problem, motions, labelling, s, torch.arange(len(surfels)), light=light)
        out.append(smooth_mask(surfels.points, problem.moved[s] & (cost > problem.config.unexplained)))
    return out


def as_turns(problem: Problem, slide: Motions, axes: Tensor) -> Motions:
    """Turns about ``axes`` [D, 3] by all angles that are searched which take the middle of what ``slide`` [1] carries
    where it does."""
    pay = problem.pay(slide)[0][0][0]
    if float(pay.sum()) <= 0:
        return Motions.empty()
    middle = (problem.surfels[0].points[problem.samples[0]] * pay[:, None]).sum(0) / pay.sum()
    angles = angles_of(problem.config)
    angles = torch.cat([angles, -angles])
    axis, angle = axes.repeat_interleave(len(angles), 0), angles.repeat(len(axes))
    way = slide.axis * slide.amount[:, None]
    way = way - axis * (way * axis).sum(1, keepdim=True)
    centre = middle + way / 2 + torch.linalg.cross(axis, way) / (2 * torch.tan(angle / 2))[:, None]
    return Motions(torch.ones(len(angle), dtype=torch.bool), axis, centre, angle)
