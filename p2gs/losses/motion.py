"""Losses on the parts' rigid motions against observed centres: ``art`` and ``vector``."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from p2gs.losses.base import Loss, LossInputs, PartState, register_loss
from p2gs.losses.parts import sample_rows
from p2gs.ops import so3
from p2gs.ops.repel import repel_force
from p2gs.ops.robust import geman_mcclure


class Pairs(NamedTuple):
    """Observed pairs of one step: index [M] into the Gaussians, probs [M, K], mu0 and mu1 [M, 3] (state 0 and 1)."""

    index: Tensor
    probs: Tensor
    mu0: Tensor
    mu1: Tensor


def select_pairs(inputs: LossInputs, sample: int) -> Pairs | None:
    """The observed pairs, at most ``sample`` of them (0: all); None where the phase has none."""
    parts = inputs.parts
    if parts is None or parts.pairs is None or parts.mu0 is None or parts.mu1 is None or len(parts.pairs) == 0:
        return None
    key = ("pairs", sample, inputs.step)
    known = parts.shared.get(key)
    if known is None:
        rows = sample_rows(len(parts.pairs), sample, inputs.step, parts.pairs.device)
        index, mu0, mu1 = parts.pairs, parts.mu0, parts.mu1
        if not isinstance(rows, slice):
            index, mu0, mu1 = (t.index_select(0, rows) for t in (index, mu0, mu1))
        known = parts.shared[key] = Pairs(index, parts.probs.T.index_select(1, index).T, mu0, mu1)
    return known


def unexplained(inputs: LossInputs, sample: int) -> Tensor:
    """What every part's motion leaves of the pairs of ``select_pairs``: R_k mu0 + t_k - mu1, [K, 3, M]."""
    parts, pairs, key = inputs.parts, select_pairs(inputs, sample), ("unexplained", sample, inputs.step)
    assert parts is not None and pairs is not None  # who asks has seen that there are some
    if key not in parts.shared:
        parts.shared[key] = carried(parts.transforms, pairs.mu0) - pairs.mu1.T
    return parts.shared[key]


def carried(transforms: Tensor, points: Tensor) -> Tensor:
    """Every point under every motion, [K, 3, M]: the points last, which torch sums and multiplies several times faster
    than [K, M, 3]."""
    count = len(transforms)
    return torch.baddbmm(transforms[:, :3, 3:], transforms[:, :3, :3], points.T.expand(count, -1, -1))


def squared(residual: Tensor, robust: float | None, extent: float, dim: int = -1) -> Tensor:
    """|r|^2 of [...] over dimension ``dim``, which goes; with ``robust``, a fraction of the extent, by
    ``ops.robust.geman_mcclure``."""
    sq = residual.square().sum(dim)
    return sq if robust is None else geman_mcclure(sq, (robust * extent) ** 2)


def reduce_pairs(cost: Tensor, reduce: str, total: int) -> Tensor:
    """Mean of the sampled costs [M], or the estimate of the sum over all ``total`` pairs."""
    return cost.mean() if reduce == "mean" else cost.mean() * total


@register_loss("vector")
class Vector(Loss):
    """L_vector = sum_k sum_i p_ik |R_k mu0_i + t_k - mu1_i|^2 (paper section 4.4), i over observed pairs, slot 0 (the
    identity) too.

    Membership is soft, so it teaches the screws and the labels.  reduce: mean over the pairs, or the paper's sum, whose
    size grows with the number of Gaussians.  sample: pairs looked at per step (0: all).  robust: see ``squared``; None
    is the paper.
    """

    needs = frozenset({"pairs"})
    kind = "motion"
    weight: float = 0.5
    reduce: Literal["mean", "sum"] = "mean"
    sample: int = 4096
    robust: float | None = None

    def compute(self, inputs: LossInputs) -> Tensor | None:
        parts, pairs = inputs.parts, select_pairs(inputs, self.sample)
        if parts is None or parts.pairs is None or pairs is None:
            return None
        cost = squared(unexplained(inputs, self.sample), self.robust, parts.extent, dim=1)
        per_pair = (pairs.probs.T * cost).sum(0)
        return reduce_pairs(per_pair, self.reduce, len(parts.pairs))


