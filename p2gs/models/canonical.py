"""The motion-aware canonical field (paper section 4.1): motion richness D, beta, Hungarian matching, fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from p2gs.gaussians.handover import CanonicalGaussians, PartMotions
from p2gs.gaussians.pose import carry, with_static
from p2gs.motion.matching import beta_weight, hungarian_pairs, motion_clusters, motion_richness
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.types import GaussianTensors, UserError


@dataclass
class CanonicalConfig:
    """How two single-state reconstructions become one.

    beta: "global" (paper Eq. for beta from motion richness), "uniform" (0.5) or "per_part" (each part its own D;
    ablation; where no parts are known, ``motion_clusters`` of the pairs stand for them).
    correspondence: "motion" carries both states to canonical time by the discovered motions before matching;
    "hungarian" is the paper's letter: raw centres are matched and a pair is joined by a chord. match_size: farthest
    points per state that are matched.
    match_smaller: "farthest" cuts both states to ``match_size``; "whole" keeps all of the smaller state (the paper
    names no cut; both uncut, 100,000 Gaussians a state make a matrix of 80 GB).
    fusion: "union" keeps the Gaussians of the motion-rich state and adds what only the other state saw; "paper"
    replaces matched Gaussians by beta-weighted averages of all parameters and keeps unmatched ones by ``unmatched``:
    "static" (those of the motion-rich state that did not move), "none" or "all". "none" is the ablation without
    canonical initialisation: the start state's Gaussians as they are, at canonical time 0, with no observed pairs.
    min_opacity: fainter Gaussians take no part in D and matching (0 = all do).  trim: fraction of the largest distances
    left out of D (floaters).
    free_space: tolerance (internal units) of the test that drops or relabels what the other state's cameras see
    through; 0 = off.
    hidden: what only the poorer state saw is kept where this share of the richer state's views has something in front
    of it; elsewhere the richer state shows what there is (0 = all is kept; needs free_space).
    """

    beta: Literal["global", "uniform", "per_part"] = "global"
    correspondence: Literal["motion", "hungarian"] = "motion"
    match_size: int = 3000
    match_smaller: Literal["farthest", "whole"] = "farthest"
    fusion: Literal["union", "paper", "none"] = "union"
    unmatched: Literal["static", "none", "all"] = "static"
    min_opacity: float = 0.5
    trim: float = 0.02
    free_space: float = 0.03
    hidden: float = 0.75


def keep_rows(c: CanonicalGaussians, labels: Tensor, keep: Tensor) -> CanonicalGaussians:
    """The canonical Gaussians of ``keep`` [N] bool with new ``labels`` [N]; a relabelled one is no observed pair any
    more."""
    paired = c.paired & (labels == c.labels)
    offsets = None if c.offsets is None else c.offsets[keep]
    counted = {**c.diagnostics, "relabelled": int((keep & (labels != c.labels)).sum()), "dropped": int((~keep).sum())}
    kept = (labels[keep], c.margin[keep], paired[keep], c.mu0[keep], c.mu1[keep])
    return CanonicalGaussians(c.gaussians[keep], c.betas, *kept, offsets, counted)


def blend(a: GaussianTensors, b: GaussianTensors, weight: float | Tensor) -> GaussianTensors:
    """weight * a + (1 - weight) * b of all stored parameters (weight a float or [N, 1]); quaternions in one hemisphere,
    normalised."""
    qa, qb = so3.quat_normalize(a.quats), so3.quat_normalize(b.quats)
    qb = torch.where((qa * qb).sum(1, keepdim=True) < 0, -qb, qb)
    w = torch.as_tensor(weight, dtype=a.means.dtype).expand(len(a), 1)

    def mix(x: Tensor, y: Tensor) -> Tensor:
        shape = [-1] + [1] * (x.dim() - 1)
        return w.reshape(shape) * x + (1 - w).reshape(shape) * y

    mixed = {n: mix(getattr(a, n), getattr(b, n)) for n in GaussianTensors.NAMES if n != "quats"}
    return GaussianTensors(quats=so3.quat_normalize(mix(qa, qb)), **mixed)


def fuse(
    g0: GaussianTensors,
    g1: GaussianTensors,
    motions: PartMotions | None,
    config: CanonicalConfig,
    hidden: tuple[Tensor, Tensor] | None = None,
    num_parts: int | None = None,
) -> CanonicalGaussians:
    """Two single-state reconstructions -> one canonical field.

    hidden: [N] float by state, the share of the other state's views that has something in front of each Gaussian
    (``hidden_share``).
    num_parts: K, the static base counted, for ``beta: per_part`` without motions.
    Without motions (or with ``correspondence: hungarian``) a matched pair becomes beta mu0 + (1-beta) mu1 and remembers
    its chord. Raises UserError when ``beta: per_part`` is asked for without parts and without their number.
    """
    solid = [torch.sigmoid(g.opacity_logits) > config.min_opacity for g in (g0, g1)]
    if config.min_opacity <= 0:
        solid = [torch.ones(len(g), dtype=torch.bool) for g in (g0, g1)]
    p0, p1 = g0.means[solid[0]], g1.means[solid[1]]
    if min(len(p0), len(p1)) < 10:
        raise UserError(
            f"canonical_fusion: only {min(len(p0), len(p1))} Gaussians of a state are opaque; expected an object "
            "(train single_state longer)"
        )
    if config.fusion == "none":
        return _start_state_only(g0, motions)
    d01, d10 = motion_richness(p0, p1, config.trim), motion_richness(p1, p0, config.trim)
    parts = 1 + (len(motions) if motions is not None else 0)
    betas = torch.full((parts,), 0.5 if config.beta == "uniform" else beta_weight(d01, d10), dtype=torch.float64)
    if config.beta == "per_part" and motions is None and num_parts is None:
        raise UserError("canonical_fusion.beta: per_part needs discovered parts or their number (--num_parts N)")
    if config.beta == "per_part" and motions is not None:
        for k in range(1, parts):
            a, b = p0[motions.labels[0][solid[0]] == k], p1[motions.labels[1][solid[1]] == k]
            if min(len(a), len(b)) >= 10:
                betas[k] = beta_weight(motion_richness(a, p1, config.trim), motion_richness(b, p0, config.trim))
    if motions is None or config.correspondence == "hungarian":
        return _fuse_chords(g0, g1, motions, solid, betas, d01 >= d10, config, num_parts)
    return _fuse_motions(g0, g1, motions, solid, betas, d01 >= d10, config, hidden)


def _start_state_only(g0, motions) -> CanonicalGaussians:
    """No canonical initialisation: beta = 1 puts canonical time at the start state."""
    betas = torch.ones(1 + (len(motions) if motions is not None else 0), dtype=torch.float64)
    labels = motions.labels[0] if motions is not None else torch.zeros(len(g0), dtype=torch.int64)
    margin = motions.margin[0] if motions is not None else torch.zeros(len(g0))
    nothing = torch.zeros(0, 3)
    return _with_pairs(g0, betas, labels, margin, torch.zeros(0, dtype=torch.int64), nothing, nothing)


def _fuse_chords(g0, g1, motions, solid, betas, start_is_rich, config, num_parts) -> CanonicalGaussians:
    """The paper's letter."""
    s0, s1 = solid[0].nonzero().squeeze(1), solid[1].nonzero().squeeze(1)
    i, j = hungarian_pairs(g0.means[s0], g1.means[s1], config.match_size, config.match_smaller == "whole")
    i, j = s0[i], s1[j]
    labels = margin = None
    if motions is not None:
        labels, margin = motions.labels, motions.margin
        weight = betas[labels[0][i]][:, None]
    elif config.beta == "per_part":
        weight = _cluster_betas(
            g0.means[i], g1.means[j], g0.means[s0], g1.means[s1], num_parts - 1, float(betas[0]), config.trim
        )[:, None]
    else:
        weight = float(betas[0])
    pairs = blend(g0[i], g1[j], weight)
    rich, other, own, state = (g0, g1, i, 0) if start_is_rich else (g1, g0, j, 1)
    rest = _unmatched(rich, other, own, config)
    kept = rich[rest]
    n = len(i) + len(kept)
    g = GaussianTensors.cat([pairs, kept])
    new_labels, new_margin = torch.zeros(n, dtype=torch.int64), torch.zeros(n)
    if labels is not None and margin is not None:
        new_labels = torch.cat([labels[0][i], labels[state][rest]])
        new_margin = torch.cat([margin[0][i], margin[state][rest]])
    offsets = torch.zeros(n, 2, 3)
    offsets[: len(i), 0] = g0.means[i] - pairs.means
    offsets[: len(i), 1] = g1.means[j] - pairs.means
    return _with_pairs(g, betas, new_labels, new_margin, torch.arange(len(i)), g0.means[i], g1.means[j], offsets)


