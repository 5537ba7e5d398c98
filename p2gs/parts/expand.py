"""Expansion: a part takes surface that could as well stand still, or another part's, if the energy falls by it.

A plain side that slides along itself lies on itself in both states, so surfaces call it static wherever nothing else
speaks: a rigid body is torn in two, and another part is found to cover the gap. So each part is tried with what a cut
gives it of the static surface and of another part's (``label_cut.spread``); and, as nothing of an object may stand
still (a box pulled out of a wall that is not in the pictures), with all static surface, or with everything.
Photographs, not the cut, decide.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Iterator

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.refine_motions import Judge
from p2gs.native import at_once
from p2gs.parts.label_cut import spread, with_all_static
from p2gs.parts.part_choices import without_part


def expand(judge: Judge, motions: PartMotions) -> tuple[PartMotions, list[dict]]:
    """Motions and labels of lowest energy, after parts took what is theirs; what was taken. What a part takes must save
    as much of the image loss in its own pixels (``Judge.own_share``) as a further part must: where photographs hardly
    tell, surface stays still."""
    taken: list[dict] = []
    while len(motions):
        best, told = None, {"energy": 0.0}
        tries = list(expansions(judge, motions))
        gains = at_once(partial(judge.gain, than=motions), [tried for _, _, tried in tries])
        for (how, part, tried), gained in zip(tries, gains, strict=True):
            if gained > -told["energy"] and (own := judge.own_share(tried, motions)) >= judge.further:
                best, told = tried, {"change": how, "part": part, "own_share": own, "energy": -gained}
        if best is None:
            break
        motions = best
        taken.append(told)
    return motions, taken


def expansions(judge: Judge, motions: PartMotions) -> Iterator[tuple[str, int, PartMotions]]:
    """For each part, (how, part, motions): with all static surface its own; of several, with that of the static surface
    and of another part that the cut gives it, where that is most of the other's, which goes; with everything."""
    for k in range(len(motions)):
        yield "took the static surface", k, with_all_static(motions, k)
        for other in range(len(motions)):
            if other != k:
                left = k - (k > other)
                tried = spread(judge, without_part(motions, other, 0), left)
                if _most(motions, other, tried, left):
                    yield f"took part {other}", k, tried
        if len(motions) > 1:
            one = replace(
                motions,
                types=[motions.types[k]],
                transforms=motions.transforms[k : k + 1],
                confidence=motions.confidence[k : k + 1],
                labels=[torch.ones_like(own) for own in motions.labels],
            )
            yield "took the whole object", k, one


def _most(motions: PartMotions, other: int, tried: PartMotions, k: int) -> bool:
    """Whether part ``k`` of ``tried`` has most of what part ``other`` of ``motions`` had in each state."""
    shares = [
        float((new[own == other + 1] == k + 1).float().mean()) if bool((own == other + 1).any()) else 1.0
        for own, new in zip(motions.labels, tried.labels, strict=True)
    ]
    return min(shares) > 0.5
