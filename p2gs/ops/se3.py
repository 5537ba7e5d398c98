"""Rigid motions as 4x4 matrices and as twists xi = (omega, v), and the screw (axis, origin, angle, slide) that each one
is.

A twist is ordered rotation first: ``xi[..., :3]`` is the rotation vector in radians, ``xi[..., 3:]`` the linear part,
in the units of the scene. Any batch shape, float32 or float64, gradients finite at zero and at pi.
Formulas: arXiv:1812.01537 (exp, log); K. M. Lynch and F. C. Park, "Modern Robotics", 2017, section 3.3 (screws).
"""

from __future__ import annotations

from typing import NamedTuple, Optional

import numpy as np
import torch
from torch import Tensor

from p2gs.ops import so3


class Screw(NamedTuple):
    """Chasles: turn by ``angle`` about the line (origin, axis) and slide by ``translation`` along it.

    axis [..., 3] unit; origin [..., 3] the line's point nearest the world origin; angle [...] radians in [0, pi];
    translation [...] in scene units, signed along the axis. Without rotation: axis along the translation, origin 0,
    angle 0.
    """

    axis: Tensor
    origin: Tensor
    angle: Tensor
    translation: Tensor


def make(R: Tensor, t: Tensor) -> Tensor:
    """R [..., 3, 3], t [..., 3] -> [..., 4, 4]; batch shapes broadcast."""
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])  # torch's own imports sympy, which takes a second
    top = torch.cat([R.expand(*batch, 3, 3), t.expand(*batch, 3)[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*batch, 1, 4)
    return torch.cat([top, bottom], -2)


def inverse(T: Tensor) -> Tensor:
    """[..., 4, 4] -> [..., 4, 4], by transposing the rotation."""
    Rt = T[..., :3, :3].transpose(-1, -2)
    return make(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def apply(T: Tensor, points: Tensor) -> Tensor:
    """R p + t. T [..., 4, 4], points [..., N, 3] -> [..., N, 3] (batch shapes broadcast: T [K, 4, 4] on [N, 3] gives
    [K, N, 3])."""
    return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]


def mean_gap(a: Tensor, b: Tensor, points: Tensor) -> Tensor:
    """Mean distance [...] between where motions a and b [..., 4, 4] take the same points [..., N, 3]; batch shapes
    broadcast. nan without points."""
    return (apply(a, points) - apply(b, points)).norm(dim=-1).mean(-1)


def _third(theta_sq: Tensor) -> Tensor:
    """(theta - sin(theta)) / theta^3 of theta^2."""
    small, low, theta = so3._split(theta_sq)
    near = so3._series(low, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800))
    return torch.where(small, near, (theta - theta.sin()) / theta**3)


def _inverse_second(theta_sq: Tensor) -> Tensor:
    """(1 - theta sin(theta) / (2 (1 - cos(theta)))) / theta^2 of theta^2, for theta up to pi."""
    small, low, theta = so3._split(theta_sq)
    near = so3._series(
        low, (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600)
    )
    return torch.where(small, near, (1 - 0.5 * theta * (0.5 * theta).cos() / (0.5 * theta).sin()) / theta.square())


def exp(xi: Tensor) -> Tensor:
    """Twist [..., 6] -> motion [..., 4, 4]."""
    w, v = xi[..., :3], xi[..., 3:]
    theta_sq = w.square().sum(-1)[..., None, None]
    W = so3.skew(w)
    WW = W @ W
    V = so3._eye_like(W) + so3.versinc(theta_sq) * W + _third(theta_sq) * WW
    R = so3._eye_like(W) + so3.sinc(theta_sq) * W + so3.versinc(theta_sq) * WW
    return make(R, (V @ v[..., None])[..., 0])


def log(T: Tensor) -> Tensor:
    """Motion [..., 4, 4] -> twist [..., 6] with rotation of at most pi."""
    w = so3.matrix_to_rotvec(T[..., :3, :3])
    W = so3.skew(w)
    V_inv = so3._eye_like(W) - 0.5 * W + _inverse_second(w.square().sum(-1)[..., None, None]) * (W @ W)
    return torch.cat([w, (V_inv @ T[..., :3, 3:])[..., 0]], -1)


def adjoint(T: Tensor) -> Tensor:
    """[..., 6, 6] with T exp(xi) = exp(adjoint(T) xi) T, twists rotation first. Lynch and Park, definition 3.20."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat([R, torch.zeros_like(R)], -1)
    return torch.cat([top, torch.cat([so3.skew(t) @ R, R], -1)], -2)


def _is_matrix(x: Tensor) -> bool:
    return x.dim() >= 2 and x.shape[-2:] == (4, 4)


def screw_at(motion: Tensor, s: Tensor | float) -> Tensor:
    """The fraction s of a motion along its screw, exp(s xi): [..., 4, 4].

    motion: T [..., 4, 4] (xi = log T) or xi [..., 6].  s: number or tensor of the batch shape (or one that broadcasts);
    any real number, so s = -1 is the inverse and s = 1.2 goes beyond the end.
    """
    xi = log(motion) if _is_matrix(motion) else motion
    return exp(xi * (s[..., None] if isinstance(s, Tensor) else s))


def screw_parameters(T: Tensor, min_angle: float = 1e-6) -> Screw:
    """The screw of a motion [..., 4, 4]. Below ``min_angle`` radians it counts as a pure translation.

    The origin solves (I - R) o = t - (axis . t) axis; o = (t' + cot(angle / 2) axis x t') / 2 is that system's
    pseudo-inverse solution in closed form (inverting I - R itself, as ancestors do, divides by round-off: its rank is
    2).
    """
    w, t = so3.matrix_to_rotvec(T[..., :3, :3]), T[..., :3, 3]
    angle, length = w.norm(dim=-1, keepdim=True), t.norm(dim=-1, keepdim=True)
    slides = angle < min_angle
    one = torch.ones_like(angle)
    fallback = torch.zeros_like(t)
    fallback[..., 2] = 1  # the identity has no axis of its own
    along = torch.where(length > 0, t / torch.where(length > 0, length, one), fallback)
    axis = torch.where(slides, along, w / torch.where(slides, one, angle))
    translation = (axis * t).sum(-1, keepdim=True)
    across = t - translation * axis
    half = 0.5 * torch.where(slides, one, angle)
    origin = 0.5 * (across + half.cos() / half.sin() * torch.linalg.cross(axis, across))
    zero = torch.zeros_like(angle)
    return Screw(axis, torch.where(slides, zero, origin), torch.where(slides, zero, angle)[..., 0], translation[..., 0])


def from_screw(axis: Tensor, origin: Tensor, angle: Tensor | float, translation: Tensor | float = 0.0) -> Tensor:
    """The motion [..., 4, 4] of a screw; inverse of ``screw_parameters``. axis is normalised; angle in radians."""
    axis = axis / axis.norm(dim=-1, keepdim=True)
    angle = torch.as_tensor(angle, dtype=axis.dtype, device=axis.device)[..., None]
    translation = torch.as_tensor(translation, dtype=axis.dtype, device=axis.device)[..., None]
    R = so3.rotvec_to_matrix(axis * angle)
    return make(R, origin - (R @ origin[..., None])[..., 0] + axis * translation)


def project_revolute(motion: Tensor) -> Tensor:
    """The nearest motion of zero pitch with the same rotation (no slide along the axis). No rotation: unchanged.

    T [..., 4, 4] or xi [..., 6], returned in the same form. In an optimiser project the twist, or the step's tangent:
    projecting T after every free step is known to stick.
    """
    if _is_matrix(motion):
        w, t = so3.matrix_to_rotvec(motion[..., :3, :3]), motion[..., :3, 3]
        return make(motion[..., :3, :3], _remove_along(t, w))
    return torch.cat([motion[..., :3], _remove_along(motion[..., 3:], motion[..., :3])], -1)


def _remove_along(v: Tensor, w: Tensor) -> Tensor:
    sq = w.square().sum(-1, keepdim=True)
    turning = sq > 1e-12
    return torch.where(
        turning, v - (v * w).sum(-1, keepdim=True) / torch.where(turning, sq, torch.ones_like(sq)) * w, v
    )


def project_prismatic(motion: Tensor, center: Optional[Tensor] = None) -> Tensor:
    """The pure translation that moves ``center`` [..., 3] (default: the world origin) as the motion does.

    T [..., 4, 4] or xi [..., 6], returned in the same form. Give the part's centroid: a small spurious turn moves a far
    origin a lot.
    """
    T = motion if _is_matrix(motion) else exp(motion)
    R, t = T[..., :3, :3], T[..., :3, 3]
    if center is not None:
        t = (R @ center[..., None])[..., 0] + t - center
    if _is_matrix(motion):
        return make(so3._eye_like(R).expand_as(R), t)
    return torch.cat([torch.zeros_like(t), t], -1)