@register_loss("art")
class Art(Loss):
    """L_art = sum_k sum_i |R_k mu_i + t_k + F_i - mu_hat_i|^2 + lambda_rot Angle(R_k, R_hat_k) (paper section 4.3).

    mu_i and mu_hat_i are the observed centres in states 0 and 1, R_hat the Kabsch rotation of the part's pairs
    (radians, averaged over the movable parts; summed with reduce "sum"). F is the repel force at the moved centre (eq.
    repel, repel_clamped), differentiable, for movable parts, and only inside this residual: the optimum mu_hat - F lies
    away from the repel points.

    variant: "local" takes the expectation of the squared residual over the soft membership, and for F the sum over the
    repel points within ``radius`` of strength tau_max (radius / d)^(exponent - 1) towards each, clipped at ``tau_max``
    (radius and tau_max: fractions of the extent) and annealed to nothing at ``anneal`` (fraction of the phase): a force
    that stays leaves the joint off by tau_max. Distances in radii keep it below the clip for any exponent, so that
    exponent and count of the points act. "paper" blends positions by membership (appendix, "Part Assignment Details")
    and sums F over all repel points, clipped, to the end; with k_r = 5e-4 and 2,000 points it is at its clip
    everywhere.
    strength: share of tau_max that one point at the radius exerts; 0.005 keeps the median force at 0.1 to 0.5 tau_max.
    source: "observed", or "canonical" to move the Gaussians' canonical centres to state 1 instead of mu0 (they get
    gradients).
    sign: "paper", or "away" to turn F around (then the optimum is nearer to the repel points).  k_r = 0 switches F off.
    min_prob: memberships below it feel no force (saves most of the work).  reduce, sample, robust: as in ``vector``.
    """

    needs = frozenset({"pairs", "rotations"})
    kind = "motion"
    weight: float = 1.0
    variant: Literal["local", "paper"] = "local"
    reduce: Literal["mean", "sum"] = "mean"
    source: Literal["observed", "canonical"] = "observed"
    lambda_rot: float = 0.1
    k_r: float = 5e-4
    strength: float = 0.005
    exponent: float = 3.0
    eps: float = 1e-5
    radius: float = 0.05
    tau_max: float = 0.01
    anneal: float = 0.75
    sign: Literal["paper", "away"] = "paper"
    min_prob: float = 1e-2
    sample: int = 2048
    robust: float | None = None

    def compute(self, inputs: LossInputs) -> Tensor | None:
        parts, pairs = inputs.parts, select_pairs(inputs, self.sample)
        if parts is None or parts.pairs is None or pairs is None:
            return None
        if self.source == "observed":
            moved = carried(parts.transforms, pairs.mu0)
        else:
            moved = carried(parts.at(1.0), parts.means_canonical.index_select(0, pairs.index))
        tau = self.tau(parts.extent, inputs.step, inputs.total_steps)
        if self.variant == "paper":
            blended = (pairs.probs.T[:, None] * moved).sum(0).T
            movable = 1 - pairs.probs[:, :1]
            force = self.force(blended, parts.repel_points, parts.extent, tau)
            per_pair = squared(blended + movable * force - pairs.mu1, self.robust, parts.extent)
        else:
            cost = squared(self.push(moved, pairs.probs, parts, tau) - pairs.mu1.T, self.robust, parts.extent, dim=1)
            per_pair = (pairs.probs.T * cost).sum(0)
        total = reduce_pairs(per_pair, self.reduce, len(parts.pairs))
        if self.lambda_rot and parts.target_rotation is not None and len(parts.transforms) > 1:
            angle = so3.rotation_angle(parts.transforms[1:, :3, :3], parts.target_rotation[1:])
            total = total + self.lambda_rot * (angle.mean() if self.reduce == "mean" else angle.sum())
        return total

    def tau(self, extent: float, step: int, total_steps: int) -> float:
        """The force's largest length now, in scene units."""
        tau = self.tau_max * extent
        if self.variant == "paper" or self.anneal <= 0:
            return tau
        return tau * max(0.0, 1 - step / max(total_steps, 1) / self.anneal)

    def force(self, points: Tensor, repel_points: Tensor | None, extent: float, tau: float) -> Tensor:
        """F [N, 3] at points [N, 3] from repel_points [R, 3], at most ``tau`` long, all in scene units."""
        if repel_points is None or len(repel_points) == 0 or self.k_r == 0 or tau <= 0:
            return torch.zeros_like(points)
        law: dict[str, Any] = {"exponent": self.exponent, "eps": self.eps, "tau_max": tau}
        if self.variant == "paper":
            force = repel_force(points, repel_points, k_r=self.k_r, reduce="sum", **law)
        else:
            radius = self.radius * extent
            unit = self.strength * self.tau_max * extent * radius ** (self.exponent - 1)
            force = repel_force(points, repel_points, k_r=unit, reduce="within", radius=radius, **law)
        return force if self.sign == "paper" else -force

    def push(self, moved: Tensor, probs: Tensor, parts: PartState, tau: float) -> Tensor:
        """moved [K, 3, M] plus the force on every candidate that has the membership for it."""
        if parts.repel_points is None or self.k_r == 0 or tau <= 0:
            return moved
        feels = probs.detach().T > self.min_prob
        feels[0] = False
        (chosen,) = feels.flatten().nonzero(as_tuple=True)
        flat = moved.transpose(0, 1).flatten(1)
        force = self.force(flat.index_select(1, chosen).T, parts.repel_points, parts.extent, tau)
        return flat.scatter_add(1, chosen.expand(3, -1), force.T).unflatten(1, feels.shape).transpose(0, 1)
