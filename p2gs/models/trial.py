"""Does a correction of the photographs make held-out ones better beyond noise? The one test by which corrections are
switched on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

FIELDS = 8  # a side: each half of a photograph shows something of every part
CERTAIN = 3.0  # standard errors: one in a thousand by chance


@dataclass(frozen=True)
class Trial:
    """without, with_it: mean errors of the held-out pictures.  better: share by which their mean fell.  certain: the
    same in standard errors over the pictures.  pictures: how many."""

    without: float
    with_it: float
    better: float
    certain: float
    pictures: int

    def passed(self, least: float) -> bool:
        """Whether errors fell by ``least`` of themselves, and beyond noise."""
        return self.better >= least and self.certain >= CERTAIN

    def told(self) -> str:
        fell = f"{100 * self.better:.1f} % less, {self.certain:.1f} standard errors"
        return f"held-out error {self.without:.5f} -> {self.with_it:.5f} ({fell})"


def trial(without: Tensor, with_it: Tensor) -> Trial:
    """Errors [N] of N held-out pictures without and with a correction."""
    share = ((without - with_it) / without.mean().clamp_min(1e-12)).double()
    n = len(share)
    deviation = float(share.std()) if n > 1 else float("inf")
    certain = float(share.mean()) / max(deviation / n**0.5, 1e-12) if n > 1 else 0.0
    return Trial(float(without.mean()), float(with_it.mean()), float(share.mean()), certain, n)


def held_out(count: int, every: int = 4) -> tuple[list[int], list[int]]:
    """Indices of photographs to fit to and of those held out, every fourth. Fewer than two of either: all are both."""
    out = list(range(every // 2, count, every))
    kept = [i for i in range(count) if i not in set(out)]
    return (kept, out) if len(out) > 1 and len(kept) > 1 else (list(range(count)), list(range(count)))


def halves(height: int, width: int) -> list[Tensor]:
    """The two colours of a chessboard of ``FIELDS`` fields a side, [H, W] of 0 and 1 each."""
    y, x = torch.arange(height) * FIELDS // height, torch.arange(width) * FIELDS // width
    black = ((y[:, None] + x[None]) % 2).float()
    return [black, 1 - black]
