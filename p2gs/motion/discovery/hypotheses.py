"""Rigid-motion hypotheses by exhaustive search: every slide and turn about the object's own directions, on a coarse
grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.fields import Landing, normal_code
from p2gs.motion.discovery.problem import Problem, one_sided
from p2gs.motion.discovery.rigid import Motions, perpendicular

SWEPT = 256  # moved surfels of a state that the sweep looks at
PLATE = 0.5  # thickness of plates in the sweep, coarse voxels: surfaces within three quarters of one count as met
OTHER_SIDE = 0.8  # evidence of a plate's other side beside that of the same surface: its colours confirm nothing


def half_sphere(n: int = 400) -> Tensor:
    """[n, 3] Fibonacci directions with z >= 0."""
    i = torch.arange(n) + 0.5
    z = 1 - i / n
    phi = math.pi * (1 + 5**0.5) * i
    r = (1 - z * z).sqrt()
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], 1)


def normal_peaks(normals: Tensor, n: int, apart: float = 25.0, least: float = 0.03) -> tuple[Tensor, Tensor]:
    """Up to n directions (sign-free) that many normals share, refined by mean shift, and the share of normals within 12
    deg."""
    grid = half_sphere()
    score = ((normals @ grid.T).abs() > math.cos(math.radians(12))).float().mean(0)
    found, share = [], []
    for _ in range(n):
        k = int(score.argmax())
        if float(score[k]) < least:
            break
        d = grid[k]
        for width in (15.0, 10.0, 6.0, 3.0, 2.0):
            c = normals @ d
            near = c.abs() > math.cos(math.radians(width))
            if near.any():
                d = torch.nn.functional.normalize((normals[near] * c[near].sign()[:, None]).sum(0), dim=0)
        found.append(d)
        share.append(float(score[k]))
        score = torch.where((grid @ d).abs() > math.cos(math.radians(apart)), torch.zeros_like(score), score)
    return torch.stack(found) if found else torch.zeros(0, 3), torch.tensor(share)


def directions(problem: Problem, limit: int = 8, apart: float = 12.0) -> Tensor:
    """[D, 3] candidate axes: what the surfaces face, what the moved surfaces face, and where moved facings of the two
    states cross."""
    everything = torch.cat([s.normals for s in problem.surfels])
    moved = [problem.surfels[s].normals[problem.moved[s]] for s in (0, 1)]
    chosen: list[Tensor] = []

    def add(candidates: Tensor) -> None:
        for d in candidates:
            if len(chosen) < limit and all(float((d @ c).abs()) < math.cos(math.radians(apart)) for c in chosen):
                chosen.append(d)

    def flat_axis(n: Tensor) -> Tensor:  # the direction that the fewest normals have a part along
        return torch.linalg.eigh(n.T @ n)[1][:, :1].T

    add(normal_peaks(everything, 3, apart=40.0)[0])
    add(torch.cat([flat_axis(n) for n in (torch.cat(moved), everything)]))
    peaks = [normal_peaks(m, 4)[0] for m in moved]
    crosses = [
        torch.linalg.cross(a, b) for a in peaks[0] for b in peaks[1] if float(torch.linalg.cross(a, b).norm()) > 0.2
    ]
    if crosses:
        crosses = torch.nn.functional.normalize(torch.stack(crosses), dim=1)
        both = torch.cat(moved)
        flat = ((both @ crosses.T).abs() < 0.17).float().mean(0)
        add(crosses[flat.argsort(descending=True)][:4])
    add(torch.cat(peaks))
    add(normal_peaks(everything, 6)[0])
    if len(chosen) < 3:
        add(torch.eye(3))
    return torch.stack(chosen)


def static_axes(problem: Problem) -> Tensor:
    """``shared_directions`` of the surfaces of both states that never moved."""
    return shared_directions(torch.cat([problem.surfels[s].normals[~problem.moved[s]] for s in (0, 1)]))


def shared_directions(normals: Tensor) -> Tensor:
    """[D, 3] directions that many normals [N, 3] (unit, sign-free) share, and where pairs of them cross."""
    peaks = normal_peaks(normals, 3, apart=40.0, least=0.06)[0] if len(normals) else torch.zeros(0, 3)
    out = list(peaks)
    for i in range(len(peaks)):
        for j in range(i):
            c = torch.linalg.cross(peaks[i], peaks[j])
            c = c / c.norm()
            if all(float((c @ p).abs()) < math.cos(math.radians(20)) for p in out):
                out.append(c)
    return torch.stack(out) if out else torch.zeros(0, 3)


def arrival_table(landing: Landing, moved: Tensor, share: float = 1.0) -> Tensor:
    """[27 * voxels] uint8: how well a facing pattern at a coarse voxel finds a like surfel there, 0..255 times
    ``share``; never-moved ones count less. The lowest bit says that the surfel's fate is unknown."""
    centre = landing._centres(landing.coarse, landing.hc)
    near = landing.nearest.reshape(27, -1).long()
    d = (landing.surfels.points[near] - centre).norm(dim=2)
    q = (1.75 - d / landing.hc).clamp(0, 1) * (0.3 + 0.4 * (~landing.static[near]).float() + 0.3 * moved[near].float())
    loose = ~(moved | landing.static)[near]
    return (((q * share * 255).to(torch.uint8) & 0xFE) | loose.to(torch.uint8)).reshape(-1)


