"""Linear least squares."""

from __future__ import annotations

import torch
from torch import Tensor


def least_squares(A: Tensor, b: Tensor) -> Tensor:
    """x [N], the shortest of those for which |A x - b| is least; A [M, N] of any rank, b [M], on the CPU.

    By LAPACK's gelsd. torch's default, gelsy, starts from pivots that nobody set (torch 2.13 passes ``jpvt`` as it was
    allocated): one input gave three results that differ in their last bits.
    """
    return torch.linalg.lstsq(A, b[:, None], driver="gelsd").solution[:, 0]
