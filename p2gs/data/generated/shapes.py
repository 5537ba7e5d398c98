"""Primitives of generated objects: oriented boxes, cylinders, balls; their ray intersection, normals and triangles.

Each is convex, so a ray's inside is one interval: the intersection of slabs (Kay and Kajiya 1986, DOI
10.1145/15922.15916) and a quadric. Rays are given as origin + z * direction with the direction's camera z equal to 1,
so that z is the depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from p2gs.data.generated.textures import Texture

Kind = Literal["box", "cylinder", "ball"]
CYLINDER_SIDES = 48


@dataclass(frozen=True)
class Primitive:
    """size: half extents [3] along the local axes; a cylinder stands along local z with size (r, r, h), a ball has (r,
    r, r).

    pose: [4, 4] float64 local -> object at joint value 0.
    """

    kind: Kind
    size: tuple[float, float, float]
    pose: np.ndarray
    texture: Texture

    def moved(self, T: np.ndarray) -> "Primitive":
        return replace(self, pose=T @ self.pose)

    def scaled(self, scale: float, centre: np.ndarray) -> "Primitive":
        """Of the object after x -> scale * (x - centre)."""
        pose = self.pose.copy()
        pose[:3, 3] = scale * (pose[:3, 3] - centre)
        return replace(self, pose=pose, size=tuple(scale * s for s in self.size), texture=self.texture.scaled(scale))

    @property
    def corners(self) -> np.ndarray:
        """[8, 3] corners of the oriented bounding box."""
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 3)
        return (signs * self.size) @ self.pose[:3, :3].T + self.pose[:3, 3]

    def contains(self, points: np.ndarray, slack: float = 0.0) -> np.ndarray:
        """[N] bool for points [N, 3]: deeper inside than ``slack``."""
        p = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        s = np.asarray(self.size) - slack
        if self.kind == "box":
            return np.all(np.abs(p) < s, axis=1)
        if self.kind == "cylinder":
            return (np.hypot(p[:, 0], p[:, 1]) < s[0]) & (np.abs(p[:, 2]) < s[2])
        return np.linalg.norm(p, axis=1) < s[0]

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """[count, 3] points inside."""
        points = np.empty((0, 3))
        while len(points) < count:
            p = rng.uniform(-1, 1, (4 * count, 3)) * self.size
            p = p @ self.pose[:3, :3].T + self.pose[:3, 3]
            points = np.concatenate([points, p[self.contains(p)]])
        return points[:count]


def box(lo, hi, texture: Texture) -> Primitive:
    """Axis-aligned box between two corners [3]."""
    lo, hi = np.minimum(lo, hi).astype(float), np.maximum(lo, hi).astype(float)
    pose = np.eye(4)
    pose[:3, 3] = (lo + hi) / 2
    return Primitive("box", tuple((hi - lo) / 2), pose, texture)


def frame_along(direction) -> np.ndarray:
    """[3, 3] rotation whose third column is the direction."""
    z = np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross([0, 1, 0] if abs(z[1]) < 0.9 else [1, 0, 0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def cylinder(a, b, radius: float, texture: Texture) -> Primitive:
    """Cylinder from point a to point b."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame_along(b - a), (a + b) / 2
    return Primitive("cylinder", (radius, radius, float(np.linalg.norm(b - a)) / 2), pose, texture)


def ball(centre, radius: float, texture: Texture) -> Primitive:
    pose = np.eye(4)
    pose[:3, 3] = centre
    return Primitive("ball", (radius, radius, radius), pose, texture)


def ring(centre, normal, radius: float, thickness: float, texture: Texture, sides: int = 20) -> list[Primitive]:
    """A ring as cylinders end to end."""
    R, angles = frame_along(normal), np.linspace(0, 2 * np.pi, sides + 1)
    points = np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles], 1) @ R.T + np.asarray(centre)
    return [cylinder(a, b, thickness, texture) for a, b in zip(points[:-1], points[1:], strict=True)]


def hit_interval(kind: Kind, size, o: np.ndarray, d, inv, inv_abs) -> tuple[np.ndarray, np.ndarray]:
    """(entry, exit) along each ray, entry >= exit where the ray misses.

    o: [3] the common origin in local coordinates.  d, inv, inv_abs: three arrays each, direction, 1 / direction and its
    absolute value per ray (any shape).
    """
    axes = range(3) if kind == "box" else ((2,) if kind == "cylinder" else ())
    near = far = None
    for i in axes:
        middle, reach = (-o[i]) * inv[i], size[i] * inv_abs[i]
        lo, hi = middle - reach, middle + reach
        near = lo if near is None else np.maximum(near, lo, out=near)
        far = hi if far is None else np.minimum(far, hi, out=far)
    if kind != "box":
        n = 2 if kind == "cylinder" else 3
        a = sum(d[i] * d[i] for i in range(n)) + np.float32(1e-12)
        b = sum(o[i] * d[i] for i in range(n))
        disc = b * b - a * np.float32(sum(o[i] * o[i] for i in range(n)) - size[0] ** 2)
        root = np.sqrt(np.maximum(disc, 0))
        lo, hi = (-b - root) / a, (-b + root) / a
        hi[disc <= 0] = -1
        near = lo if near is None else np.maximum(near, lo)
        far = hi if far is None else np.minimum(far, hi)
    assert near is not None and far is not None  # a shape has axes or is round
    return near, far


def local_normals(kind: Kind, size, p: np.ndarray) -> np.ndarray:
    """[N, 3] float32 outward unit normals at surface points p [N, 3] in local coordinates."""
    n = np.zeros_like(p)
    if kind == "box":
        axis = (np.abs(p) - np.asarray(size, p.dtype)).argmax(axis=1)
        rows = np.arange(len(p))
        n[rows, axis] = np.sign(p[rows, axis])
    elif kind == "cylinder":
        cap = np.abs(p[:, 2]) - size[2] > np.hypot(p[:, 0], p[:, 1]) - size[0]
        n[:, :2] = p[:, :2] / size[0]
        n[cap] = 0
        n[cap, 2] = np.sign(p[cap, 2])
    else:
        n = p / size[0]
    return n


def triangulate(primitive: Primitive) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [V, 3] float64, faces [F, 3] int64) in the coordinates of ``pose``, faces counter-clockwise from
    outside."""
    import trimesh

    if primitive.kind == "box":
        mesh = trimesh.creation.box(extents=2 * np.asarray(primitive.size))
    elif primitive.kind == "cylinder":
        mesh = trimesh.creation.cylinder(
            radius=primitive.size[0], height=2 * primitive.size[2], sections=CYLINDER_SIDES
        )
    else:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=primitive.size[0])
    vertices = mesh.vertices @ primitive.pose[:3, :3].T + primitive.pose[:3, 3]
    return np.asarray(vertices), np.asarray(mesh.faces)