def _cluster_betas(
    start: Tensor, end: Tensor, all0: Tensor, all1: Tensor, movable: int, rest: float, trim: float
) -> Tensor:
    """beta [M] of each pair: of its motion cluster by the cluster's own D, ``rest`` where it is still. all0, all1 [N,
    3]: the states."""
    cluster = motion_clusters(start, end, movable)
    betas = torch.full((len(start),), rest, dtype=torch.float64)
    for k in range(1, movable + 1):
        rows = cluster == k
        if int(rows.sum()) >= 10:
            betas[rows] = beta_weight(motion_richness(start[rows], all1, trim), motion_richness(end[rows], all0, trim))
    return betas


def _unmatched(rich, other, own, config) -> Tensor:
    """Which Gaussians of the motion-rich state are kept beside the pairs, [N] bool."""
    rest = torch.ones(len(rich), dtype=torch.bool)
    rest[own] = False
    if config.unmatched == "none":
        rest[:] = False
    elif config.unmatched == "static":
        distance = knn(other.means, rich.means, 1, False)[0][:, 0]
        rest &= distance < 2 * distance.median().clamp_min(1e-4)
    return rest


def _with_pairs(g, betas, labels, margin, index, mu0, mu1, offsets=None) -> CanonicalGaussians:
    paired = torch.zeros(len(g), dtype=torch.bool)
    paired[index] = True
    both = torch.zeros(2, len(g), 3)
    both[0, index], both[1, index] = mu0, mu1
    return CanonicalGaussians(g.clone(), betas, labels, margin, paired, both[0], both[1], offsets)


