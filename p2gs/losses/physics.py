"""Physics-informed regularisers (paper section 4.4): ``contact`` and ``velocity``; the third, ``vector``, is in
``motion``."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from p2gs.losses.base import Loss, LossInputs, register_loss
from p2gs.losses.motion import select_pairs, unexplained
from p2gs.losses.parts import sample_rows
from p2gs.ops.blend import likeliest
from p2gs.ops.knn import knn


@register_loss("velocity")
class Velocity(Loss):
    """A part's points move alike: sum_k Var over i in part k of a displacement (paper section 4.4, L_velocity).

    variant: "rigid" takes the displacement that the part's rigid motion leaves unexplained, R_k mu0 + t_k - mu1: zero
    for every true rigid motion. "paper" takes mu1 - mu0 itself, which is zero for translations only: it charges for
    turning, teaches the labels alone (the screws do not occur in it) and would rather split a door. Var is the
    membership-weighted mean of squared distances from the weighted mean, over the observed pairs; a slot of less than
    one Gaussian's mass counts less.
    reduce: mean over the slots, or the paper's sum.  sample: pairs looked at per step (0: all).
    """

    needs = frozenset({"pairs"})
    kind = "physics"
    weight: float = 0.5
    variant: Literal["rigid", "paper"] = "rigid"
    reduce: Literal["mean", "sum"] = "mean"
    sample: int = 4096

    def compute(self, inputs: LossInputs) -> Tensor | None:
        pairs = select_pairs(inputs, self.sample)
        if pairs is None:
            return None
        weights = pairs.probs.T
        weights = weights / weights.sum(1, keepdim=True).clamp_min(1.0)
        if self.variant == "rigid":
            displacement = unexplained(inputs, self.sample)
        else:
            displacement = (pairs.mu1 - pairs.mu0).T.expand(len(weights), -1, -1)
        mean = (weights[:, None] * displacement).sum(2, keepdim=True) / weights.sum(1)[:, None, None].clamp_min(1e-12)
        variance = (weights * (displacement - mean).square().sum(1)).sum(1)
        return variance.mean() if self.reduce == "mean" else variance.sum()


@register_loss("contact")
class Contact(Loss):
    """Movable Gaussians stay on the outer side of the base: mean over part k of max(0, -cos phi_i) (paper section 4.4,
    L_contact).

    phi_i is the angle between d_i, from the nearest static centre to mu_i, and d_k, from the static centroid to mu_i.
    Gaussians belong to their likeliest part; mu_i is posed at one of ``times`` (state times 0..1), in turn from step to
    step.
    variant: "margin" (default) weights each term by (1 - |d_i| / margin)_+, margin in units of the Gaussians' spacing:
    only what touches is pushed. "paper" weights all alike, which punishes containment: a drawer in its cabinet has
    obtuse angles nearly everywhere, so the loss asks it to leave.
    reduce: mean over the movable parts present, or the sum.  sample: movable Gaussians looked at per step (0: all).
    """

    needs = frozenset({"parts"})
    kind = "physics"
    weight: float = 0.5
    variant: Literal["margin", "paper"] = "margin"
    reduce: Literal["mean", "sum"] = "mean"
    margin: float = 2.0
    times: tuple[float, ...] = (0.0, 1.0)
    sample: int = 1024

    def compute(self, inputs: LossInputs) -> Tensor | None:
        parts = inputs.parts
        if parts is None or len(parts.transforms) < 2:
            return None
        labels = likeliest(parts.probs)
        static, movable = (labels == 0).nonzero()[:, 0], (labels > 0).nonzero()[:, 0]
        if len(static) == 0 or len(movable) == 0:
            return None
        movable = movable[sample_rows(len(movable), self.sample, inputs.step, movable.device)]
        means, label = parts.means_canonical, labels[movable]
        # index_select throughout: it and its gradient are several times faster than indexing
        poses = parts.at(self.times[inputs.step % len(self.times)])[:, :3].flatten(1)
        pose = poses.index_select(0, label).unflatten(1, (3, 4))
        points = (pose[:, :, :3] * means.index_select(0, movable)[:, None, :]).sum(-1) + pose[:, :, 3]
        _, nearest = knn(means.detach().index_select(0, static), points.detach(), 1, False)
        centre = means.index_select(0, static).mean(0)
        from_base, from_centre = points - means.index_select(0, static[nearest[:, 0]]), points - centre
        cosine = torch.cosine_similarity(from_base, from_centre, dim=-1, eps=1e-12)
        penalty = (-cosine).clamp_min(0)
        if self.variant == "margin":
            distance = from_base.square().sum(-1).clamp_min(1e-24).sqrt()
            penalty = penalty * (1 - distance / (self.margin * parts.spacing)).clamp_min(0)
        count = torch.bincount(label, minlength=len(parts.transforms)).to(penalty.dtype)
        sums = torch.zeros_like(count).index_add(0, label, penalty)
        total = (sums / count.clamp_min(1)).sum()
        return total / (count > 0).sum() if self.reduce == "mean" else total