@dataclass
class Sweep:
    """Every motion tried and its evidence [H, P0 + P1] (uint8, as in ``arrival_table``) over a sample of the moved
    points of both states.  one_sided: one of the states shows next to nothing that moved."""

    motions: Motions
    evidence: Tensor
    samples: list[Tensor]
    one_sided: bool = False

    def gain(self, weights: list[Tensor], unknown: bool = False, chunk: int = 20000) -> Tensor:
        """Evidence of each motion, points weighted [P0], [P1] (both states' weights sum to at most 2); states must
        agree, but for what arrives on surfaces of ``unknown`` fate, which cannot answer (counted always where one state
        shows next to nothing that moved)."""
        n = len(weights[0])
        w = torch.zeros(n + len(weights[1]), 2)
        w[:n, 0], w[n:, 1] = weights[0] / 255, weights[1] / 255
        rows = self.evidence.split(chunk)
        a, b = torch.cat([r.float() @ w for r in rows]).T
        free = (
            torch.cat([(r * (r % 2)).float() @ w for r in rows]).T
            if self.one_sided or unknown
            else torch.zeros(2, len(a))
        )
        known = torch.minimum(a - free[0], 3 * b + 0.03) + torch.minimum(b - free[1], 3 * a + 0.03)
        return known + free.sum(0)


def angles_of(config: DiscoveryConfig) -> Tensor:
    """The angles that turns are searched at, radians."""
    return torch.arange(math.radians(config.min_angle), math.radians(config.max_angle) + 0.01, math.radians(7.0))


