"""Rotations: quaternions (wxyz), matrices and rotation vectors, for any batch shape, in float32 or float64.

Every function keeps its gradients finite at angle 0 and at angle pi. Formulas: J. Sola et al., "A micro Lie theory for
state estimation in robotics" (arXiv:1812.01537); S. W. Shepperd, "Quaternion from rotation matrix"
(doi:10.2514/3.55767b); W. Kabsch (doi:10.1107/S0567739476001873).
"""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

# Below this squared angle the Taylor series are exact to float64 and, unlike the closed forms, lose no digits in the
# backward pass.
SERIES_BELOW = 0.25


def _series(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    out = torch.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        out = out * x + c
    return out


def _split(theta_sq: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(is small, theta^2 where small else 0, theta where large else 1): each branch sees only values it is good at."""
    small = theta_sq < SERIES_BELOW
    return (
        small,
        torch.where(small, theta_sq, torch.zeros_like(theta_sq)),
        torch.where(small, torch.ones_like(theta_sq), theta_sq).sqrt(),
    )


def sinc(theta_sq: Tensor) -> Tensor:
    """sin(theta) / theta as a smooth function of theta^2, [...] -> [...]."""
    small, low, theta = _split(theta_sq)
    near = _series(low, (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800, 1 / 6227020800))
    return torch.where(small, near, theta.sin() / theta)


def versinc(theta_sq: Tensor) -> Tensor:
    """(1 - cos(theta)) / theta^2 as a smooth function of theta^2, [...] -> [...]."""
    return 0.5 * sinc(theta_sq / 4).square()


def skew(v: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3] with skew(v) @ u = v x u."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _eye_like(M: Tensor) -> Tensor:
    return torch.eye(M.shape[-1], dtype=M.dtype, device=M.device)


def quat_normalize(q: Tensor) -> Tensor:
    """Unit quaternion, [..., 4] -> [..., 4]; the zero quaternion becomes the identity (with zero gradient)."""
    sq = q.square().sum(-1, keepdim=True)
    tiny = sq < torch.finfo(q.dtype).tiny * 1e4
    identity = torch.zeros_like(q)
    identity[..., 0] = 1
    return torch.where(tiny, identity, q * torch.where(tiny, torch.ones_like(sq), sq).rsqrt())


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product, [..., 4] x [..., 4] -> [..., 4]: rotates by ``b`` first, then by ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_to_matrix(q: Tensor) -> Tensor:
    """[..., 4] wxyz of any length -> rotation [..., 3, 3]."""
    w, x, y, z = quat_normalize(q).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        -1,
    ).unflatten(-1, (3, 3))


def matrix_to_quat(R: Tensor) -> Tensor:
    """Rotation [..., 3, 3] -> unit quaternion [..., 4] with w >= 0.

    R determines 4 q q^T linearly; the row of the largest component is q up to a factor >= 1, so nothing small is ever
    divided by.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R.flatten(-2).unbind(-1)
    wx, wy, wz, xy, xz, yz = r21 - r12, r02 - r20, r10 - r01, r01 + r10, r02 + r20, r12 + r21
    outer = torch.stack(
        [
            torch.stack([1 + r00 + r11 + r22, wx, wy, wz], -1),
            torch.stack([wx, 1 + r00 - r11 - r22, xy, xz], -1),
            torch.stack([wy, xy, 1 - r00 + r11 - r22, yz], -1),
            torch.stack([wz, xz, yz, 1 - r00 - r11 + r22], -1),
        ],
        -2,
    )
    best = outer.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = torch.take_along_dim(outer, best[..., None, None].expand(*best.shape, 1, 4), -2).squeeze(-2)
    row = torch.where(row[..., :1] < 0, -row, row)
    return row / row.norm(dim=-1, keepdim=True)


def rotvec_to_matrix(w: Tensor) -> Tensor:
    """Exponential map: rotation vector [..., 3] (radians about the axis) -> [..., 3, 3] (Rodrigues)."""
    theta_sq = w.square().sum(-1)[..., None, None]
    W = skew(w)
    return _eye_like(W) + sinc(theta_sq) * W + versinc(theta_sq) * (W @ W)


def matrix_to_rotvec(R: Tensor) -> Tensor:
    """Logarithm: [..., 3, 3] -> rotation vector [..., 3] of length in [0, pi]. At pi, one of the two signs."""
    q = matrix_to_quat(R)
    w, v = q[..., :1], q[..., 1:]
    s_sq = v.square().sum(-1, keepdim=True)
    small = s_sq < 0.01
    x = torch.where(small, s_sq, torch.zeros_like(s_sq)) / torch.where(small, w, torch.ones_like(w)).square()
    near = (
        2
        * _series(x, (1.0, -1 / 3, 1 / 5, -1 / 7, 1 / 9, -1 / 11, 1 / 13, -1 / 15))
        / torch.where(small, w, torch.ones_like(w))
    )
    s = torch.where(small, torch.ones_like(s_sq), s_sq).sqrt()
    return v * torch.where(small, near, 2 * torch.atan2(s, w) / s)


def rotation_angle(A: Tensor, B: Optional[Tensor] = None) -> Tensor:
    """Geodesic angle in radians, [0, pi], of A, or between A and B: [..., 3, 3] -> [...].

    By atan2 of sine and cosine, exact near 0 and pi where arccos is not; at exactly 0 and pi the gradient is taken as
    zero.
    """
    D = A if B is None else A.transpose(-1, -2) @ B
    v = torch.stack([D[..., 2, 1] - D[..., 1, 2], D[..., 0, 2] - D[..., 2, 0], D[..., 1, 0] - D[..., 0, 1]], -1)
    sq = v.square().sum(-1)
    zero = sq == 0
    sine = torch.where(zero, torch.zeros_like(sq), torch.where(zero, torch.ones_like(sq), sq).sqrt())
    return torch.atan2(sine, D.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


@torch.no_grad()
def nearest_rotation(H: Tensor) -> Tensor:
    """The rotation R that makes trace(R H) greatest, never a reflection, [..., 3, 3]; H: sum of source times target
    transposed."""
    U, _, Vh = torch.linalg.svd(H)
    V, Ut = Vh.transpose(-1, -2), U.transpose(-1, -2)
    flip = torch.ones_like(H[..., 0])
    flip[..., 2] = torch.where(torch.linalg.det(V @ Ut) < 0, -1.0, 1.0)
    return (V * flip[..., None, :]) @ Ut


@torch.no_grad()
def kabsch(src: Tensor, dst: Tensor, weights: Optional[Tensor] = None) -> tuple[Tensor, Tensor]:
    """The rigid motion minimising sum_n w_n |R src_n + t - dst_n|^2, never a reflection.

    src, dst: [..., N, 3].  weights: [..., N], >= 0, or None; batch shapes broadcast (weights [K, N] with src [N, 3]
    fits K parts). Returns R [..., 3, 3], t [..., 3]; no mass gives the identity. Points on a line leave the turn about
    it free. Carries no gradient: what is minimal at (R, t) has no first-order dependence on them, so losses need none.
    """
    if weights is None:
        weights = torch.ones_like(src[..., 0])
    total = weights.sum(-1, keepdim=True)
    w = (weights / torch.where(total > 0, total, torch.ones_like(total)))[..., None, :]
    # points last: torch is several times slower with the three coordinates there
    src, dst = src.transpose(-1, -2).contiguous(), dst.transpose(-1, -2).contiguous()
    src_mean, dst_mean = (w * src).sum(-1), (w * dst).sum(-1)
    H = (w * (src - src_mean[..., None])) @ (dst - dst_mean[..., None]).transpose(-1, -2)
    R = nearest_rotation(H)
    t = dst_mean - (R @ src_mean[..., None])[..., 0]
    empty = total <= 0
    return torch.where(empty[..., None], _eye_like(R), R), torch.where(empty, torch.zeros_like(t), t)
