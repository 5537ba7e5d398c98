"""Which set of motions explains the moved surface of both states: a pool of sharp hypotheses, then joint selection.

The value of a set S is  sum_s mean_i max_{k in S} pay_s(i, k)  -  cost * |S|, each part's pay scaled by how plausible its joint is.
A greedy pass only fills the pool; sets are improved by adding, dropping and swapping until nothing helps, and every part is fitted
again to what the others leave over.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from p2gs.models.discovery.hypotheses import Sweep, distinct
from p2gs.models.discovery.problem import Problem, balanced
from p2gs.models.discovery.refine import gauss_newton, pattern_search
from p2gs.models.discovery.rigid import Motions


def plausibility(problem: Problem, motions: Motions, pays: list[Tensor], samples: list[Tensor], slide_bonus: bool = True) -> Tensor:
    """Factor [B] in 0..1 on a motion's evidence, from what joints of made things are like.

    * A hinge touches what it carries: distance from the axis to the points that pay, less what must stay unseen near an axis.
    * A part's faces lie along or across its joint's axis: share of paying points whose normals are oblique to it.
    * A motion of hardly more than the tolerance is what errors of the surfaces look like.
    * Large motions are a little less likely than small ones; a turn has two freedoms more than a slide.
    """
    cfg, k = problem.config, problem.scale
    near = torch.full((len(motions),), torch.inf)
    oblique, arm, weight = torch.zeros(len(motions)), torch.zeros(len(motions)), torch.full((len(motions),), 1e-6)
    for s in (0, 1):
        surf = problem.surfels[s]
        p, n = surf.points[samples[s]], surf.normals[samples[s]]
        pay = pays[s] > 0.1
        axis = motions.axis
        d = p[None] - motions.centre[:, None]
        away = (d - (d * axis[:, None]).sum(2, keepdim=True) * axis[:, None]).norm(dim=2)
        arm += torch.where(pay, away, torch.zeros_like(away)).sum(1) / max(1, len(p))
        away = torch.where(pay, away, torch.full_like(away, torch.inf))
        few = max(1, int(0.01 * away.shape[1]))
        if away.shape[1]:
            near = torch.minimum(near, away.topk(min(few, away.shape[1]), dim=1, largest=False).values[:, -1])
        along = (axis @ n.T).abs()
        oblique += ((along > 0.3) & (along < 0.95) & pay).float().sum(1) / max(1, len(p))
        weight += pay.float().sum(1) / max(1, len(p))
    unseen = 1.5 * k.tau / (2 * torch.sin(motions.amount.abs().clamp(0.03, math.pi) / 2))
    excess = (near - 0.04 * k.diag - unseen).clamp(0, k.diag)
    turn = 1 - cfg.attach * (excess / (0.12 * k.diag)).clamp(0, 1)
    turn = turn * (1 - 0.15 * ((motions.amount.abs() - math.radians(80)) / math.radians(55)).clamp(0, 1)) * (1 - cfg.slide_bonus * slide_bonus)
    size = motions.amount.abs() / (cfg.max_slide * k.diag)
    slide = (1 - 0.08 * size.clamp(0, 1)) * (1 - 2 * (size - 1).clamp(0, 0.5))
    out = torch.where(motions.turn, turn, slide)
    reach = torch.where(motions.turn, arm / weight * motions.amount.abs(), motions.amount.abs())
    out = out * ((reach / k.tp - 1) / 1.5).clamp(0.1, 1)
    return out * (1 - 0.4 * ((oblique / weight - 0.35) / 0.4).clamp(0, 1))


class Pool:
    """Hypotheses with their evidence over the samples of both states.

    pays [B, P0], [B, P1] in 0..1: saturated (a sharper fit of what is explained already is worth nothing here), averaged over a
    point's neighbours that face alike, times the joint's plausibility.  twin [B, P]: the sample of the other state next to where the
    point lands.  back [B, P]: what that sample pays under the same motion.  owned, loose [B, P]: does the point land on a moved surface,
    on one of unknown fate or none at all.
    """

    FULL, NONE = 0.16, 0.30  # landing costs that pay all and nothing
    HIDDEN = 0.4  # credit of a point that lands in space never seen, if the motion explains something elsewhere
    RIVAL = 0.15  # by how much another part must pay more at the landing place to own it
    SHARED = 0.8  # loss of a point whose landing place is better explained by another part

    def __init__(self, problem: Problem, samples: list[Tensor], k: int = 7):
        self.problem, self.samples = problem, samples
        self.motions = Motions.empty()
        self.pays = [torch.zeros(0, len(s)) for s in samples]
        self.twin = [torch.zeros(0, len(s), dtype=torch.long) for s in samples]
        self.back = [torch.zeros(0, len(s)) for s in samples]
        self.owned = [torch.zeros(0, len(s), dtype=torch.bool) for s in samples]
        self.loose = [torch.zeros(0, len(s), dtype=torch.bool) for s in samples]
        self.smooth, self.closest = [], []
        for s in (0, 1):
            surf = problem.surfels[s]
            p, n = surf.points[samples[s]], surf.normals[samples[s]]
            tree = cKDTree(p.numpy())
            d, j = (torch.from_numpy(np.asarray(a).reshape(len(p), -1)) for a in tree.query(p.numpy(), k=min(k, len(p))))
            w = torch.exp(-((d / d[:, -1].median().clamp_min(1e-9)) ** 2)).float() * (n[j] * n[:, None]).sum(2).clamp_min(0) ** 2
            self.smooth.append(torch.zeros(len(p), len(p)).scatter_(1, j, w / w.sum(1, keepdim=True)).T.contiguous())
            self.closest.append(torch.from_numpy(tree.query(surf.points.numpy())[1]))

    def add(self, motions: Motions, chunk: int = 64) -> Tensor:
        """Append motions; their indices."""
        start = len(self.motions)
        for i in range(0, len(motions), chunk):
            m = motions[i : i + chunk]
            raw, hidden, twin = [], [], []
            for s in (0, 1):
                cost, j = self.problem.cost(m, s, self.samples[s])
                fit = ((self.NONE - cost) / (self.NONE - self.FULL)).clamp(0, 1)
                raw.append(fit)
                hidden.append((cost < 0.45).float())
                twin.append(self.closest[1 - s][j])
                self.owned[s] = torch.cat([self.owned[s], self.problem.moved[1 - s][j] & (fit > 0)])
                self.loose[s] = torch.cat([self.loose[s], self.problem.loose(1 - s, j) | (fit <= 0)])
            f = plausibility(self.problem, m, raw, self.samples)[:, None]
            trust = (self.mean(raw) / 0.1).clamp(0, 1)[:, None]
            local = [((raw[s] @ self.smooth[s] - 0.25) / 0.5).clamp(0, 1) for s in (0, 1)]
            pays = [torch.maximum(local[s], self.HIDDEN * trust * (hidden[s] @ self.smooth[s])) * f for s in (0, 1)]
            for s in (0, 1):
                self.pays[s] = torch.cat([self.pays[s], pays[s]])
                self.twin[s] = torch.cat([self.twin[s], twin[s]])
                self.back[s] = torch.cat([self.back[s], pays[1 - s].gather(1, twin[s])])
        self.motions = Motions.cat([self.motions, motions])
        return torch.arange(start, len(self.motions))

    def best(self, chosen) -> list[Tensor]:
        """Per state [P]: the most any chosen motion pays, nothing held against it."""
        return [p[list(chosen)].max(0).values if len(chosen) else torch.zeros(p.shape[1]) for p in self.pays]

    def effective(self, rows: Tensor, others: list[Tensor]) -> list[Tensor]:
        """Evidence [R, P] of motions ``rows``, less where the landing place is better explained otherwise (``others`` [P] per state)."""
        out = []
        for s in (0, 1):
            rival = others[1 - s][self.twin[s][rows]] if len(others[1 - s]) else torch.zeros_like(self.back[s][rows])
            rival = torch.where(self.owned[s][rows], rival, torch.zeros_like(rival))
            fits = (1 - (rival - self.back[s][rows]) / self.RIVAL).clamp(0, 1)
            out.append(self.pays[s][rows] * (1 - self.SHARED * (1 - fits)))
        return out

    def explained(self, chosen) -> list[Tensor]:
        """Per state [P]: evidence of the set with double use of surfaces punished."""
        if not len(chosen):
            return [torch.zeros(p.shape[1]) for p in self.pays]
        e = self.effective(torch.tensor(list(chosen)), self.best(chosen))
        return [x.max(0).values for x in e]

    def total(self, chosen) -> float:
        """Evidence, 0..1: every point goes to the motion that pays most, both states weighted alike, each part's evidence balanced."""
        if not len(chosen):
            return 0.0
        rows = torch.tensor(list(chosen))
        share = []
        for s, e in enumerate(self.effective(rows, self.best(chosen))):
            value, who = e.max(0)
            value = value * self.problem.weights[s]
            loose = self.loose[s][rows].gather(0, who[None])[0]
            zero = torch.zeros(len(chosen))
            share.append((zero.index_add(0, who, value * ~loose), zero.index_add(0, who, value * loose)))
        return float(balanced(*share).sum()) / 2

    def mean(self, e: list[Tensor]) -> Tensor:
        """Weighted mean [B] over both states of evidence [B, P0], [B, P1]."""
        return sum(x @ w for x, w in zip(e, self.problem.weights))


