"""Measures that a few wrong values do not move."""

from __future__ import annotations

import torch
from torch import Tensor

CAUCHY_95 = 2.385  # deviations: Rey 1983, DOI 10.1007/978-3-642-69389-2
MEDIAN_SIGMA = 1.4826  # a normal deviate's sigma over its median size


def geman_mcclure(square: Tensor, scale: float) -> Tensor:
    """Squares, any shape, of which none counts more than ``scale``, a square itself: s x / (s + x) (Geman and McClure
    1985). What rounding made negative stays as it is."""
    return scale * square / (scale + square.clamp_min(0))


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """The value, a scalar, below which half of the weight lies; any shape, weights of one shape with the values. 0 of
    none."""
    if values.numel() == 0:
        return values.new_zeros(())
    order = values.flatten().argsort()
    total = weights.flatten()[order].cumsum(0)
    return values.flatten()[order[torch.searchsorted(total, total[-1] / 2).clamp_max(len(order) - 1)]]
