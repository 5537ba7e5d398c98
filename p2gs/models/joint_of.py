"""A joint from a rigid motion: its type, the nearest motion of that type, axis, origin and range."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from p2gs.ops import se3, so3
from p2gs.types import Joint


def name_types(types: list[str], transforms: Tensor, below: float) -> list[str]:
    """Give every "free" motion a joint type by its angle; transforms [K, 4, 4]."""
    angle = torch.rad2deg(so3.rotation_angle(transforms[:, :3, :3])) if len(transforms) else []
    return [
        ("prismatic" if float(a) < below else "revolute") if t == "free" else t
        for t, a in zip(types, angle, strict=True)
    ]


def constrain(kind: str, T: Tensor, centre: Tensor) -> Tensor:
    """The nearest motion [4, 4] of a joint type: a slide carries ``centre`` [3] where T does, a turn loses its
    pitch."""
    if kind == "prismatic":
        out = torch.eye(4, dtype=T.dtype)
        out[:3, 3] = T[:3, :3] @ centre + T[:3, 3] - centre
        return out
    return se3.project_revolute(T)


def make_joint(kind: str, transform: Tensor, centre: Tensor) -> Joint:
    """A joint from its start -> end motion [4, 4]; ``centre`` [3] is the part's centre at the start (origin of a slide;
    picks the origin on a hinge's axis nearest to it). The observed motion is the range."""
    screw = se3.screw_parameters(transform.double())
    if kind == "prismatic":
        length = float(transform[:3, 3].norm())
        axis = transform[:3, 3] / max(length, 1e-12)
        return Joint("prismatic", axis, centre, length, (0.0, length), transform)
    axis = screw.axis
    origin = screw.origin + axis * ((centre - screw.origin) @ axis)
    degrees = math.degrees(float(screw.angle))
    return Joint("revolute", axis, origin, degrees, (min(0.0, degrees), max(0.0, degrees)), transform)
