"""What the photographs still contradict is asked for again, down to small parts."""

from __future__ import annotations

import math
from functools import partial
from operator import itemgetter

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.discovery import left_over
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled
from p2gs.native import at_once
from p2gs.parts.options import PartMotionsConfig

FEWEST = 20  # Gaussians of a part in each state


def seek(judge: Judge, motions: PartMotions, limit: int, config: PartMotionsConfig) -> tuple[PartMotions, list[dict]]:
    """With further parts, up to ``limit``, for surface that no motion explains (``left_over``): each that saves at
    least ``config.seek`` of the image loss in its own pixels (``Judge.own_share``), once refined. Returns the motions
    and what was tried."""
    log: list[dict] = []
    if judge.found is None:
        return motions, log
    while 0 < len(motions) < limit:
        left = left_over(judge.found, motions.transforms, motions.types)
        further = [motions.with_motion(len(motions), kind, T) for T, kind in left]
        further = at_once(partial(relabelled, judge.found, judge.states), further)
        further = [m for m in further if min(int((of == len(m)).sum()) for of in m.labels) >= FEWEST]
        judge.seen(motions)  # once, and not in each thread
        looked = zip(at_once(partial(judge.own_share, than=motions), further), further, strict=True)
        best = sorted((one for one in looked if one[0] > 0), key=itemgetter(0), reverse=True)[: config.candidates]
        refined = at_once(judge.refine, [tried for _, tried in best])
        shares = at_once(partial(judge.own_share, than=motions), refined)
        for (proposed, tried), reached in zip(best, shares, strict=True):
            told = {"type": tried.types[-1], "proposed": proposed, "own_share": reached}
            log.append({"change": "sought", **told})
        saved, found = max(zip(shares, refined, strict=True), key=itemgetter(0), default=(-math.inf, motions))
        if saved < config.seek:
            break
        motions = found
    return motions, log
