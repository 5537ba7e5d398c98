"""Small articulated things made of boxes, and what a noisy reconstruction of their two states would show discovery."""

from __future__ import annotations

import numpy as np
import torch

from p2gs.data.generated.articulated import SyntheticObject, SyntheticPart, prismatic, revolute
from p2gs.data.generated.furniture import box
from p2gs.data.generated.raytrace import trace
from p2gs.data.generated.synthetic import intrinsics, train_cameras
from p2gs.data.generated.textures import Texture
from p2gs.motion.discovery import StateEvidence
from p2gs.types import Camera

PLAIN = Texture("noise", (0.6, 0.6, 0.6), (0.5, 0.5, 0.5), 0.2, 1)


def boards(x0, y0, z0, x1, y1, z1, wall=0.04):
    """An open cupboard: five boards, its front (+x) missing."""
    corners = [
        ((x0, y0, z0), (x0 + wall, y1, z1)),
        ((x0, y0, z0), (x1, y0 + wall, z1)),
        ((x0, y1 - wall, z0), (x1, y1, z1)),
        ((x0, y0, z0), (x1, y1, z0 + wall)),
        ((x0, y0, z1 - wall), (x1, y1, z1)),
    ]
    return [box(a, b, PLAIN) for a, b in corners]


def drawer(y0, y1, z0, z1, travel, depth=0.6):
    """A front at x = 0 .. 0.04 with a tray behind it, pulled along +x."""
    tray = [
        box((-depth, y0 + 0.05, z0 + 0.05), (0, y1 - 0.05, z0 + 0.07), PLAIN),
        box((-depth, y0 + 0.05, z0 + 0.07), (0, y0 + 0.07, z1 - 0.1), PLAIN),
        box((-depth, y1 - 0.07, z0 + 0.07), (0, y1 - 0.05, z1 - 0.1), PLAIN),
        box((-depth, y0 + 0.07, z0 + 0.07), (0.02 - depth, y1 - 0.07, z1 - 0.1), PLAIN),
    ]
    return SyntheticPart(
        "drawer", (box((0, y0, z0), (0.04, y1, z1), PLAIN), *tray), prismatic((1, 0, 0), (0, 0, 0), 0, travel)
    )


def door(y0, y1, z0, z1, left, angle):
    """A panel hinged at low y (``left``) or high y, opening outwards by ``angle`` degrees, with a knob at its free
    edge."""
    hinge, knob = (y0, y1 - 0.08) if left else (y1, y0 + 0.08)
    middle = (z0 + z1) / 2
    parts = (
        box((0, y0, z0), (0.04, y1, z1), PLAIN),
        box((0.04, knob - 0.02, middle - 0.08), (0.09, knob + 0.02, middle + 0.08), PLAIN),
    )
    return SyntheticPart("door", parts, revolute((0, 0, -1.0 if left else 1.0), (0.04, hinge, middle), 0, angle))


def shell(*moving, static=()):
    base = boards(-0.7, -0.6, -0.6, 0.0, 0.6, 0.6) + list(static)
    return SyntheticObject("boxes", (SyntheticPart("base", tuple(base)), *moving)).fitted()


def evidence(
    obj: SyntheticObject,
    state: int,
    seed: int = 0,
    size: int = 110,
    views: int = 28,
    noise: float = 0.003,
    points: int = 4000,
):
    """What a reconstruction of this state might give, and the true part of each of its points."""
    rng = np.random.default_rng([seed, state])
    primitives, ids = obj.posed(float(state))
    K = intrinsics(size)
    axis = (np.arange(size) + 0.5 - size / 2) / K[0, 0]
    depths, alphas, cameras, cloud, parts = [], [], [], [], []
    for viewmat in train_cameras(views, seed + state):
        z, index = trace(primitives, viewmat, K, axis, axis)
        hit = np.isfinite(z)
        z = np.where(hit, z + noise * rng.normal(size=z.shape), 0).astype(np.float32)
        depths.append(torch.from_numpy(z))
        alphas.append(torch.from_numpy(hit.astype(np.float32)))
        cameras.append(Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), size, size))
        y, x = np.nonzero(hit)
        rays = np.stack([axis[x], axis[y], np.ones(len(x))], 1) * z[hit][:, None]
        cloud.append((rays - viewmat[:3, 3]) @ viewmat[:3, :3])
        parts.append(np.asarray(ids)[index[hit]])
    cloud, parts = np.concatenate(cloud), np.concatenate(parts)
    pick = rng.choice(len(cloud), points, replace=False)
    cloud = torch.from_numpy(cloud[pick]).float()
    return StateEvidence(
        cloud, torch.full((points, 3), 0.5), None, torch.ones(points), depths, alphas, cameras
    ), torch.from_numpy(parts[pick])


def both(obj: SyntheticObject, seed: int = 0, **kw):
    """(start, end) evidence and their true parts."""
    (a, la), (b, lb) = evidence(obj, 0, seed, **kw), evidence(obj, 1, seed, **kw)
    return (a, b), (la, lb)
