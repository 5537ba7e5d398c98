"""Real spherical harmonics up to degree 3, in the order and with the signs that 3DGS files use.

Band l holds m = -l .. l, with the Condon-Shortley phase (so band 1 is -y, z, -x). Colour is 0.5 + sum_b Y_b(d) c_b, not
clamped here. Formulas: any table of real spherical harmonics; rotation by collocation, exact because each band is
closed under rotation.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

MAX_DEGREE = 3
C0 = math.sqrt(1 / (4 * math.pi))


def num_bases(degree: int) -> int:
    """(degree + 1)^2. Raises ValueError outside 0..3."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree} are not supported (0 to {MAX_DEGREE} are)")
    return (degree + 1) ** 2


def degree_of(bases: int) -> int:
    """The degree that has so many bases. Raises ValueError for a number that is not 1, 4, 9 or 16."""
    degree = math.isqrt(bases) - 1
    if bases < 1 or (degree + 1) ** 2 != bases or degree > MAX_DEGREE:
        raise ValueError(f"{bases} spherical-harmonics coefficients do not make a whole degree (1, 4, 9 or 16 do)")
    return degree


def rgb_to_dc(rgb: Tensor) -> Tensor:
    """Colour [..., 3] in 0..1 -> coefficient of the constant band."""
    return (rgb - 0.5) / C0


def dc_to_rgb(dc: Tensor) -> Tensor:
    """Inverse of ``rgb_to_dc``, [..., 3] to [..., 3] (not clamped)."""
    return dc * C0 + 0.5


def basis(degree: int, directions: Tensor) -> Tensor:
    """All bases at unit directions: [..., 3] -> [..., (degree + 1)^2]."""
    num_bases(degree)
    x, y, z = directions.unbind(-1)
    out = [torch.full_like(x, C0)]
    if degree >= 1:
        c = math.sqrt(3 / (4 * math.pi))
        out += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * math.pi))
        xx, yy, zz = x * x, y * y, z * z
        out += [
            c * x * y,
            -c * y * z,
            math.sqrt(5 / (16 * math.pi)) * (2 * zz - xx - yy),
            -c * x * z,
            0.5 * c * (xx - yy),
        ]
    if degree >= 3:
        c0, c1 = math.sqrt(7 / (16 * math.pi)), math.sqrt(21 / (32 * math.pi))
        c2, c3 = math.sqrt(105 / (4 * math.pi)), math.sqrt(35 / (32 * math.pi))
        ring = 4 * zz - xx - yy
        out += [
            -c3 * y * (3 * xx - yy),
            c2 * x * y * z,
            -c1 * y * ring,
            c0 * z * (2 * zz - 3 * xx - 3 * yy),
            -c1 * x * ring,
            0.5 * c2 * z * (xx - yy),  # pyright: ignore[reportOperatorIssue]
            -c3 * x * (xx - 3 * yy),
        ]
    return torch.stack(out, -1)


def evaluate(sh: Tensor, directions: Tensor, degree: int | None = None) -> Tensor:
    """Colour seen along unit directions (camera -> Gaussian): sh [..., B, 3], directions [..., 3] -> [..., 3], 0.5 +
    SH.

    degree: use only the bands up to it (default: all that ``sh`` has).
    """
    degree = degree_of(sh.shape[-2]) if degree is None else degree
    Y = basis(degree, directions)
    return 0.5 + (Y[..., None] * sh[..., : Y.shape[-1], :]).sum(-2)


@lru_cache(maxsize=None)
def band_tables(band: int) -> tuple[Tensor, Tensor]:
    """Directions [4 band + 8, 3] and the pseudo-inverse of this band's bases there [2 band + 1, 4 band + 8], float64.

    The directions are a Fibonacci spiral: well spread, so the inverse is well conditioned.
    """
    n = 4 * band + 8
    i = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * i + 1) / n
    turn = i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * turn.cos(), r * turn.sin(), z], -1)
    return directions, torch.linalg.pinv(basis(band, directions)[:, band * band :])


def rotation_matrices(R: Tensor, degree: int) -> list[Tensor]:
    """The bands' representation of R [..., 3, 3]: for l = 0 .. degree a [..., 2l+1, 2l+1] that maps coefficients to
    rotated ones."""
    num_bases(degree)
    out = [torch.ones_like(R[..., :1, :1])]
    for band in range(1, degree + 1):
        directions, inverse = (a.to(R) for a in band_tables(band))
        # the turned function at d is the old one at R^T d, and rows d @ R are R^T d
        turned = basis(band, directions @ R)[..., band * band :]
        out.append(inverse @ turned)
    return out


def rotate_sh(sh: Tensor, R: Tensor, index: Tensor | None = None) -> Tensor:
    """Coefficients of the colour function turned by R, so that evaluate(rotate_sh(sh, R), R d) = evaluate(sh, d).

    sh [..., B, 3]; R [..., 3, 3] of the same batch shape (or one that broadcasts); with ``index`` [N] int64, R is [K,
    3, 3] and Gaussian n of sh [N, B, 3] is turned by R[index[n]] (the matrices are then made once a part).
    """
    degree = degree_of(sh.shape[-2])
    bands = []
    for band, M in enumerate(rotation_matrices(R, degree)):
        M = M if index is None else M[index]
        bands.append(M @ sh[..., band * band : (band + 1) ** 2, :])
    shape = np.broadcast_shapes(*(b.shape[:-2] for b in bands))  # torch's own imports sympy, which takes a second
    return torch.cat([b.expand(*shape, *b.shape[-2:]) for b in bands], -2)
