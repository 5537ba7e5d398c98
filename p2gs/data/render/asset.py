"""An articulated asset: links of coloured triangles, joints between them, and where links are at given joint values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

import numpy as np

from p2gs.registry import suggest
from p2gs.types import UserError

JointType = Literal["revolute", "prismatic", "fixed"]


@dataclass(frozen=True)
class Shape:
    """Triangles of one look, in the coordinates of their link.

    vertices [V, 3]; faces [F, 3]; colour [3] in 0..1 (sRGB); or a texture: image [H, W, 3] uint8 with uv [V, 2], v up.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    image: Optional[np.ndarray] = None
    uv: Optional[np.ndarray] = None


@dataclass(frozen=True)
class AssetJoint:
    """A joint from link ``parent`` to link ``child``.

    placed [4, 4]: the joint's frame in the parent's.  axis [3]: unit, in the joint's frame.  back [4, 4]: the child's
    frame in the joint's, at ``zero``: the value at which nothing is turned or shifted (MJCF's ref).  limits: (least,
    most) in radians or lengths, None where there are none.
    """

    name: str
    type: JointType
    parent: str
    child: str
    placed: np.ndarray
    axis: np.ndarray
    limits: Optional[tuple[float, float]] = None
    back: np.ndarray = field(default_factory=lambda: np.eye(4))
    zero: float = 0.0

    def motion(self, value: float) -> np.ndarray:
        """[4, 4] child -> parent at a value in radians or lengths."""
        T = np.eye(4)
        if self.type == "prismatic":
            T[:3, 3] = (value - self.zero) * self.axis
        elif self.type == "revolute":
            T[:3, :3] = rotation(self.axis, value - self.zero)
        return self.placed @ T @ self.back

    @property
    def rest(self) -> float:
        """``zero``, or the limit next to it."""
        return self.zero if self.limits is None else min(max(self.zero, self.limits[0]), self.limits[1])


@dataclass(frozen=True)
class Asset:
    """links: their shapes by name.  joints: every link but the roots is the child of one.  path: the file it is of."""

    path: Path
    links: dict[str, list[Shape]]
    joints: list[AssetJoint]

    @property
    def movable(self) -> list[AssetJoint]:
        return [j for j in self.joints if j.type != "fixed"]

    def joint(self, name: str) -> AssetJoint:
        """The movable joint of that name. Raises UserError, which names the nearest or all that there are."""
        names = [j.name for j in self.movable]
        if name not in names:
            has = f"it has {', '.join(names) or 'none'}"
            raise UserError(f"{self.path}: there is no movable joint '{name}'{suggest(name, names)}; {has}")
        return self.movable[names.index(name)]

    def poses(self, values: dict[str, float]) -> dict[str, np.ndarray]:
        """Every link's [4, 4] in the asset's coordinates; joints that ``values`` does not name are at rest."""
        children = {j.child for j in self.joints}
        at = {name: np.eye(4) for name in self.links if name not in children}
        waiting = list(self.joints)
        while waiting:
            ready = [j for j in waiting if j.parent in at]
            if not ready:
                raise UserError(f"{self.path}: the joint '{waiting[0].name}' hangs on no link that leads to a root")
            for j in ready:
                at[j.child] = at[j.parent] @ j.motion(values.get(j.name, j.rest))
                waiting.remove(j)
        return at

    def parts(self, names: list[str]) -> dict[str, int]:
        """The part of every link: 1 + i where the nearest of the joints ``names`` above it is the i-th, else 0."""
        above = {j.child: j for j in self.joints}
        out = {}
        for link in self.links:
            at = link
            while at in above and above[at].name not in names:
                at = above[at].parent
            out[link] = 1 + names.index(above[at].name) if at in above else 0
        return out


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """[3, 3] turn about a unit axis [3] by ``angle`` radians (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def euler(angles, order: str) -> np.ndarray:
    """[3, 3] from angles [3] in radians about ``order``'s axes: xyz about the turned axes, XYZ about the fixed ones."""
    turns = [rotation(np.eye(3)["xyz".index(a.lower())], v) for a, v in zip(order, angles, strict=True)]
    return np.linalg.multi_dot(turns if order.islower() else turns[::-1])


def unit(axis: np.ndarray, where: str) -> np.ndarray:
    """The vector [3] at length 1. Raises UserError for an axis without length."""
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length < 1e-9:
        raise UserError(f"{where}: the axis {np.round(axis, 9).tolist()} has no direction")
    return axis / length
