"""A hand-made twin: a cabinet shell with a door (revolute) on the left and a drawer (prismatic) on the right."""

from __future__ import annotations

import math

import numpy as np
import torch

from p2gs.types import ArticulatedObject, Camera, GaussianTensors, Joint, Part, Similarity, TwoStateScene, View

SPACING = 0.05
NO_CHANGE = Similarity()


def panel(corner, u, v, colour):
    """A rectangle of flat Gaussians: corner + a u + b v, a, b in [0, 1]."""
    corner, u, v = (np.asarray(x, dtype=np.float64) for x in (corner, u, v))
    na, nb = (max(int(round(np.linalg.norm(x) / SPACING)), 1) for x in (u, v))
    a, b = np.meshgrid((np.arange(na) + 0.5) / na, (np.arange(nb) + 0.5) / nb, indexing="ij")
    means = corner + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    thin = int(np.argmax(np.abs(np.cross(u, v))))
    scales = np.full((len(means), 3), SPACING * 0.6)
    scales[:, thin] = 0.003
    return means, scales, np.tile(colour, (len(means), 1))


def box(lo, hi, colour, skip=()):
    """Panels of an axis-aligned box; ``skip`` names faces to leave out, e.g. "-y"."""
    lo, hi = np.asarray(lo, float), np.asarray(hi, float)
    out = []
    for axis, name in enumerate("xyz"):
        u, v = np.zeros(3), np.zeros(3)
        u[(axis + 1) % 3], v[(axis + 2) % 3] = (hi - lo)[(axis + 1) % 3], (hi - lo)[(axis + 2) % 3]
        for sign, corner in (("-", lo.copy()), ("+", lo.copy())):
            if sign + name in skip:
                continue
            if sign == "+":
                corner[axis] = hi[axis]
            out.append(panel(corner, u, v, colour))
    return out


def gaussians_of(panels, sh_degree=1) -> GaussianTensors:
    means, scales, colours = (torch.tensor(np.concatenate(x), dtype=torch.float32) for x in zip(*panels, strict=True))
    n = len(means)
    sh = torch.zeros(n, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colours - 0.5) / 0.28209479177387814
    if sh_degree:
        sh[:, 1:] = 0.05 * torch.randn(sh[:, 1:].shape, generator=torch.Generator().manual_seed(0))
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return GaussianTensors(means, quats, scales.log(), torch.full((n,), 4.0), sh)


def joint_revolute(axis, origin, degrees) -> Joint:
    axis, origin = torch.tensor(axis, dtype=torch.float64), torch.tensor(origin, dtype=torch.float64)
    a = math.radians(degrees)
    W = torch.zeros(3, 3, dtype=torch.float64)
    W[0, 1], W[0, 2], W[1, 2] = -axis[2], axis[1], -axis[0]
    W = W - W.T
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] += math.sin(a) * W + (1 - math.cos(a)) * W @ W
    T[:3, 3] = origin - T[:3, :3] @ origin
    return Joint("revolute", axis, origin, degrees, (min(0.0, degrees), max(0.0, degrees)), T)


def joint_prismatic(axis, origin, length) -> Joint:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor(axis, dtype=torch.float64) * length
    origin = torch.tensor(origin, dtype=torch.float64)
    return Joint(
        "prismatic", torch.tensor(axis, dtype=torch.float64), origin, length, (min(0.0, length), max(0.0, length)), T
    )


def start_parts():
    """[base, door, drawer] as panels in the start state, and the two joints, in input coordinates."""
    base = box((-0.5, -0.4, -0.5), (0.5, 0.4, 0.5), (0.75, 0.7, 0.6), skip=("-y",)) + [
        panel((0, -0.4, -0.5), (0, 0.8, 0), (0, 0, 1), (0.7, 0.65, 0.6))
    ]
    door = box((-0.49, -0.45, -0.49), (-0.01, -0.41, 0.49), (0.3, 0.45, 0.7))
    drawer = box((0.03, -0.43, -0.2), (0.47, 0.35, 0.2), (0.7, 0.35, 0.3), skip=("+z",))
    return [base, door, drawer], [
        joint_revolute((0.0, 0.0, 1.0), (-0.49, -0.43, 0.0), -70.0),
        joint_prismatic((0.0, -1.0, 0.0), (0.25, 0.0, 0.0), 0.4),
    ]