class ExclusiveGain:
    """Plausible, unsaturated evidence of motions [B] over what others leave, ``left`` [P] per state in 0..1."""

    def __init__(self, problem: Problem, samples: list[Tensor], left: list[Tensor]):
        self.problem, self.samples = problem, samples
        self.weights = [w * x for w, x in zip(problem.weights, left)]

    def __call__(self, motions: Motions) -> Tensor:
        pays = self.problem.pay(motions, self.samples)
        f = plausibility(self.problem, motions, [p for p, _ in pays], self.samples)
        return f * balanced(*[((p * ~u) @ w, (p * u) @ w) for (p, u), w in zip(pays, self.weights)])


class Search:
    """Everything the selection needs; ``trace`` collects what happened for the diagnostics."""

    def __init__(self, problem: Problem, swept: Sweep, limit: int, cost: float):
        self.problem, self.swept, self.limit, self.cost = problem, swept, limit, cost
        self.samples = problem.samples
        self.probe = torch.cat([problem.surfels[s].points[self.samples[s]][::8] for s in (0, 1)])
        self.radius = 1.5 * problem.landings[0].hc
        self.pool = Pool(problem, self.samples)
        where = [torch.searchsorted(a, b).clamp_max(len(a) - 1) for a, b in zip([s.sort().values for s in self.samples], swept.samples)]
        self.sweep_rows = [s.argsort()[w] for s, w in zip(self.samples, where)]
        self.trace: list[dict] = []

    def propose(self, chosen: list[int], count: int, fine: int, extra: Motions | None = None) -> tuple[Motions, Tensor]:
        """The ``fine`` best sharpened motions for what the motions ``chosen`` leave over, and their gains."""
        left = [(1 - a).clamp(0, 1) for a in self.pool.explained(chosen)]
        weights = [(x * w)[r] / w[r].sum().clamp_min(1e-9) for x, w, r in zip(left, self.problem.weights, self.sweep_rows)]
        g = self.swept.gain(weights)
        slide = ~self.swept.motions.turn
        tops = [distinct(self.swept.motions, torch.where(kind, g, -torch.ones_like(g)), self.probe, self.radius, n) for kind, n in ((slide, count // 3), (~slide, count))]
        top = torch.cat([t[kind[t]] for t, kind in zip(tops, (slide, ~slide))])
        motions = self.swept.motions[top]
        if extra is not None:
            motions = Motions.cat([motions, extra])
        if len(motions) == 0:
            return motions, torch.zeros(0)
        gain = ExclusiveGain(self.problem, self.samples, left)
        sharp = gauss_newton(self.problem, motions, self.samples, [w * x for w, x in zip(self.problem.weights, left)])
        both = Motions.cat([motions, sharp])
        value = gain(both)
        n = len(motions)
        better = value[n:] > value[:n]
        both = both[torch.where(better, torch.arange(n) + n, torch.arange(n))]
        value = torch.maximum(value[:n], value[n:])
        keep = distinct(both, value, self.probe, 0.5 * self.radius, fine)
        motions, value = pattern_search(gain, both[keep], 0.5 * self.problem.landings[0].hc, 8, value=value[keep])
        keep = distinct(motions, value, self.probe, 0.3 * self.radius, fine)
        return motions[keep], value[keep]

    def fill(self, rounds: int) -> None:
        """Greedy pursuit: propose, keep the best few, explain away with the best one."""
        chosen: list[int] = []
        idle, last = 0, 0.0
        for _ in range(rounds):
            motions, _ = self.propose(chosen, 96, 16)
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
            twins = int((m.swept(self.probe, m).triu(1) + torch.ones(len(chosen), len(chosen)).tril() * 9 < self.radius).any(0).sum())
        return self.pool.total(chosen) - self.cost * (len(chosen) + twins)

    def additions(self, rest: list[int], top: int = 6) -> list[tuple[float, list[int]]]:
        """The most promising sets ``rest`` + one hypothesis, exactly valued."""
        already, best = self.pool.explained(rest), self.pool.best(rest)
        rows = torch.arange(len(self.pool.motions))
        e = self.pool.effective(rows, best)
        guess = self.pool.mean([(x - a).clamp_min(0) for x, a in zip(e, already)])
        return [(self.value([*rest, k]), [*rest, k]) for k in guess.topk(min(top, len(guess))).indices.tolist() if k not in rest]

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
        """Fit every part anew to what the others leave over; its own motion is among the starts. New fits join the pool."""
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
        self.trace.append({"pool": len(self.pool.motions), "sets": [(round(self.value(f), 4), len(f)) for f in found[:8]]})
        return [(self.value(f), f) for f in found]

    def alternatives(self, solutions: list[tuple[float, list[int]]], count: int = 2) -> list[tuple[float, list[int]]]:
        """The best explanation with one motion exchanged for the best really different one: what a later, sharper look may prefer."""
        if not solutions:
            return []
        chosen, m = solutions[0][1], self.pool.motions
        out = []
        for k in chosen:
            rest = [c for c in chosen if c != k]
            far = m[torch.tensor([k])].swept(self.probe, m)[0] > 3 * self.radius
            already, best = self.pool.explained(rest), self.pool.best(rest)
            e = self.pool.effective(torch.arange(len(m)), best)
            guess = self.pool.mean([(x - a).clamp_min(0) for x, a in zip(e, already)])
            guess = torch.where(far, guess, torch.full_like(guess, -1.0))
            options = [(self.value([*rest, i]), [*rest, i]) for i in guess.topk(min(4, len(guess))).indices.tolist() if far[i]]
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
        if len(a) != len(b):
            return False
        if not a:
            return True
        m = self.pool.motions
        d = m[torch.tensor(a)].swept(self.probe, m[torch.tensor(b)])
        if len(a) > 7:
            return bool((d.min(1).values < self.radius).all())
        return any(all(float(d[i, j]) < self.radius for i, j in enumerate(p)) for p in itertools.permutations(range(len(b))))
