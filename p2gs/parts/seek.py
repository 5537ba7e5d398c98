"""What the photographs still contradict is asked for again, down to small parts."""

from __future__ import annotations

import math
from operator import itemgetter

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.discovery import left_over
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled
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
        looked = []
        for T, kind in left_over(judge.found, motions.transforms, motions.types):
            tried = relabelled(judge.found, judge.states, motions.with_motion(len(motions), kind, T))
            if min(int((of == len(tried)).sum()) for of in tried.labels) >= FEWEST:
                looked.append((judge.own_share(tried, motions), tried))
        refined = []
        for saved, tried in sorted(looked, key=itemgetter(0), reverse=True)[: config.candidates]:
            if saved > 0:
                after = judge.refine(tried)
                refined.append((judge.own_share(after, motions), after))
                told = {"type": tried.types[-1], "proposed": saved, "own_share": refined[-1][0]}
                log.append({"change": "sought", **told})
        saved, best = max(refined, key=itemgetter(0), default=(-math.inf, motions))
        if saved < config.seek:
            break
        motions = best
    return motions, log