def _fuse_motions(g0, g1, motions, solid, betas, start_is_rich, config, hidden) -> CanonicalGaussians:
    """Carry both states to canonical time along the screws, match there, and join."""
    T, times = with_static(motions.transforms), 1.0 - betas
    labels, margin = motions.labels, motions.margin
    at = [carry(g, labels[s], se3.screw_at(T, times - s)) for s, g in enumerate((g0, g1))]
    i, j = _match_parts(at, labels, solid, config)
    rich, poor = (0, 1) if start_is_rich else (1, 0)
    own = (i, j)[rich]
    if config.fusion == "paper":
        rest = _unmatched(at[rich], at[poor], own, config)
        pairs = blend(at[0][i], at[1][j], betas[labels[0][i]][:, None])
        g = GaussianTensors.cat([pairs, at[rich][rest]])
        index = torch.arange(len(i))
        new_labels = torch.cat([labels[rich][own], labels[rich][rest]])
        new_margin = torch.cat([margin[rich][own], margin[rich][rest]])
    else:
        spacing = knn(at[rich].means, None, 1, True)[0][:, 0].median()
        distance = knn(at[rich].means, at[poor].means, 1, False)[0][:, 0]
        unseen = (distance > 3 * spacing) & (torch.sigmoid(at[poor].opacity_logits) > 0.1)
        if hidden is not None:
            unseen &= hidden[poor] >= config.hidden
        g = GaussianTensors.cat([at[rich], at[poor][unseen]])
        index = own
        new_labels = torch.cat([labels[rich], labels[poor][unseen]])
        new_margin = torch.cat([margin[rich], margin[poor][unseen]])
    return _with_pairs(g, betas, new_labels, new_margin, index, g0.means[i], g1.means[j])


def _match_parts(at, labels, solid, config) -> tuple[Tensor, Tensor]:
    """Hungarian pairs of the two states at canonical time, each part by itself, so that no pair joins two parts."""
    parts = int(max(int(labels[s].max()) for s in (0, 1))) + 1
    total = max(int(solid[0].sum()), 1)
    found0, found1 = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.int64)]
    for k in range(parts):
        rows = [(solid[s] & (labels[s] == k)).nonzero().squeeze(1) for s in (0, 1)]
        if min(len(rows[0]), len(rows[1])) < 5:
            continue
        share = max(config.match_size * len(rows[0]) // total, min(300, config.match_size))
        i, j = hungarian_pairs(at[0].means[rows[0]], at[1].means[rows[1]], share, config.match_smaller == "whole")
        i, j = rows[0][i], rows[1][j]
        gap = (at[0].means[i] - at[1].means[j]).norm(dim=1)
        close = gap <= 3 * gap.median().clamp_min(1e-4)  # a larger gap: seen in one state only
        found0.append(i[close])
        found1.append(j[close])
    return torch.cat(found0), torch.cat(found1)
