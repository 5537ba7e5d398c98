"""Mass, centre of mass and inertia of a part, from the volume it encloses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np

from p2gs.export.physics.convex import Piece

GRAVITY = 9.81  # m / s^2


@dataclass(frozen=True)
class Inertia:
    """mass [kg], center of mass [3] and inertia about it [3, 3], in the link's frame."""

    mass: float
    center: np.ndarray
    matrix: np.ndarray


def enclosed(vertices: np.ndarray, faces: np.ndarray) -> Optional[Piece]:
    """The closed surface [V, 3], [F, 3] of a solid; None where it is open or turned inside out."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces)  # with vertices of the same place merged
    return Piece(np.array(mesh.vertices), np.array(mesh.faces)) if mesh.is_volume else None


def inertia_of(pieces: list[Piece], density: float) -> Inertia:
    """Mass properties of disjoint solids (closed surfaces, convex or not)."""
    import trimesh

    props = [trimesh.Trimesh(p.vertices, p.faces, process=False).mass_properties for p in pieces]
    masses = np.array([max(float(p["volume"]), 1e-12) * density for p in props])
    centers = np.array([p["center_mass"] for p in props])
    center = (masses[:, None] * centers).sum(0) / masses.sum()
    total = np.zeros((3, 3))
    for p, m, c in zip(props, masses, centers, strict=True):
        d = c - center
        total += np.asarray(p["inertia"]) * density + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    return Inertia(float(masses.sum()), center, (total + total.T) / 2)


def joint_load(inertia: Inertia, axis: np.ndarray, kind: str) -> float:
    """The part's weight; on a hinge times the distance of its centre of mass from the axis [3]. N or N m."""
    arm = 1.0 if kind == "prismatic" else float(np.linalg.norm(np.cross(axis, inertia.center)))
    return GRAVITY * inertia.mass * arm


def effective_inertia(inertia: Inertia, axis: np.ndarray) -> float:
    """About a unit axis [3] through the link's origin, kg m^2."""
    arm = np.cross(axis, inertia.center)
    return float(axis @ inertia.matrix @ axis + inertia.mass * arm @ arm)
