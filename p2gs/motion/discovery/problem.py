"""The search problem: surfels of both states, which of them moved, and sampled points with their landing costs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.fields import Landing, Scale
from p2gs.motion.discovery.rigid import Motions
from p2gs.ops.robust import MEDIAN_SIGMA
from p2gs.visibility.depth_stack import DepthStack, StateEvidence, classify
from p2gs.visibility.surfels import Surfels, build_surfels

MARGIN = 0.28  # costs above this are no evidence for a motion
SOFT = 0.10
FEWEST = 3  # moved surfels of a state that can be searched: three points make a motion


@dataclass
class Problem:
    """surfels, stacks, landings, moved, static and replaced masks by state; ``samples``: indices of the moved surfels
    the search looks at.

    trust [N] per state, 0.1..1: how credible it is that a moved surfel moved; ``weights`` [P] per state: that of the
    samples, sum 2 over both states (``resampled``).
    """

    config: DiscoveryConfig
    scale: Scale
    stacks: list[DepthStack]
    surfels: list[Surfels]
    moved: list[Tensor]
    static: list[Tensor]
    landings: list[Landing]
    samples: list[Tensor]
    weights: list[Tensor]
    trust: list[Tensor]
    centre: Tensor
    replaced: list[Tensor]

    def cost(self, motions: Motions, state: int, index: Tensor, claimed: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Landing cost [B, P] of surfels ``index`` of ``state`` under each motion (start by T, end by T^-1), and what
        they meet."""
        return self.landings[1 - state].arrive(motions, self.landings[state], index, state == 1, claimed)

    def pay(
        self, motions: Motions, samples: list[Tensor] | None = None, chunk: int = 64
    ) -> list[tuple[Tensor, Tensor]]:
        """Evidence [B, P] by state: how much below ``unexplained`` a point costs; only true arrivals on a surface pay.
        With it, whether [B, P] the point arrives on a surface that is neither known to have moved nor to have
        stayed."""
        samples = self.samples if samples is None else samples
        out = []
        for s in (0, 1):
            pays, loose = [torch.zeros(0, len(samples[s]))], [torch.zeros(0, len(samples[s]), dtype=torch.bool)]
            for i in range(0, len(motions), chunk):
                cost, j = self.cost(motions[i : i + chunk], s, samples[s])
                pays.append(paid(cost, self.config.unexplained))
                loose.append(self.loose(1 - s, j))
            out.append((torch.cat(pays), torch.cat(loose)))
        return out

    def loose(self, state: int, index: Tensor) -> Tensor:
        """Are these surfels of ``state`` of unknown fate?"""
        return (~(self.moved[state] | self.static[state]))[index]


def balanced(start: tuple[Tensor, Tensor], end: tuple[Tensor, Tensor]) -> Tensor:
    """Evidence of both states together, each given as (on surfaces of known fate, on surfaces of unknown fate).

    What arrives on a moved surface must be answered from there, so neither state's counts for over three times the
    other's; a surface of unknown fate (hidden from the other state, or wrongly rebuilt there) cannot answer.
    """
    a, b = start[0] + start[1], end[0] + end[1]
    return torch.minimum(start[0], 3 * b + 0.001) + torch.minimum(end[0], 3 * a + 0.001) + start[1] + end[1]


def paid(cost: Tensor, unexplained: float) -> Tensor:
    """Evidence of a landing cost: what it saves, fading out towards ``MARGIN``."""
    return (unexplained - cost).clamp_min(0) * ((MARGIN - cost) / SOFT).clamp(0, 1)


def smooth_mask(points: Tensor, mask: Tensor, k: int = 8) -> Tensor:
    """Majority over a point and its k neighbours."""
    _, idx = cKDTree(points.numpy()).query(points.numpy(), k=min(k + 1, len(points)))
    return mask[torch.from_numpy(np.asarray(idx).reshape(len(points), -1))].float().mean(1) > 0.5