def toy_twin(similarity: Similarity = NO_CHANGE, sh_degree=1, canonical_time=0.0) -> ArticulatedObject:
    """The cabinet as internal coordinates under ``similarity``. canonical_time 0: the Gaussians are the start state."""
    panels, joints = start_parts()
    sets = [gaussians_of(p, sh_degree) for p in panels]
    ids = torch.cat([torch.full((len(g),), k, dtype=torch.int64) for k, g in enumerate(sets)])
    g = GaussianTensors.cat(sets)
    s, c = similarity.scale, torch.tensor(similarity.center, dtype=torch.float64)
    g = GaussianTensors(similarity.to_internal(g.means), g.quats, g.log_scales + math.log(s), g.opacity_logits, g.sh)
    inner = []
    for j in joints:
        T = j.transform.clone()
        T[:3, 3] = s * (j.transform[:3, 3] - c + j.transform[:3, :3] @ c)
        unit = 1.0 if j.type == "revolute" else s
        inner.append(
            Joint(
                j.type,
                j.axis,
                similarity.to_internal(j.origin),
                j.motion * unit,
                (j.limits[0] * unit, j.limits[1] * unit),
                T,
            )
        )
    parts = [Part(0), Part(1, inner[0], confidence=0.9), Part(2, inner[1], confidence=0.8)]
    return ArticulatedObject(g, ids, parts, canonical_time, similarity)


def look_at(eye, target, size=100, focal=1.2) -> Camera:
    """An OpenCV camera at ``eye``; up is z."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, (0, 0, 1.0))
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ eye
    K = torch.tensor([[focal * size, 0, size / 2], [0, focal * size, size / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.tensor(viewmat, dtype=torch.float32), K, size, size)


def ring(n=8, size=100, radius=2.6, elevations=(20.0, 55.0)) -> list[Camera]:
    cams = []
    for i in range(n):
        az, el = 2 * math.pi * (i + 0.25) / n, math.radians(elevations[i % len(elevations)])
        cams.append(
            look_at(
                (radius * math.cos(el) * math.cos(az), radius * math.cos(el) * math.sin(az), radius * math.sin(el)),
                (0, 0, 0),
                size,
            )
        )
    return cams


def toy_scene(similarity: Similarity = NO_CHANGE, n=8, size=100, render=None) -> TwoStateScene:
    """Views around the cabinet in internal coordinates; ``render(state, camera) -> ([H, W, 3], [H, W])`` in 0..1 fills
    the images."""
    views = []
    for state in (0, 1):
        for split, count, turn in (("train", n, 0.0), ("test", 2, 0.4)):
            for i, cam in enumerate(ring(count, size)):
                viewmat = cam.viewmat.double()
                a = torch.tensor(
                    [[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]],
                    dtype=torch.float64,
                )
                viewmat[:3, :3] = viewmat[:3, :3] @ a
                R, t = viewmat[:3, :3], viewmat[:3, 3]
                viewmat[:3, 3] = similarity.scale * (t + R @ torch.tensor(similarity.center, dtype=torch.float64))
                cam = Camera(viewmat.float(), cam.K, size, size)
                if render is None:
                    image, alpha = (
                        torch.zeros(size, size, 3, dtype=torch.uint8),
                        torch.zeros(size, size, dtype=torch.uint8),
                    )
                else:
                    rgb, a = render(state, cam)
                    image, alpha = (
                        (rgb.clamp(0, 1) * 255).round().to(torch.uint8),
                        (a.clamp(0, 1) * 255).round().to(torch.uint8),
                    )
                views.append(View(f"{state}/{split}/{i:04d}", state, split, cam, image, alpha))
    return TwoStateScene("toy", tuple(views), similarity)
