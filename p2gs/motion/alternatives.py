"""Other angles that explain the photographs as well: after a quarter turn the cross of a tap looks as before."""

from __future__ import annotations

import math
from functools import partial

from scipy.optimize import minimize_scalar
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.joint_confidence import common_level
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import losses_both_ways
from p2gs.native import at_once
from p2gs.ops import se3

LOOKS = 36  # angles about an axis that are looked at, ten degrees apart: a wheel of twelve spokes has three for each


def other_angles(judge: Judge, motions: PartMotions, told: float) -> list[list[Tensor]]:
    """Of each turn the motions [4, 4] about its own line, by other angles, against which the found one saves less than
    ``told`` of the image loss in its own pixels (``Judge.own_share``; 0: none), those that photographs like best first.
    Slides have none.

    Where the smallest photographs' loss has a valley along the angle, larger ones say where in it; of the valleys, the
    lowest first, the first one that is told ends the search.
    """
    if told <= 0 or "revolute" not in motions.types:
        return [[] for _ in motions.types]
    judge.seen(motions)  # once, and not in each thread
    return at_once(partial(_of, judge, motions, told), range(len(motions)))


def _of(judge: Judge, motions: PartMotions, told: float, k: int) -> list[Tensor]:
    """``other_angles`` of part ``k``."""
    if motions.types[k] != "revolute":
        return []
    screw = se3.screw_parameters(motions.transforms[k].double())

    def turned(further: float) -> PartMotions:
        return motions.with_motion(k, "revolute", se3.from_screw(screw.axis, screw.origin, screw.angle + further))

    def loss(further: float, level: int) -> float:
        options = {"level": level, "backend": judge.backend, "device": judge.device}
        return sum(losses_both_ways(judge.states, motions.labels, turned(further).transforms, judge.views, **options))

    step, small, large = 2 * math.pi / LOOKS, min(judge.views[0].levels), common_level(judge.views)
    losses = [loss(i * step, small) for i in range(LOOKS)]
    valleys = [i for i in range(2, LOOKS - 1) if losses[i] <= min(losses[i - 1], losses[i + 1])]
    out = []
    for i in sorted(valleys, key=losses.__getitem__):
        ends = ((i - 1) * step, (i + 1) * step)
        best = minimize_scalar(partial(loss, level=large), bounds=ends, method="bounded", options={"xatol": step / 50})
        other = turned(float(best.x))  # pyright: ignore[reportAttributeAccessIssue]
        if judge.own_share(motions, other) >= told:
            break
        out.append(other.transforms[k])
    return out