def evidence_masks(
    surfels: list[Surfels], stacks: list[DepthStack], tau: float, recoloured: float
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Per state (moved, static, replaced) [N] bool: tested against the *other* state's depth maps; the rest is unknown.

    What the other state sees through has moved, and so has what has there in its place a surface of another colour
    (mean difference of the channels above ``recoloured``): it is among the moved, and ``replaced``, as only one of the
    two need have moved; the other was behind it.
    """
    moved, static, replaced = [], [], []
    for s in (0, 1):
        free, on, _ = stacks[1 - s].counts(surfels[s].points, tau)
        m, still = classify(free, on, need=min(3.0, max(1.0, len(stacks[1 - s]) / 8)))
        m = smooth_mask(surfels[s].points, m)
        other = surfels[1 - s]
        d, j = other.nearest(surfels[s].points, 4)
        like = ((other.normals[j] * surfels[s].normals[:, None]).sum(2) > 0.7) & (
            d < 2 * max(surfels[0].spacing, surfels[1].spacing)
        )
        # where a door stood shut the open state is often rebuilt with a lid over the opening: the place is taken, the
        # colour is not
        near = still & like.any(1) & ~m
        apart = (other.colours[j] - surfels[s].colours[:, None]).abs().mean(2)
        other_colour = torch.where(like, apart, torch.full_like(apart, 9.0)).min(1).values > recoloured
        changed = near & other_colour & smooth_mask(surfels[s].points, near & other_colour)
        moved.append(m | changed)
        static.append(near & ~other_colour & ~moved[-1])
        replaced.append(changed)
    return moved, static, replaced


def credibility(surfels: Surfels, other: Surfels, stack: DepthStack, moved: Tensor, scale: Scale) -> Tensor:
    """[N] 0.1..1: moved surfels that are only just seen through, or have a like surface close by in the other state,
    may be errors."""
    index = torch.nonzero(moved)[:, 0]
    out = torch.full((len(surfels),), 0.1)
    if not len(index):
        return out
    p, n = surfels.points[index], surfels.normals[index]
    far = ((stack.excess(p, scale.tau) - 1.3) / 2.0).clamp(0.1, 1)
    j = other.nearest(p, 24)[1]
    d = other.points[j] - p[:, None]
    across = (d * n[:, None]).sum(2).abs()
    along = (d.pow(2).sum(2) - across**2).clamp_min(0).sqrt()
    like = ((other.normals[j] * n[:, None]).sum(2) > 0.7) & (along < 2 * scale.spacing) & (across < 1.3 * scale.tp)
    out[index] = far * torch.where(like.any(1), 0.5, 1.0)
    return out.clamp_min(0.1)


def disagreement(surfels: list[Surfels], limit: float) -> float:
    """Robust standard deviation of one state's surface about the other's where both lie within ``limit``: most of it
    never moved."""
    near, j = (x[:, 0] for x in surfels[1].nearest(surfels[0].points, 1))
    d = ((surfels[1].points[j] - surfels[0].points) * surfels[1].normals[j]).sum(1).abs()
    ok = (near < limit) & ((surfels[1].normals[j] * surfels[0].normals).sum(1) > 0.8)
    return float(MEDIAN_SIGMA * d[ok].median()) if ok.sum() > 20 else 0.0


def build_problem(start: StateEvidence, end: StateEvidence, config: DiscoveryConfig, seed: int) -> tuple[Problem, dict]:
    """Surfels, masks and look-ups of both states, and each stage's figures."""
    stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in (start, end)]
    points = torch.cat([e.points for e in (start, end)])
    box = torch.quantile(
        points[torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))[:100000]],
        torch.tensor([0.005, 0.995]),
        0,
    )
    diag = float((box[1] - box[0]).norm())
    built = [
        build_surfels(e, st, diag, config.surfels, config.noise_floor)
        for e, st in zip((start, end), stacks, strict=False)
    ]
    surfels = [b[0] for b in built]
    noise, spacing = max(s.noise for s in surfels), max(s.spacing for s in surfels)
    tau = 3 * noise + 0.2 * spacing
    noise = max(noise, disagreement(surfels, 0.025 * diag))
    scale = Scale(tau=tau, tp=config.tolerance * noise + 0.2 * spacing, spacing=spacing, diag=diag)
    moved, static, replaced = evidence_masks(surfels, stacks, scale.tau, config.recoloured)
    both = torch.cat([s.points for s in surfels])
    lo, hi = both.min(0).values - 0.04 * diag, both.max(0).values + 0.04 * diag
    landings = [Landing(surfels[s], static[s], stacks[s], lo, hi, scale) for s in (0, 1)]
    trust = [credibility(surfels[s], surfels[1 - s], stacks[1 - s], moved[s], scale) for s in (0, 1)]
    problem = Problem(config, scale, stacks, surfels, moved, static, landings, [], [], trust, (lo + hi) / 2, replaced)
    problem = resampled(problem, seed)
    figures = {
        "diag": diag,
        "noise": noise,
        "tau": scale.tau,
        "states": [
            b[1] | {"moved": int(m.sum()), "static": int(t.sum()), "unknown": int((~m & ~t).sum())}
            for b, m, t in zip(built, moved, static, strict=False)
        ],
    }
    return problem, figures


def one_sided(problem: Problem) -> bool:
    """Does one of the states show next to nothing that moved?"""
    return min(int(m.sum()) for m in problem.moved) < FEWEST


def resampled(problem: Problem, seed: int) -> Problem:
    """The problem with moved surfels drawn anew to look at (``samples``) and their weights: both states count alike.

    Where one state shows next to nothing that moved (of a shut drawer the front alone, before which the open drawer
    stands in the other state), it is looked at where its fate is unknown, and each surfel counts alike.
    """
    g = torch.Generator().manual_seed(seed)
    by_surface, samples, weights = one_sided(problem), [], []
    for s in (0, 1):
        index = torch.nonzero(problem.moved[s])[:, 0]
        if len(index) < FEWEST:
            index = torch.nonzero(~problem.static[s])[:, 0]
        samples.append(index[spread_sample(problem.surfels[s].points[index], problem.config.samples, g)])
        weight = problem.trust[s][samples[s]]
        weights.append(
            weight * len(index) / max(len(weight), 1) if by_surface else weight / weight.sum().clamp_min(1e-9)
        )
    total = sum(float(w.sum()) for w in weights) if by_surface else 2.0
    return replace(problem, samples=samples, weights=[2 * w / max(total, 1e-9) for w in weights])


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
