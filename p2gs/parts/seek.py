"""What the photographs still contradict is asked for again, down to small parts."""

from __future__ import annotations

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.discovery import left_over
from p2gs.motion.refine_motions import Judge
from p2gs.parts.options import PartMotionsConfig
from p2gs.parts.settle import relabelled

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
        best = None
        for saved, tried in sorted(looked, key=lambda x: -x[0])[: config.candidates]:
            if saved <= 0:
                break
            refined = judge.refine(tried)
            after = judge.own_share(refined, motions)
            log.append({"change": "sought", "type": tried.types[-1], "proposed": saved, "own_share": after})
            best = max(best or (after, refined), (after, refined), key=lambda x: x[0])
        if best is None or best[0] < config.seek:
            break
        motions = best[1]
    return motions, log
