"""Losses on the part assignment: ``part`` and ``entropy``."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from p2gs.losses.base import Loss, LossInputs, register_loss

TINY = 1e-12


def sample_rows(total: int, sample: int, step: int, device=None) -> Tensor | slice:
    """Distinct row numbers [sample] out of ``total``, a function of the step alone; all rows where sample is 0 or not
    smaller."""
    if sample <= 0 or sample >= total:
        return slice(None)
    return _permutation(total, step)[:sample].to(device)


@lru_cache(maxsize=4)
def _permutation(total: int, step: int) -> Tensor:
    """Losses of one step share it; nobody writes into it."""
    return torch.randperm(total, generator=torch.Generator().manual_seed(step))


@register_loss("part")
class Part(Loss):
    """Neighbouring Gaussians belong to one part: KL(F_i || mean of F_j over the neighbours), paper section 4.2
    (L_part).

    F = softmax(f(psi)) is ``PartState.probs``, the neighbours are ``PartState.knn`` (k nearest centres, self excluded).
    Gradients flow into F_i and into the F_j. variant: "mean_neighbour" is the paper's; "pairwise" is mean over j of
    KL(F_i || F_j).
    sample: M, Gaussians looked at per step (0: all).  reduce: the paper's mean over M, or the sum.
    """

    needs = frozenset({"parts"})
    kind = "parts"
    weight: float = 0.1
    variant: Literal["mean_neighbour", "pairwise"] = "mean_neighbour"
    sample: int = 4096
    reduce: Literal["mean", "sum"] = "mean"

    def compute(self, inputs: LossInputs) -> Tensor | None:
        parts = inputs.parts
        if parts is None or parts.knn is None or parts.knn.shape[1] == 0:
            return None
        rows = sample_rows(len(parts.probs), self.sample, inputs.step, parts.probs.device)
        # [K, neighbours, M]: torch is several times slower with the few parts or neighbours last
        probs, neighbours = parts.probs.T, parts.knn[rows].T
        own = probs[:, None] if isinstance(rows, slice) else probs.index_select(1, rows)[:, None]
        others = probs.index_select(1, neighbours.reshape(-1)).unflatten(1, neighbours.shape)
        if self.variant == "mean_neighbour":
            others = others.mean(1, keepdim=True)
        log_ratio = own.clamp_min(TINY).log() - others.clamp_min(TINY).log()
        divergence = (own * log_ratio).sum(0).mean(0)
        return divergence.mean() * (1 if self.reduce == "mean" else len(parts.probs))


@register_loss("entropy")
class Entropy(Loss):
    """Mean entropy of the part assignment in nats: makes labels sharp. Not in the paper, which leaves one-part-for-all
    a minimum."""

    needs = frozenset({"parts"})
    kind = "parts"
    weight: float = 0.01

    def compute(self, inputs: LossInputs) -> Tensor | None:
        if inputs.parts is None:
            return None
        p = inputs.parts.probs
        return -(p * p.clamp_min(TINY).log()).sum(-1).mean()
