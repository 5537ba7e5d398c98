"""The search problem: surfels of both states, which of them moved, and sampled points with their landing costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from p2gs.models.discovery.config import DiscoveryConfig
from p2gs.models.discovery.evidence import DepthStack, StateEvidence, classify
from p2gs.models.discovery.fields import Landing, Scale
from p2gs.models.discovery.rigid import Motions
from p2gs.models.discovery.surfels import Surfels, build_surfels

MARGIN = 0.28  # costs above this are no evidence for a motion
SOFT = 0.10


@dataclass
class Problem:
    """surfels, stacks, landings, moved and static masks by state; ``samples``: indices of the moved surfels the search looks at."""

    config: DiscoveryConfig
    scale: Scale
    stacks: list[DepthStack]
    surfels: list[Surfels]
    moved: list[Tensor]
    static: list[Tensor]
    landings: list[Landing]
    samples: list[Tensor]
    centre: Tensor

    def points(self, state: int) -> Tensor:
        return self.surfels[state].points[self.samples[state]]

    def cost(self, motions: Motions, state: int, index: Tensor, claimed: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Landing cost [B, P] of surfels ``index`` of ``state`` under each motion (start by T, end by T^-1), and what they meet."""
        s = self.surfels[state]
        back = state == 1
        return self.landings[1 - state].cost(
            motions.apply(s.points[index], back), motions.rotate(s.normals[index], back), s.colours[index], claimed
        )

    def pay(self, motions: Motions, samples: list[Tensor] | None = None, chunk: int = 64) -> list[Tensor]:
        """Evidence [B, P] by state: how much below ``unexplained`` a point costs; only true arrivals on a surface pay."""
        samples = self.samples if samples is None else samples
        out = []
        for state in (0, 1):
            rows = [paid(self.cost(motions[i : i + chunk], state, samples[state])[0], self.config.unexplained) for i in range(0, len(motions), chunk)]
            out.append(torch.cat(rows) if rows else torch.zeros(0, len(samples[state])))
        return out


def paid(cost: Tensor, unexplained: float) -> Tensor:
    """Evidence of a landing cost: what it saves, fading out towards ``MARGIN``."""
    return (unexplained - cost).clamp_min(0) * ((MARGIN - cost) / SOFT).clamp(0, 1)


def smooth_mask(points: Tensor, mask: Tensor, k: int = 8) -> Tensor:
    """Majority over a point and its k neighbours."""
    _, idx = cKDTree(points.numpy()).query(points.numpy(), k=min(k + 1, len(points)))
    return mask[torch.from_numpy(np.asarray(idx).reshape(len(points), -1))].float().mean(1) > 0.5


def evidence_masks(surfels: list[Surfels], stacks: list[DepthStack], tau: float) -> tuple[list[Tensor], list[Tensor]]:
    """Per state (moved, static) [N] bool: tested against the *other* state's depth maps; the rest is unknown."""
    moved, static = [], []
    for s in (0, 1):
        free, on, _ = stacks[1 - s].counts(surfels[s].points, tau)
        m, still = classify(free, on, need=min(3.0, max(1.0, len(stacks[1 - s]) / 8)))
        m = smooth_mask(surfels[s].points, m)
        other = surfels[1 - s]
        d, j = cKDTree(other.points.numpy()).query(surfels[s].points.numpy(), k=min(4, len(other)))
        j = torch.from_numpy(np.asarray(j).reshape(len(surfels[s]), -1))
        d = torch.from_numpy(np.asarray(d).reshape(len(surfels[s]), -1))
        like = ((other.normals[j] * surfels[s].normals[:, None]).sum(2) > 0.7) & (d < 2 * max(surfels[0].spacing, surfels[1].spacing))
        moved.append(m)
        static.append(still & like.any(1) & ~m)
    return moved, static


def disagreement(surfels: list[Surfels], limit: float) -> float:
    """Robust standard deviation of one state's surface about the other's where both lie within ``limit``: most of it never moved."""
    near, j = cKDTree(surfels[1].points.numpy()).query(surfels[0].points.numpy())
    j = torch.from_numpy(j)
    d = ((surfels[1].points[j] - surfels[0].points) * surfels[1].normals[j]).sum(1).abs()
    ok = (torch.from_numpy(near) < limit) & ((surfels[1].normals[j] * surfels[0].normals).sum(1) > 0.8)
    return float(1.4826 * d[ok].median()) if ok.sum() > 20 else 0.0


def build_problem(start: StateEvidence, end: StateEvidence, config: DiscoveryConfig, seed: int) -> tuple[Problem, dict]:
    """Surfels, masks and look-ups of both states, and each stage's figures."""
    stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in (start, end)]
    points = torch.cat([e.points for e in (start, end)])
    box = torch.quantile(points[torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))[:100000]], torch.tensor([0.005, 0.995]), 0)
    diag = float((box[1] - box[0]).norm())
    built = [build_surfels(e, st, diag, config.surfels, config.noise_floor) for e, st in zip((start, end), stacks)]
    surfels = [b[0] for b in built]
    noise, spacing = max(s.noise for s in surfels), max(s.spacing for s in surfels)
    tau = 3 * noise + 0.2 * spacing
    noise = max(noise, disagreement(surfels, 0.025 * diag))
    scale = Scale(tau=tau, tp=config.tolerance * noise + 0.2 * spacing, spacing=spacing, diag=diag)
    moved, static = evidence_masks(surfels, stacks, scale.tau)
    both = torch.cat([s.points for s in surfels])
    lo, hi = both.min(0).values - 0.04 * diag, both.max(0).values + 0.04 * diag
    landings = [Landing(surfels[s], static[s], stacks[s], lo, hi, scale) for s in (0, 1)]
    g = torch.Generator().manual_seed(seed)
    samples = []
    for s in (0, 1):
        index = torch.nonzero(moved[s])[:, 0]
        samples.append(index[spread_sample(surfels[s].points[index], config.samples, g)])
    problem = Problem(config, scale, stacks, surfels, moved, static, landings, samples, (lo + hi) / 2)
    figures = {
        "diag": diag,
        "noise": noise,
        "tau": scale.tau,
        "states": [
            b[1] | {"moved": int(m.sum()), "static": int(t.sum()), "unknown": int((~m & ~t).sum())} for b, m, t in zip(built, moved, static)
        ],
    }
    return problem, figures


def spread_sample(points: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """At most n indices spread evenly over the surface: one per cell of a grid that is coarsened until they fit."""
    if len(points) <= n:
        return torch.arange(len(points))
    order = torch.randperm(len(points), generator=generator)
    p = points[order]
    lo, size = p.min(0).values, float((p.max(0).values - p.min(0).values).max())
    low, high = size / 400, size
    best = order[:n]
    for _ in range(12):
        cell = (low * high) ** 0.5
        code = ((p - lo) / cell).long()
        code = (code[:, 0] * 4096 + code[:, 1]) * 4096 + code[:, 2]
        _, inverse = torch.unique(code, return_inverse=True)
        first = torch.full((int(inverse.max()) + 1,), len(p)).scatter_reduce_(0, inverse, torch.arange(len(p)), "amin")
        if len(first) > n:
            low = cell
        else:
            best, high = order[first.sort().values], cell
    return best