def sweep(problem: Problem, axes: Tensor, keep: int = 120000) -> Sweep:
    """Try all slides and turns about ``axes`` on ``SWEPT`` of the problem's samples; steps are a voxel or so of
    displacement.

    Only motions with some evidence in both states, or much in one, are kept, at most ``keep`` of them.
    """
    cfg, diag = problem.config, problem.scale.diag
    samples = [s[torch.linspace(0, len(s) - 1, min(SWEPT, len(s))).long()] for s in problem.samples]
    landings = problem.landings
    tables = [arrival_table(landings[s], problem.moved[s]) for s in (0, 1)]
    behind = [arrival_table(landings[s], problem.moved[s], OTHER_SIDE) for s in (0, 1)]
    hc, lo, size = landings[0].hc, landings[0].lo, landings[0].coarse
    voxels = int(size.prod())
    points = [(problem.surfels[s].points[samples[s]] - lo) / hc for s in (0, 1)]
    normals = [problem.surfels[s].normals[samples[s]] for s in (0, 1)]
    top = (size - 1).to(torch.float32)
    stride = torch.tensor([float(size[1] * size[2]), float(size[2]), 1.0])

    def look(base: Tensor, facing: Tensor, shift: Tensor, table: Tensor) -> Tensor:
        """base [P, 3] and shift [C, 3] in voxels -> evidence [C, P]."""
        index = (normal_code(facing).long() * voxels).to(torch.float32).expand(len(shift), -1).clone()
        for k in range(3):
            x = base[:, k] + shift[:, k : k + 1]
            index += x.clamp_(0.0, float(top[k])).floor_().mul_(float(stride[k]))
        return table[index.long()]

    kept: list[tuple[Motions, Tensor]] = []

    n = len(samples[0])

    def keep_good(motions: Motions, q: Tensor, least: float = 0.02) -> None:
        a, b = q[:, :n].float().mean(1) / 255, q[:, n:].float().mean(1) / 255
        ok = (torch.minimum(a, b) > least) | (torch.maximum(a, b) > 3 * least)
        kept.append((motions[ok], q[ok]))

    amounts = torch.arange(1.0, cfg.max_slide * diag / (0.8 * hc)) * 0.8 * hc
    amounts = torch.cat([amounts, -amounts, torch.tensor([0.4 * hc, -0.4 * hc])])
    for d in axes:
        shift = amounts[:, None] * d / hc
        q = torch.cat(
            [look(points[0], normals[0], shift, tables[1]), look(points[1], normals[1], -shift, tables[0])], 1
        )
        C = len(amounts)
        keep_good(Motions(torch.zeros(C, dtype=torch.bool), d.expand(C, 3), problem.centre.expand(C, 3), amounts), q)
    span = hc * (size - 1)
    for d in axes:
        e1, e2 = perpendicular(d)
        frame = torch.stack([e1, e2, d])
        half = (frame.abs() @ span) / 2 + 0.02 * diag
        for angle in angles_of(cfg).tolist():
            step = min(max(1.4 * hc / (2 * math.sin(angle / 2)), 0.02 * diag), 0.09 * diag)
            g = [torch.arange(-float(half[k]), float(half[k]) + step, step) for k in (0, 1)]
            grid = torch.stack(torch.meshgrid(*g, indexing="ij"), -1).reshape(-1, 2)
            centre = problem.centre + grid @ frame[:2]
            C = len(centre)
            for sign in (1.0, -1.0):
                m = Motions(torch.ones(C, dtype=torch.bool), d.expand(C, 3), centre, torch.full((C,), sign * angle))
                R = m[:1].matrices()[0][0]
                shifts = [(centre - lo) / hc @ (torch.eye(3) - turn).T for turn in (R, R.T)]
                q = []
                # a plate may arrive with either side to the cameras: what turns shows other sides
                for s, turn in enumerate((R, R.T)):
                    p, facing = points[s] @ turn.T, normals[s] @ turn.T
                    same = look(p, facing, shifts[s], tables[1 - s])
                    other = look(p - PLATE * facing, -facing, shifts[s], behind[1 - s])
                    q.append(torch.maximum(same, other))
                keep_good(m, torch.cat(q, 1))
    motions = Motions.cat([m for m, _ in kept])
    evidence = torch.cat([q for _, q in kept])
    if len(motions) > keep:
        score = evidence.float().sum(1)
        index = score.topk(keep).indices.sort().values
        motions, evidence = motions[index], evidence[index]
    return Sweep(motions, evidence, samples, one_sided(problem))


def distinct(motions: Motions, score: Tensor, probe: Tensor, radius: float, count: int) -> Tensor:
    """Indices of the best ``count`` motions that move the probe points [P, 3] apart by more than ``radius`` (rms) from
    better ones."""
    order = score.argsort(descending=True)[: 40 * count]
    m = motions[order]
    image = m.apply(probe).reshape(len(m), -1) / math.sqrt(len(probe))
    alive = torch.ones(len(m), dtype=torch.bool)
    out = []
    for i in range(len(m)):
        if not alive[i]:
            continue
        out.append(int(order[i]))
        if len(out) == count:
            break
        alive &= (image - image[i]).norm(dim=1) > radius
    return torch.tensor(out, dtype=torch.long)
