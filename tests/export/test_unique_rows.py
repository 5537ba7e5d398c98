"""``unique_rows`` against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from p2gs.ops.unique_rows import unique_rows


@pytest.mark.parametrize(
    "n, k, low, high", [(0, 3, 0, 5), (1, 3, 0, 5), (500, 3, -4, 4), (500, 4, 0, 2), (300, 3, -(2**40), 2**40)]
)
def test_as_numpy_has_them(n, k, low, high):
    rows = np.random.default_rng(0).integers(low, high, (n, k))
    rows = np.concatenate([rows, rows[: n // 3]])
    first, inverse = unique_rows(rows)
    if n == 0:
        assert len(first) == len(inverse) == 0
        return
    values, index, back = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    assert (
        np.array_equal(rows[first], values)
        and np.array_equal(first, index)
        and np.array_equal(inverse, back.reshape(-1))
    )
