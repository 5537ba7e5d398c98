"""Expansion: a part takes the whole static surface, if the energy of the labels falls by it.

A plain side that slides along itself lies on itself in both states, so surfaces call it static wherever nothing else
speaks. Where nothing of the object stands still (a box pulled out of a wall that is not in the pictures), that leaves a
rigid body torn in two, and another part is found to cover the gap. A move of graph cuts (Boykov, Veksler and Zabih
2001, DOI 10.1109/34.969114), with a whole label for the expanding set: what a cut would choose is decided by
photographs, which know no edges between two Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Iterator

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.refine_motions import Judge


def expand(judge: Judge, motions: PartMotions) -> tuple[PartMotions, list[dict]]:
    """Motions and labels of lowest energy, after parts took the static surface or the whole object; what was taken."""
    best, taken = motions, []
    for how, part, tried in expansions(motions):
        if judge.gain(tried, best) > 0:
            best, taken = tried, [{"change": how, "part": part, "energy": -judge.gain(tried, motions)}]
    return best, taken


def expansions(motions: PartMotions) -> Iterator[tuple[str, int, PartMotions]]:
    """For each part: with the static surface its own, and, of several, with everything its own and no other part: (how,
    part, motions)."""
    for k in range(len(motions)):
        labels = [torch.where(own == 0, k + 1, own) for own in motions.labels]
        yield "took the static surface", k, replace(motions, labels=labels)
        if len(motions) > 1:
            one = replace(
                motions,
                types=[motions.types[k]],
                transforms=motions.transforms[k : k + 1],
                confidence=motions.confidence[k : k + 1],
                labels=[torch.ones_like(own) for own in motions.labels],
            )
            yield "took the whole object", k, one
