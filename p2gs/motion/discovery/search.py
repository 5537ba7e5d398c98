"""Which set of motions explains the moved surface of both states: a pool of sharp hypotheses, then joint selection.

The value of a set S is  sum_s mean_i max_{k in S} pay_s(i, k)  -  cost * |S|, each part's pay scaled by how plausible
its joint is. A greedy pass only fills the pool; sets are improved by adding, dropping and swapping until nothing helps,
and every part is fitted again to what the others leave over.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Callable

import torch
from torch import Tensor

from p2gs.motion.discovery.hypotheses import Sweep, distinct
from p2gs.motion.discovery.pool import Pool, plausibility
from p2gs.motion.discovery.problem import Problem, balanced
from p2gs.motion.discovery.refine import gauss_newton, pattern_search
from p2gs.motion.discovery.rigid import Motions

THICKNESSES = 8  # of plates that are tried
FIRST = 96, 16  # motions looked at and kept in each round that fills the pool


def two_sided(problem: Problem, motions: Motions, gain: Callable[[Motions], Tensor]) -> Motions:
    """The motions with the thickness of plate under which ``gain`` [B] is greatest; slides show the same sides in both
    states: 0."""
    turns = motions.turn.nonzero()[:, 0]
    if not len(turns):
        return motions
    tried = [motions[turns]]
    for thick in torch.arange(1, THICKNESSES + 1) * problem.config.thickest * problem.scale.diag / THICKNESSES:
        tried.append(replace(tried[0], thick=thick.expand(len(turns)).clone()))
    best = torch.stack([gain(m) for m in tried]).argmax(0)
    thick = torch.zeros(len(motions))
    thick[turns] = torch.stack([m.thick for m in tried]).gather(0, best[None])[0]
    return replace(motions, thick=thick)


class ExclusiveGain:
    """Plausible, unsaturated evidence of motions [B] over samples [P] of both states, weights [P] each."""

    def __init__(self, problem: Problem, samples: list[Tensor], weights: list[Tensor]):
        self.problem, self.samples, self.weights = problem, samples, weights

    def __call__(self, motions: Motions) -> Tensor:
        pays = self.problem.pay(motions, self.samples)
        f = plausibility(self.problem, motions, [p for p, _ in pays], self.samples)
        return f * balanced(*[((p * ~u) @ w, (p * u) @ w) for (p, u), w in zip(pays, self.weights, strict=False)])


class Search:
    """Everything the selection needs; ``trace`` collects what happened for the diagnostics."""

    def __init__(self, problem: Problem, swept: Sweep, limit: int, cost: float):
        self.problem, self.swept, self.limit, self.cost = problem, swept, limit, cost
        self.samples = problem.samples
        self.probe = torch.cat([problem.surfels[s].points[self.samples[s]][::8] for s in (0, 1)])
        self.radius = 1.5 * problem.landings[0].hc
        self.pool = Pool(problem, self.samples)
        where = [
            torch.searchsorted(a, b).clamp_max(len(a) - 1)
            for a, b in zip([s.sort().values for s in self.samples], swept.samples, strict=False)
        ]
        self.sweep_rows = [s.argsort()[w] for s, w in zip(self.samples, where, strict=False)]
        self.trace: list[dict] = []

    def propose(
        self,
        chosen: list[int],
        count: int,
        fine: int,
        extra: Motions | None = None,
        each: bool = False,
        unknown: bool = False,
    ) -> tuple[Motions, Tensor]:
        """The ``fine`` best sharpened motions for what the motions ``chosen`` leave over, and their gains.

        each: as many slides as turns, since among many turns one often fits by chance a little better than a true
        slide.  unknown: as in ``Sweep.gain``.
        """
        left = [(1 - a).clamp(0, 1) for a in self.pool.explained(chosen)]
        weights = [
            w.sum() * (x * w)[r] / w[r].sum().clamp_min(1e-9)
            for x, w, r in zip(left, self.problem.weights, self.sweep_rows, strict=True)
        ]
        g = self.swept.gain(weights, unknown)
        slide = ~self.swept.motions.turn
        tops = [
            distinct(self.swept.motions, torch.where(kind, g, -torch.ones_like(g)), self.probe, self.radius, n)
            for kind, n in ((slide, count // 3), (~slide, count))
        ]
        top = torch.cat([t[kind[t]] for t, kind in zip(tops, (slide, ~slide), strict=False)])
        motions = self.swept.motions[top]
        if extra is not None:
            motions = Motions.cat([motions, extra])
        if len(motions) == 0:
            return motions, torch.zeros(0)
        return self.sharpened(
            motions,
            ExclusiveGain(self.problem, self.samples, [w * x for w, x in zip(self.problem.weights, left, strict=True)]),
            fine,
            each,
        )

    def sharpened(self, motions: Motions, gain: ExclusiveGain, fine: int, each: bool = False) -> tuple[Motions, Tensor]:
        """The ``fine`` motions of greatest gain that come of ``motions`` [B] when fitted to the gain's samples, and
        their gains."""
        motions = two_sided(self.problem, motions, gain)
        sharp = gauss_newton(self.problem, motions, gain.samples, gain.weights)
        both = Motions.cat([motions, sharp])
        value = gain(both)
        n = len(motions)
        better = value[n:] > value[:n]
        both = both[torch.where(better, torch.arange(n) + n, torch.arange(n))]
        value = torch.maximum(value[:n], value[n:])
        if each:
            kinds = [torch.where(kind, value, torch.full_like(value, -1.0)) for kind in (both.turn, ~both.turn)]
            kept = [distinct(both, v, self.probe, 0.5 * self.radius, fine // 2) for v in kinds]
            keep = torch.cat([k[v[k] >= 0] for k, v in zip(kept, kinds, strict=True)])
        else:
            keep = distinct(both, value, self.probe, 0.5 * self.radius, fine)
        motions, value = pattern_search(gain, both[keep], 0.5 * self.problem.landings[0].hc, 8, value=value[keep])
        keep = distinct(motions, value, self.probe, 0.3 * self.radius, fine)
        return motions[keep], value[keep]

    def fill(self, rounds: int) -> None:
        """Greedy pursuit: propose, keep the best few, explain away with the best one."""
        chosen: list[int] = []
        idle, last = 0, 0.0
        for _ in range(rounds):
            motions, _ = self.propose(chosen, *FIRST)
            if len(motions) == 0:
                break
            index = self.pool.add(motions)
            chosen.append(max(index.tolist(), key=lambda k: self.value([*chosen, k])))
            total = self.pool.total(chosen)
            idle = idle + 1 if total - last < 0.5 * self.cost else 0
            last = max(last, total)
            if idle == 2:  # what is left over is noise
                break

    def value(self, chosen) -> float:
        """Evidence of a set less the cost of its parts; nearly equal motions cost double."""
        twins = 0
        if len(chosen) > 1:
            m = self.pool.motions[torch.tensor(list(chosen))]
            twins = int(
                (m.swept(self.probe, m).triu(1) + torch.ones(len(chosen), len(chosen)).tril() * 9 < self.radius)
                .any(0)
                .sum()
            )
        return self.pool.total(chosen) - self.cost * (len(chosen) + twins)

    def additions(self, rest: list[int], top: int = 6) -> list[tuple[float, list[int]]]:
        """The most promising sets ``rest`` + one hypothesis, exactly valued."""
        already, best = self.pool.explained(rest), self.pool.best(rest)
        rows = torch.arange(len(self.pool.motions))
        e = self.pool.effective(rows, best)
        guess = self.pool.mean([(x - a).clamp_min(0) for x, a in zip(e, already, strict=False)])
        return [
            (self.value([*rest, k]), [*rest, k])
            for k in guess.topk(min(top, len(guess))).indices.tolist()
            if k not in rest
        ]

    def improve(self, chosen: list[int]) -> list[int]:
        """Add, drop or swap hypotheses of the pool while the value of the set rises."""
        best = self.value(chosen)
        while True:
            options: list[tuple[float, list[int]]] = []
            for drop in [None, *chosen]:
                rest = [c for c in chosen if c != drop]
                if drop is not None:
                    options.append((self.value(rest), rest))
                if len(rest) < self.limit:
                    options += self.additions(rest)
            value, candidate = max(options, key=lambda o: o[0], default=(-math.inf, chosen))
            if value <= best + 1e-6:
                return chosen
            best, chosen = value, candidate

    def refit(self, chosen: list[int], count: int = 24) -> list[int]:
        """Fit every part anew to what the others leave over; its own motion is among the starts. New fits join the
        pool."""
        chosen = list(chosen)
        for i in range(len(chosen)):
            rest = chosen[:i] + chosen[i + 1 :]
            own = self.pool.motions[torch.tensor([chosen[i]])]
            motions, value = self.propose(rest, count, 6, own)
            if len(motions) == 0:
                continue
            index = self.pool.add(motions)
            options = [(self.value([*rest, int(k)]), int(k)) for k in index] + [(self.value(chosen), chosen[i])]
            chosen[i] = max(options)[1]
        return chosen

    def solve(self, starts: int = 6, rounds: int = 2) -> list[tuple[float, list[int]]]:
        """Distinct complete explanations, best first: (value, pool indices)."""
        self.fill(self.limit + 2)
        if len(self.pool.motions) == 0:
            return []
        single = torch.tensor([self.value([k]) for k in range(len(self.pool.motions))])
        firsts = distinct(self.pool.motions, single, self.probe, self.radius, starts).tolist()
        found = [self.improve([])] + [self.improve([k]) for k in firsts]
        for r in range(rounds):
            found = self.unique(found)[: (3, 2)[min(r, 1)]]
            found += [self.improve(self.refit(f)) for f in found]
            found += [self.improve(f) for f in found]
        found = self.unique(found)
        self.trace.append(
            {"pool": len(self.pool.motions), "sets": [(round(self.value(f), 4), len(f)) for f in found[:8]]}
        )
        return [(self.value(f), f) for f in found]

    def alternatives(self, solutions: list[tuple[float, list[int]]], count: int = 2) -> list[tuple[float, list[int]]]:
        """The best explanation with one motion exchanged for the best really different one: what a later, sharper look
        may prefer."""
        if not solutions:
            return []
        chosen, m = solutions[0][1], self.pool.motions
        out = []
        for k in chosen:
            rest = [c for c in chosen if c != k]
            far = m[torch.tensor([k])].swept(self.probe, m)[0] > 3 * self.radius
            already, best = self.pool.explained(rest), self.pool.best(rest)
            e = self.pool.effective(torch.arange(len(m)), best)
            guess = self.pool.mean([(x - a).clamp_min(0) for x, a in zip(e, already, strict=False)])
            guess = torch.where(far, guess, torch.full_like(guess, -1.0))
            options = [
                (self.value([*rest, i]), [*rest, i]) for i in guess.topk(min(4, len(guess))).indices.tolist() if far[i]
            ]
            if options:
                out.append(max(options))
        found = [f for _, f in sorted(out, reverse=True)]
        return [(self.value(f), f) for f in found if not any(self.same(f, g) for _, g in solutions)][:count]

    def unique(self, sets: list[list[int]]) -> list[list[int]]:
        """Best first, without sets whose motions all agree with those of a better one."""
        sets = sorted(sets, key=self.value, reverse=True)
        out: list[list[int]] = []
        for f in sets:
            if not any(self.same(f, g) for g in out):
                out.append(f)
        return out

    def same(self, a: list[int], b: list[int]) -> bool:
        """``agree`` for two sets of the pool's hypotheses."""
        m = self.pool.motions
        return self.agree(m[torch.tensor(a, dtype=torch.long)], m[torch.tensor(b, dtype=torch.long)])

    def agree(self, a: Motions, b: Motions) -> bool:
        """Do two sets of motions agree one by one, in some order?"""
        if len(a) != len(b):
            return False
        if not len(a):
            return True
        d = a.swept(self.probe, b)
        if len(a) > 7:
            return bool((d.min(1).values < self.radius).all())
        return any(
            all(float(d[i, j]) < self.radius for i, j in enumerate(p)) for p in itertools.permutations(range(len(b)))
        )
