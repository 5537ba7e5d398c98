"""Parts that lie beside their place along their own surface: a plain door shifted along itself still covers most of its
place, a minimum of its own, centimetres from the true one, that no descent leaves."""

from __future__ import annotations

from functools import partial
from typing import Iterator

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.motion_steps import allowed_step, apply_step
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled
from p2gs.native import at_once
from p2gs.ops import se3


def survey(
    judge: Judge, motions: PartMotions, reach: list[float], candidates: int | None = None
) -> tuple[PartMotions, list[int]]:
    """Each part shifted within its own surface, for a refinement to go on from.

    reach: shifts tried to both sides of the part's two long directions (internal units).  candidates: of a part's
    shifts, how many that the surfaces like best are looked at (None: all), with labels chosen anew: those that suit a
    wrong place hold the part there; it is laid where the energy is lowest by the smallest photographs
    (``Judge.gain``).  Without surfaces (``judge.found``) labels stay, and each part is laid at the shift that the
    smallest photographs like best, even if they like its present place better: a thin part's true place is told by
    large ones alone.  Returns the motions and which of them moved.
    """
    glance, moved = judge.at_a_glance(judge.config.steps), []
    for k in range(len(motions)):
        laid, tries = motions, list(_shifted(judge, motions, k, reach))
        if judge.found is None:
            laid = min(tries, key=glance.cost, default=motions)
        else:
            asked = at_once(judge.surfaces, tries)
            best = [tries[i] for i in sorted(range(len(tries)), key=asked.__getitem__)[:candidates]]
            for tried in at_once(partial(relabelled, judge.found, judge.states), best):
                if glance.gain(tried, laid) > 0:
                    laid = tried
        if laid is not motions:
            motions = laid
            moved.append(k)
    return motions, moved


def _shifted(judge: Judge, motions: PartMotions, k: int, reach: list[float]) -> Iterator[PartMotions]:
    """The motions with part ``k`` shifted at the end along its two long directions, as far as its joint's type
    lets it."""
    points = judge.states[0].gaussians.means[motions.labels[0] == k + 1].double().cpu()
    if len(points) < 10:
        return
    kind, T = motions.types[k], motions.transforms[k]
    at = se3.apply(T, points)
    centre = at.mean(0)
    radius = float((at - centre).square().sum(1).mean().sqrt())
    for way in torch.linalg.svd(at - centre, full_matrices=False)[2][:2]:
        for size in [sign * r for r in reach for sign in (1, -1)]:
            shift = torch.cat([torch.zeros(3, dtype=torch.float64), way * size])
            step = allowed_step([kind], T[None], centre[None], torch.tensor([radius]), shift[None])[0]
            if float(step[3:].norm()) < 0.5 * abs(size):
                continue
            at_end = apply_step(T, centre, radius, step)
            yield motions.with_motion(k, kind, se3.project_revolute(at_end) if kind == "revolute" else at_end)


def leave_false_minima(
    judge: Judge, motions: PartMotions, reach: list[float], candidates: int | None = None
) -> tuple[PartMotions, list[int]]:
    """Refined motions once more from where ``survey`` lays the parts, each of which goes back where that gains, as long
    as the whole gains, and no oftener than there are parts and shifts: gains of several steps do not add up, so they
    might lead round in a circle.

    Returns them and which parts moved.
    """
    gone: list[int] = []
    for _ in range(len(motions) * len(reach) if judge.config.steps > 0 else 0):
        surveyed, moved = survey(judge, motions, reach, candidates)
        if not moved:
            break
        surveyed = judge.no_worse(motions, judge.improved(surveyed)[2])
        if judge.gain(surveyed, motions) <= 0:
            break
        moved = [k for k in moved if not torch.equal(surveyed.transforms[k], motions.transforms[k])]
        motions, gone = surveyed, sorted({*gone, *moved})
    return motions, gone
