"""Which photographs a fit has nothing left to learn from for now: their steps are drawn but not differentiated.

After SkipGS (arXiv 2603.08997): once densification is over, a view whose loss does not exceed its own running mean is
at its plateau; a least share of steps is differentiated all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from p2gs.types import UserError

MEMORY = 0.7  # of a view's running mean: some three visits, of which a state's second half has twenty


@dataclass
class SkipConfig:
    """start: fraction of the phase from which steps may be left out (densification needs every gradient).  least: share
    of the steps from there on that are differentiated whatever they show (1 = all)."""

    start: float = 0.6
    least: float = 1.0

    def __post_init__(self):
        if not 0 < self.least <= 1 or not 0 <= self.start <= 1:
            raise UserError(f"skip: expected 0 < least <= 1 and start in 0..1, got {self.least:g} and {self.start:g}")


class Plateau(nn.Module):
    """Running means of the losses of ``views`` photographs; buffers, so that a resumed fit leaves out the same
    steps."""

    def __init__(self, config: SkipConfig, views: int):
        super().__init__()
        self.config = config
        self.means: torch.Tensor
        self.counts: torch.Tensor
        self.register_buffer("means", torch.full((views,), float("inf"), dtype=torch.float64))
        self.register_buffer("counts", torch.zeros(2, dtype=torch.int64))  # steps looked at, of them left out

    def skips(self, fraction: float, view: int, loss: float) -> bool:
        """Whether this step, at ``fraction`` of the phase, may go without its backward pass."""
        if self.config.least >= 1 or fraction < self.config.start:
            return False
        before = float(self.means[view])
        first = before == float("inf")  # no visit yet
        self.means[view] = loss if first else MEMORY * before + (1 - MEMORY) * loss
        looked, skipped = self.counts.tolist()
        skip = not first and loss <= before and skipped < (1 - self.config.least) * (looked + 1)
        self.counts += torch.tensor([1, int(skip)], device=self.counts.device)
        return skip
