"""Hypotheses with their evidence: what each motion explains of the moved surface, how plausible its joint is, who owns
what it lands on."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.motion.discovery.problem import Problem, balanced
from p2gs.motion.discovery.rigid import Motions
from p2gs.native import native, num_threads


def plausibility(
    problem: Problem, motions: Motions, pays: list[Tensor], samples: list[Tensor], slide_bonus: bool = True
) -> Tensor:
    """Factor [B] in 0..1 on a motion's evidence, from what joints of made things are like.

    * A hinge touches what it carries: distance from the axis to the points that pay, less what must stay unseen near an
      axis.
    * A part's faces lie along or across its joint's axis: share of paying points whose normals are oblique to it.
    * A motion of hardly more than the tolerance is what errors of the surfaces look like.
    * Large motions are a little less likely than small ones; a turn has two freedoms more than a slide.
    """
    cfg, k = problem.config, problem.scale
    sums = joint_sums if all(landing.fused for landing in problem.landings) else joint_sums_reference
    near, oblique, arm, weight = sums(problem, motions, pays, samples)
    unseen = 1.5 * k.tau / (2 * torch.sin(motions.amount.abs().clamp(0.03, math.pi) / 2))
    excess = (near - 0.04 * k.diag - unseen).clamp(0, k.diag)
    turn = 1 - cfg.attach * (excess / (0.12 * k.diag)).clamp(0, 1)
    turn = (
        turn
        * (1 - 0.15 * ((motions.amount.abs() - math.radians(80)) / math.radians(55)).clamp(0, 1))
        * (1 - cfg.slide_bonus * slide_bonus)
    )
    size = motions.amount.abs() / (cfg.max_slide * k.diag)
    slide = (1 - 0.08 * size.clamp(0, 1)) * (1 - 2 * (size - 1).clamp(0, 0.5))
    out = torch.where(motions.turn, turn, slide)
    reach = torch.where(motions.turn, arm / weight * motions.amount.abs(), motions.amount.abs())
    out = out * ((reach / k.tp - 1) / 1.5).clamp(0.1, 1)
    return out * (1 - torch.where(motions.turn, 0.4, 0.6) * ((oblique / weight - 0.3) / 0.4).clamp(0, 1))


def joint_sums_reference(
    problem: Problem, motions: Motions, pays: list[Tensor], samples: list[Tensor]
) -> tuple[Tensor, ...]:
    """Over the points that each motion pays for, [B] each: distance from its axis to the nearest (but a hundredth of
    all); shares of oblique normals, mean distance and share of points, both states added."""
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
    return near, oblique, arm, weight


def joint_sums(problem: Problem, motions: Motions, pays: list[Tensor], samples: list[Tensor]) -> tuple[Tensor, ...]:
    """``joint_sums_reference`` in one pass of a kernel."""
    _, axis, centre, _ = motions.packed()
    near = torch.full((len(motions),), torch.inf)
    total = torch.zeros(len(motions), 3)
    for s in (0, 1):
        rows, index, pay, n = (
            problem.landings[s].rows,
            samples[s].contiguous(),
            pays[s].float().contiguous(),
            len(samples[s]),
        )
        out = torch.empty(len(motions), 4)
        native.evidence_joints(
            rows.data_ptr(),
            len(rows),
            index.data_ptr(),
            n,
            pay.data_ptr(),
            axis.data_ptr(),
            centre.data_ptr(),
            len(motions),
            min(max(1, int(0.01 * n)), n),
            out.data_ptr(),
            num_threads(),
        )
        total += out[:, :3] / max(1, n)
        near = torch.minimum(near, out[:, 3])
    return near, total[:, 1], total[:, 0], total[:, 2] + 1e-6


class Pool:
    """Hypotheses with their evidence over the samples of both states.

    pays [B, P0], [B, P1] in 0..1: saturated (a sharper fit of what is explained already is worth nothing here),
    averaged over a point's neighbours that face alike, times the joint's plausibility.  twin [B, P]: the sample of the
    other state next to where the point lands.  back [B, P]: what that sample pays under the same motion.  owned, loose
    [B, P]: does the point land on a moved surface, on one of unknown fate or none at all.
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
            d, j = (
                torch.from_numpy(np.asarray(a).reshape(len(p), -1)) for a in tree.query(p.numpy(), k=min(k, len(p)))
            )
            w = (
                torch.exp(-((d / d[:, -1].median().clamp_min(1e-9)) ** 2)).float()
                * (n[j] * n[:, None]).sum(2).clamp_min(0) ** 2
            )
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
        """Evidence [R, P] of motions ``rows``, less where the landing place is better explained otherwise (``others``
        [P] per state)."""
        if native is None or not all(map(len, others)):
            return self.effective_reference(rows, others)
        rows, out = rows.contiguous(), []
        for s in (0, 1):
            rival, e = others[1 - s].contiguous(), torch.empty(len(rows), len(self.samples[s]))
            tables = (self.pays[s], self.back[s], self.twin[s], self.owned[s], rival)
            native.evidence_effective(
                [t.data_ptr() for t in tables],
                e.shape[1],
                self.RIVAL,
                self.SHARED,
                rows.data_ptr(),
                len(rows),
                e.data_ptr(),
                num_threads(),
            )
            out.append(e)
        return out

    def effective_reference(self, rows: Tensor, others: list[Tensor]) -> list[Tensor]:
        """``effective`` in torch."""
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
        """Evidence, 0..1: every point goes to the motion that pays most, both states weighted alike, each part's
        evidence balanced."""
        if not len(chosen):
            return 0.0
        rows = torch.tensor(list(chosen))
        shares = self.shares_reference if native is None else self.shares
        return (
            float(balanced(*(shares(s, e, rows) for s, e in enumerate(self.effective(rows, self.best(chosen))))).sum())
            / 2
        )

    def shares(self, state: int, e: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """``shares_reference`` in one pass of a kernel."""
        e, w, out = e.contiguous(), self.problem.weights[state].contiguous(), torch.empty(2, len(rows))
        native.evidence_shares(
            e.data_ptr(), w.data_ptr(), self.loose[state].data_ptr(), rows.data_ptr(), *e.shape, out.data_ptr()
        )
        return out[0], out[1]

    def shares_reference(self, state: int, e: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted evidence [R] of a state's points that motions ``rows`` get, each the points that it pays most for of
        e [R, P]: of points that land on a moved surface or a static one, and of those that land on one of unknown fate
        or none (``loose``)."""
        value, who = e.max(0)
        value = value * self.problem.weights[state]
        loose = self.loose[state][rows].gather(0, who[None])[0]
        zero = torch.zeros(len(rows))
        return zero.index_add(0, who, value * ~loose), zero.index_add(0, who, value * loose)

    def mean(self, e: list[Tensor]) -> Tensor:
        """Weighted mean [B] over both states of evidence [B, P0], [B, P1]."""
        return sum(x @ w for x, w in zip(e, self.problem.weights, strict=False))
