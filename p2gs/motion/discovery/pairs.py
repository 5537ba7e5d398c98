"""Two parts that look alike may have been taken for one another: each one's start for the other's end.

Every surfel is explained then, and no exchange of one motion mends it: the other part would be where nothing is seen.
Both must change at once.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from p2gs.motion.discovery.finish import part_samples
from p2gs.motion.discovery.hypotheses import distinct
from p2gs.motion.discovery.labels import Labelling
from p2gs.motion.discovery.rigid import Motions
from p2gs.motion.discovery.search import ExclusiveGain, Search

STARTS = 48  # motions of the sweep that are fitted


def part_evidence(search: Search, labelling: Labelling, parts: int) -> list[Tensor]:
    """Of both states [H, K]: mean evidence in 0..1 of the sweep's motions over the samples of each part."""
    out, first = [], 0
    for s in (0, 1):
        index = search.samples[s][search.sweep_rows[s]]
        mine = torch.nn.functional.one_hot(labelling.labels(s)[index], parts + 1)[:, 1:].float()
        mine = mine / mine.sum(0).clamp_min(1) / 255
        rows = search.swept.evidence[:, first : first + len(index)]
        out.append(torch.cat([rows[i : i + 20000].float() @ mine for i in range(0, len(rows), 20000)]))
        first += len(index)
    return out


def carried(search: Search, labelling: Labelling, gains: Tensor, a: int, b: int) -> Motions:
    """The best turn and the best slide that take part a's start for part b's end; gains [H] of the sweep's motions at
    that."""
    top = distinct(search.swept.motions, gains, search.probe, search.radius, STARTS)
    samples = [
        part_samples(search.problem, labelling, k, search.problem.config.samples)[s] for s, k in enumerate((a, b))
    ]
    if not len(top) or min(map(len, samples)) < 3:
        return Motions.empty()
    weights = [search.problem.trust[s][i] / search.problem.trust[s][i].sum() for s, i in enumerate(samples)]
    gain = ExclusiveGain(search.problem, samples, weights)
    motions, value = search.sharpened(search.swept.motions[top], gain, 6, each=True)
    best = [
        torch.where(kind, value, -torch.ones_like(value)).argmax()
        for kind in (motions.turn, ~motions.turn)
        if bool(kind.any())
    ]
    return motions[torch.stack(best)] if best else motions


def crossed(search: Search, labelling: Labelling, motions: Motions, count: int) -> list[tuple[int, Motions]]:
    """For the ``count`` pairs of which the sweep explains most that way: all motions, with such as take each of the two
    parts' start for the other's end. (first of the two, motions)."""
    start, end = part_evidence(search, labelling, len(motions))

    def gains(a: int, b: int) -> Tensor:
        x, y = start[:, a], end[:, b]
        return torch.minimum(x, 3 * y) + torch.minimum(y, 3 * x)

    def most(pair: tuple[int, int]) -> float:
        return float(gains(*pair).max() + gains(*pair[::-1]).max())

    out = []
    pairs = sorted(itertools.combinations(range(len(motions)), 2), key=most, reverse=True)
    for a, b in pairs[:count]:
        for one, two in itertools.product(
            *(_each(carried(search, labelling, gains(*p), *p)) for p in ((a, b), (b, a)))
        ):
            more = [one if k == a else two if k == b else motions[k : k + 1] for k in range(len(motions))]
            out.append((a, Motions.cat(more)))
    return out


def _each(motions: Motions) -> list[Motions]:
    return [motions[i : i + 1] for i in range(len(motions))]
