"""Learning rates that fall."""

from __future__ import annotations

import math


def exponential(start: float, end: float, fraction: float) -> float:
    """start at 0, end at 1, geometric between (both > 0)."""
    return math.exp(math.log(start) + (math.log(end) - math.log(start)) * min(max(fraction, 0.0), 1.0))
