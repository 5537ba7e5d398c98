"""Generated scenes: an object by kind and seed, cameras around it, its two states ray-traced. Nothing is downloaded.

The same (kind, seed, size, number of views) gives the same pixels. Cameras follow the benchmarks: training views on the
upper hemisphere at 3.2 units with a 50 mm lens, test views on a ring at 30 degrees.
"""

from __future__ import annotations

import zlib
from typing import Optional

import numpy as np
import torch

from p2gs.data.generated import gadgets  # noqa: F401  (registers its kinds)
from p2gs.data.generated.articulated import SyntheticObject
from p2gs.data.generated.furniture import KINDS, demo_cabinet
from p2gs.data.generated.raytrace import Shadow, render
from p2gs.types import Camera, TwoStateScene, View

RADIUS = 3.2
FOCAL = 50 / 36  # focal length over image width: 50 mm lens, 36 mm sensor
TEST_ELEVATION = 30.0


def cabinet() -> SyntheticObject:
    """The demo object: one hinged door, one drawer."""
    return demo_cabinet()


def make_object(kind: Optional[str] = None, seed: int = 0) -> SyntheticObject:
    """A random object of a kind (see ``KINDS``; None: any; ``demo``: the demo cabinet, whatever the seed). Raises
    UserError."""
    if kind == "demo":
        return cabinet()
    if kind is None:
        names = sorted(KINDS)
        kind = names[np.random.default_rng([seed, 0]).integers(len(names))]
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    return KINDS[kind](rng)


def look_at(position: np.ndarray, target=(0.0, 0.0, 0.0)) -> np.ndarray:
    """[4, 4] float64 world -> camera (OpenCV) with the world's z up in the image."""
    forward = np.asarray(target) - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def train_cameras(count: int, seed: int) -> list[np.ndarray]:
    """Viewmats [4, 4] on the upper hemisphere: a Fibonacci lattice, turned and jittered by the seed."""
    rng = np.random.default_rng([seed, 1])
    height = np.clip((np.arange(count) + rng.uniform(0.1, 0.9, count)) / count, 0.02, 0.985)
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi) + rng.normal(0, 0.1, count)
    across = np.sqrt(1 - height**2)
    return [
        look_at(RADIUS * np.array(x))
        for x in zip(across * np.cos(azimuth), across * np.sin(azimuth), height, strict=True)
    ]


def test_cameras(count: int) -> list[np.ndarray]:
    """Viewmats [4, 4] on a ring at 30 degrees."""
    e, azimuth = np.deg2rad(TEST_ELEVATION), 2 * np.pi * (np.arange(count) + 0.5) / max(count, 1)
    return [look_at(RADIUS * np.array([np.cos(e) * np.cos(p), np.cos(e) * np.sin(p), np.sin(e)])) for p in azimuth]


def intrinsics(size: int) -> np.ndarray:
    """[3, 3] float64 of a square image."""
    return np.array([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1.0]])


def render_view(
    obj: SyntheticObject, state: int, split, name: str, viewmat: np.ndarray, size: int, shadow: Optional[Shadow] = None
) -> View:
    """One view of a state, with exact depth. viewmat: [4, 4].  shadow: of this state, or None for an object that casts
    none."""
    K = intrinsics(size)
    primitives, parts = obj.posed(float(state))
    r = render(primitives, parts, viewmat, K, size, size, shadow=shadow)
    depth = np.where(r.alpha > 127, r.depth, 0).astype(np.float32)
    camera = Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), size, size)
    return View(
        name, state, split, camera, torch.from_numpy(r.image), torch.from_numpy(r.alpha), torch.from_numpy(depth)
    )


def synthetic_scene(
    obj: SyntheticObject, size: int = 400, train_views: int = 64, test_views: int = 10, seed: int = 0
) -> TwoStateScene:
    """Both states rendered, in memory; input units are the object's own."""
    views = []
    for state in (0, 1):
        shadow = Shadow(obj.posed(float(state))[0])
        for split, cameras in (("train", train_cameras(train_views, seed + state)), ("test", test_cameras(test_views))):
            views += [
                render_view(obj, state, split, f"{i:04d}", viewmat, size, shadow) for i, viewmat in enumerate(cameras)
            ]
    return TwoStateScene(obj.name, tuple(views))
