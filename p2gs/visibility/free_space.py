"""Gaussians that hang in space which the other state's cameras see through: give them the part that explains them, or
drop them.

What one state hides (the inside of a shut cupboard) is filled with whatever its images do not forbid. Labelled with the
door and carried along, it would float in front of the open cupboard.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.gaussians.pose import with_static
from p2gs.ops import se3
from p2gs.visibility.depth_stack import DepthStack, classify

SURFACE = 0.015  # tolerance of rendered depth (internal units): nearer than this to a surface is on it
SEEN = 0.05  # share of the views that may see what counts as hidden


@torch.no_grad()
def explain_by_free_space(
    means: Tensor, labels: Tensor, transforms: Tensor, times: Tensor, stacks: list[DepthStack], tau: float
) -> tuple[Tensor, Tensor]:
    """Labels that no state's depth contradicts, and which Gaussians to keep.

    means [N, 3] at canonical time; labels [N]; transforms [K, 4, 4] start -> end, slot 0 included; times [K] canonical
    times; stacks: rendered depth of the start and end reconstruction.  tau: tolerance along the ray (scene units).

    A Gaussian is contradicted under a label when, carried to a state by that label's motion, most views see through it.
    One that its own label contradicts takes the uncontradicted label under which most views see it on a surface; where
    there is none it is dropped. Returns (labels [N], keep [N] bool).
    """
    parts = len(transforms)
    contradicted = torch.zeros(parts, len(means), dtype=torch.bool)
    support = torch.zeros(parts, len(means))
    for k in range(parts):
        for state, stack in enumerate(stacks):
            T = se3.screw_at(transforms[k], state - float(times[k])).to(means)
            free, on, _ = stack.counts(se3.apply(T, means), tau)
            contradicted[k] |= classify(free, on, need=4, ratio=2.0)[0]
            support[k] += on
    rows = torch.arange(len(means))
    wrong = contradicted[labels, rows]
    best = torch.where(contradicted, torch.full_like(support, -1.0), support).max(0)
    relabel = wrong & (best.values > 0)
    return torch.where(relabel, best.indices, labels), ~wrong | relabel


def landed(means: Tensor, labels: Tensor, transforms: Tensor) -> Tensor:
    """Where Gaussians come to lie in the other state, [N, 3]. means [N, 3]; labels [N]; transforms [K-1, 4, 4] to
    it."""
    T = with_static(transforms).to(means)[labels]
    return (T[:, :3, :3] * means[:, None]).sum(-1) + T[:, :3, 3]


@torch.no_grad()
def hidden_share(means: Tensor, labels: Tensor, transforms: Tensor, stack: DepthStack, tau: float) -> Tensor:
    """Share of the other state's views in which something is in front of each Gaussian of one state, carried there, [N]
    float.

    means [N, 3]; labels [N]; transforms [K-1, 4, 4] to the other state; stack: rendered depth of the other state; tau:
    tolerance along the ray (scene units). Views that do not contain a Gaussian say nothing; 0 where none does.
    """
    free, on, behind = stack.counts(landed(means, labels, transforms), tau)
    return behind / (free + on + behind).clamp_min(1)


@torch.no_grad()
def out_of_sight(points: Tensor, stack: DepthStack) -> Tensor:
    """Which points [N, 3] are behind something in some view of a state, and in ``SEEN`` of them at most before it or on
    it, [N] bool."""
    free, on, behind = stack.counts(points, SURFACE)
    return (behind > 0) & (free + on <= SEEN * (free + on + behind))
