"""Fusion: the best explanation takes parts of the others, with their surface, if the energy falls by it.

Explanations are compared as a whole, and each may be right about another part. Offered as a motion alone
(``settle.reconsider``) such a part gets its surface from those that hold it now, and where these explain it half it
is not worth its price any more; with the surface that it has where it was found, it is (fusion moves: Lempitsky et al.
2010, DOI 10.1109/TPAMI.2009.143).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import itemgetter

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.refine_motions import Judge
from p2gs.native import at_once
from p2gs.ops import se3
from p2gs.parts.part_choices import further_axes


def fuse(
    judge: Judge, motions: PartMotions, others: list[PartMotions], limit: int, same_motion: float
) -> tuple[PartMotions, list[dict]]:
    """The motions with those parts of ``others``, up to ``limit`` parts, by which they are better, as explanations are
    compared (``part_choices.better``), refined; what was tried. Parts that go as one of the motions does, by less than
    ``same_motion`` (internal units) of their own points' mean path, are not asked."""
    log: list[dict] = []
    while 0 < len(motions) < limit:
        tries = [
            (number, part, with_part_of(motions, other, part))
            for number, other in enumerate(others)
            for part in range(len(other))
            if not _known(judge, motions, other, part, same_motion)
        ]
        taken = _taken(judge, motions, tries, log)
        if taken is None:
            break
        motions = judge.improved(taken)[2]
    return motions, log


def _taken(
    judge: Judge, motions: PartMotions, tries: list[tuple[int, int, PartMotions]], log: list[dict]
) -> PartMotions | None:
    """Of the tries (explanation, part, motions with it) the one of least energy that is better than ``motions``, None
    where none is. log: told of each that was asked."""
    judge.seen(motions)  # once, and not in each thread
    gains = at_once(partial(judge.gain, than=motions), [tried for _, _, tried in tries])
    for gained, (number, part, tried) in sorted(zip(gains, tries, strict=True), key=itemgetter(0), reverse=True):
        told = {"change": "fused", "explanation": number, "part": part, "type": tried.types[-1], "energy": -gained}
        log.append(told)
        if gained > 0:
            told["own_share"] = judge.own_share(tried, motions)
            if told["own_share"] >= judge.further or further_axes(tried, motions) <= 0:
                return tried
    return None


def with_part_of(motions: PartMotions, other: PartMotions, part: int) -> PartMotions:
    """The motions with one part more, the ``other``'s, which takes along what Gaussians it has there."""
    added = len(motions)
    taken = [of == part + 1 for of in other.labels]
    labels = [torch.where(of, added + 1, own) for of, own in zip(taken, motions.labels, strict=True)]
    margin = [torch.where(of, *both) for of, *both in zip(taken, other.margin, motions.margin, strict=True)]
    confidence = torch.cat([motions.confidence, other.confidence[part : part + 1]])
    motions = motions.with_motion(added, other.types[part], other.transforms[part])
    return replace(motions, labels=labels, margin=margin, confidence=confidence)


def _known(judge: Judge, motions: PartMotions, other: PartMotions, part: int, same_motion: float) -> bool:
    """Whether one of the motions carries the other's part to where its own does."""
    points = judge.states[0].gaussians.means[other.labels[0] == part + 1].double()
    if not len(points):
        return True
    return float(se3.mean_gap(motions.transforms, other.transforms[part], points).min()) < same_motion
