"""Means over seeds and Welch's t-test."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Optional, Sequence

PUBLISHED_RUNS = 3  # the paper's n
TINY = 1e-6  # least standard deviation of numbers we have in full (the paper's own epsilon)


@dataclass(frozen=True)
class Sample:
    """n numbers: mean and standard deviation (n - 1; None for n = 1)."""

    mean: float
    std: Optional[float]
    n: int


def sample(values: Sequence[float]) -> Optional[Sample]:
    """None of nothing.

    >>> sample([1.0, 3.0])
    Sample(mean=2.0, std=1.4142135623730951, n=2)
    """
    if not values:
        return None
    mean = math.fsum(values) / len(values)
    if len(values) == 1:
        return Sample(mean, None, 1)
    return Sample(mean, math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)), len(values))


def printed(mean: float, std: float, digits: int = 2, n: int = PUBLISHED_RUNS) -> Sample:
    """A number as a table prints it: a spread that reads 0.00 may be anything below half its last digit, and is taken
    as that."""
    return Sample(mean, max(std, 0.5 * 10**-digits), n)


@dataclass(frozen=True)
class Comparison:
    """t and two-sided p of Welch's test of a against b."""

    t: float
    p: float
    degrees: float

    def verdict(self, higher_is_better: bool, level: float = 0.05) -> str:
        """What a is: better, worse, or no difference."""
        if not self.p < level:
            return "no difference"
        return "better" if (self.t > 0) == higher_is_better else "worse"


def welch(a: Sample, b: Sample, floor: float = TINY) -> Optional[Comparison]:
    """Welch's t-test from means and standard deviations (unequal variances). None where either has no spread (n = 1).

    floor: least standard deviation of either side, so that equal digits do not become certainty.
    """
    if a.std is None or b.std is None:
        return None
    from scipy.stats import t as student

    va, vb = max(a.std, floor) ** 2 / a.n, max(b.std, floor) ** 2 / b.n
    t = (a.mean - b.mean) / math.sqrt(va + vb)
    degrees = (va + vb) ** 2 / (va**2 / (a.n - 1) + vb**2 / (b.n - 1))
    return Comparison(t, float(2 * student.sf(abs(t), degrees)), degrees)
