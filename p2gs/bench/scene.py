"""The scene that the kernel benchmarks render: N Gaussians on the surfaces of boxes and cylinders, one camera around
it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.types import Camera


@dataclass
class BenchScene:
    """Arguments of ``render.rasterize`` (activated values, float32): means, scales [N, 3], quats [N, 4], opacities [N],
    sh [N, 16, 3]."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    camera: Camera

    def tensors(self) -> tuple[Tensor, ...]:
        return self.means, self.quats, self.scales, self.opacities, self.sh


# A cupboard, more or less: (centre, half size) of boxes, (centre, radius, half height) of upright cylinders.
_BOXES = (
    ((0, 0, 0), (0.7, 0.45, 0.55)),
    ((0.15, -0.55, 0.25), (0.4, 0.1, 0.14)),
    ((-0.35, -0.5, -0.3), (0.25, 0.06, 0.2)),
)
_CYLINDERS = (((-0.4, 0.1, 0.75), 0.18, 0.2), ((0.35, 0.0, 0.7), 0.12, 0.15), ((0.15, -0.7, 0.25), 0.05, 0.12))


def _surface_samples(n: int, rng: np.random.Generator) -> np.ndarray:
    """n points spread evenly by area, [n, 3] float64."""
    pieces = []  # (area, sampler)
    for centre, half in _BOXES:
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for side in (-1, 1):

                def face(k, centre=centre, half=half, axis=axis, u=u, v=v, side=side):
                    p = np.empty((k, 3))
                    p[:, axis] = side * half[axis]
                    p[:, u], p[:, v] = rng.uniform(-half[u], half[u], k), rng.uniform(-half[v], half[v], k)
                    return p + centre

                pieces.append((4 * half[u] * half[v], face))
    for centre, radius, height in _CYLINDERS:

        def tube(k, centre=centre, radius=radius, height=height):
            a = rng.uniform(0, 2 * math.pi, k)
            return np.stack([radius * np.cos(a), radius * np.sin(a), rng.uniform(-height, height, k)], 1) + centre

        pieces.append((4 * math.pi * radius * height, tube))
    areas = np.array([a for a, _ in pieces])
    counts = rng.multinomial(n, areas / areas.sum())
    return np.concatenate([sample(k) for k, (_, sample) in zip(counts, pieces, strict=True)])


def bench_scene(n: int, px: int, seed: int = 0, scale: float = 2.0) -> BenchScene:
    """n Gaussians of about ``scale`` x the mean nearest-neighbour distance (lognormal, sigma 0.3, each axis), opacities
    0.1 to 0.95, random rotations and degree-3 colours; a view of px x px pixels of which they cover about 40 %."""
    rng = np.random.default_rng(seed)
    means = _surface_samples(n, rng)
    spacing = search_tree(means).query(means, 2)[0][:, 1].mean() if n > 1 else 0.1
    scales = scale * spacing * rng.lognormal(0, 0.3, (n, 3))
    sh = rng.normal(0, 0.1, (n, 16, 3))
    sh[:, 0] = rng.uniform(-1, 1, (n, 3))

    position = np.array([1.6, -2.4, 1.5])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ position
    K = np.array([[1.25 * px, 0, px / 2], [0, 1.25 * px, px / 2], [0, 0, 1]])

    def f32(x) -> Tensor:
        return torch.tensor(np.ascontiguousarray(x), dtype=torch.float32)

    camera = Camera(f32(viewmat), f32(K), px, px)
    return BenchScene(
        f32(means), f32(rng.normal(size=(n, 4))), f32(scales), f32(rng.uniform(0.1, 0.95, n)), f32(sh), camera
    )
