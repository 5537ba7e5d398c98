"""A generated articulated object: parts made of primitives, a joint per moving part, two states."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Optional, Sequence

import numpy as np

from p2gs.data.generated.shapes import Primitive, triangulate


@dataclass(frozen=True)
class SyntheticJoint:
    """Axis [3] unit through origin [3] in object coordinates; start, end: joint value in both states (degrees or
    length, 0 = as built)."""

    type: Literal["revolute", "prismatic"]
    axis: np.ndarray
    origin: np.ndarray
    start: float
    end: float

    @property
    def motion(self) -> float:
        return self.end - self.start

    def transform(self, value: float) -> np.ndarray:
        """[4, 4] motion from joint value 0 to ``value``."""
        T = np.eye(4)
        if self.type == "prismatic":
            T[:3, 3] = value * self.axis
            return T
        x, y, z = self.axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.deg2rad(value)
        T[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        T[:3, 3] = self.origin - T[:3, :3] @ self.origin
        return T


def revolute(axis, origin, start: float, end: float) -> SyntheticJoint:
    axis = np.asarray(axis, float)
    return SyntheticJoint(
        "revolute", axis / np.linalg.norm(axis), np.asarray(origin, float), float(start) + 0.0, float(end) + 0.0
    )


def prismatic(axis, origin, start: float, end: float) -> SyntheticJoint:
    return replace(revolute(axis, origin, start, end), type="prismatic")


@dataclass(frozen=True)
class SyntheticPart:
    """primitives at joint value 0.  joint: None for the static part."""

    name: str
    primitives: tuple[Primitive, ...]
    joint: Optional[SyntheticJoint] = None

    def pose(self, t: float) -> np.ndarray:
        """[4, 4] from joint value 0 to state time t (0 start, 1 end)."""
        return np.eye(4) if self.joint is None else self.joint.transform(self.joint.start + t * self.joint.motion)


@dataclass(frozen=True)
class SyntheticObject:
    """parts[0] is static (without primitives where all moves), the others move. ``fitted`` brings it to the size of the
    benchmarks' objects."""

    name: str
    parts: tuple[SyntheticPart, ...]

    @property
    def joints(self) -> list[SyntheticJoint]:
        return [p.joint for p in self.parts if p.joint is not None]

    def posed(self, t: float) -> tuple[list[Primitive], list[int]]:
        """All primitives at state time t, and the part id of each."""
        primitives = [q.moved(part.pose(t)) for part in self.parts for q in part.primitives]
        return primitives, [k for k, part in enumerate(self.parts) for _ in part.primitives]

    def mesh(self, part: int, t: float) -> tuple[np.ndarray, np.ndarray]:
        """(vertices [V, 3], faces [F, 3]) of one part at state time t."""
        return concatenate([triangulate(q.moved(self.parts[part].pose(t))) for q in self.parts[part].primitives])

    def fitted(self, radius: float = 0.98) -> "SyntheticObject":
        """Moved and scaled so that both states lie in the ball of this radius around the origin."""
        corners = np.concatenate([q.corners for t in (0.0, 1.0) for q in self.posed(t)[0]])
        centre = (corners.min(0) + corners.max(0)) / 2
        scale = radius / np.linalg.norm(corners - centre, axis=1).max()
        parts = []
        for part in self.parts:
            joint = part.joint
            if joint is not None:
                factor = float(scale) if joint.type == "prismatic" else 1.0
                joint = replace(
                    joint, origin=scale * (joint.origin - centre), start=factor * joint.start, end=factor * joint.end
                )
            parts.append(SyntheticPart(part.name, tuple(q.scaled(scale, centre) for q in part.primitives), joint))
        return SyntheticObject(self.name, tuple(parts))

    def overlap(self, t: float, samples: int = 200, slack: float = 0.004, seed: int = 0) -> float:
        """Share of the moving parts' volume that lies inside other parts, more than ``slack`` deep, at state time t."""
        rng = np.random.default_rng(seed)
        primitives, ids = self.posed(t)
        inside = total = 0
        for q, part in zip(primitives, ids, strict=True):
            if self.parts[part].joint is None:
                continue
            points = q.sample(rng, samples)
            hit = np.zeros(len(points), bool)
            for other, other_part in zip(primitives, ids, strict=True):
                if other_part != part:
                    hit |= other.contains(points, slack)
            inside, total = inside + int(hit.sum()), total + len(points)
        return inside / max(total, 1)


def concatenate(meshes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several (vertices [V, 3], faces [F, 3]) as one; without vertices where there are none."""
    meshes = [(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), *meshes]
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    return np.concatenate([v for v, _ in meshes]), np.concatenate(
        [f + o for (_, f), o in zip(meshes, offsets, strict=True)]
    )
