"""Where to look from: the run's cameras kept beside the twin, and the view in which the moving parts show best.

RUN/cameras.json is written by ``write_twin`` in input coordinates, so that pictures, meshes and videos need no dataset
later.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.gaussians.frame import camera_to_input
from p2gs.gaussians.pose import pose
from p2gs.types import ArticulatedObject, Camera, TwoStateScene, UserError, short


@dataclass(frozen=True)
class NamedCamera:
    """A camera of the run: the view's name, the state it photographed (0 or 1) and its split."""

    name: str
    state: int
    split: str
    camera: Camera


def scene_cameras(scene: TwoStateScene) -> list[NamedCamera]:
    """The scene's cameras in input coordinates."""
    return [NamedCamera(v.name, v.state, v.split, camera_to_input(v.camera, scene.similarity)) for v in scene.views]


def write_cameras(path: Path, cameras: Sequence[NamedCamera]) -> None:
    """RUN/cameras.json: OpenCV world-to-camera matrices and full intrinsics, input coordinates."""
    rows = [
        {"name": c.name, "state": c.state, "split": c.split, "width": c.camera.width, "height": c.camera.height}
        | {"K": c.camera.K.tolist(), "viewmat": c.camera.viewmat.tolist()}
        for c in cameras
    ]
    path.write_text(json.dumps({"convention": "opencv world-to-camera, input coordinates", "cameras": rows}) + "\n")


def read_cameras(path: Path) -> list[NamedCamera]:
    """Inverse of ``write_cameras``; an empty list where the file is not there. Raises UserError where it cannot be
    read."""
    if not path.is_file():
        return []
    try:
        return [_read_camera(row) for row in json.loads(path.read_text(encoding="utf-8"))["cameras"]]
    except (ValueError, KeyError, TypeError, RuntimeError, OverflowError, RecursionError) as err:
        why = f"{type(err).__name__}: {short(str(err))}"
        raise UserError(f"{path}: cannot be read ({why}); expected the cameras that p2gs fit wrote") from err


def _read_camera(row: dict) -> NamedCamera:
    viewmat, K = (torch.tensor(row[key], dtype=torch.float32) for key in ("viewmat", "K"))
    if viewmat.shape != (4, 4) or K.shape != (3, 3) or not (torch.isfinite(viewmat).all() and torch.isfinite(K).all()):
        raise ValueError("viewmat or K is no matrix of numbers")
    width, height = int(row["width"]), int(row["height"])
    if not (0 < width < 2**16 and 0 < height < 2**16 and row["state"] in (0, 1) and K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError(f"{width}x{height} pixels, state {short(row['state'])}")
    return NamedCamera(str(row["name"]), row["state"], str(row["split"]), Camera(viewmat, K, width, height))


def look_at(eye: Tensor, target: Tensor, up: Tensor, width: int, height: int, focal: float) -> Camera:
    """An OpenCV camera at ``eye`` [3] looking at ``target`` [3], ``up`` [3] upwards; focal in pixels, principal point
    in the middle."""
    z = torch.nn.functional.normalize(target - eye, dim=0)
    x = torch.linalg.cross(z, up)
    if x.norm() < 1e-6:  # straight up or down: any side will do
        x = torch.linalg.cross(z, up.roll(1))
    x = torch.nn.functional.normalize(x, dim=0)
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat = torch.eye(4, dtype=eye.dtype)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ eye
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K.float(), width, height)


def solid_points(obj: ArticulatedObject, min_opacity: float = 0.3) -> Tensor:
    """Indices of the Gaussians that can be seen at all, [M]; all of them if none is that opaque."""
    keep = (torch.sigmoid(obj.gaussians.opacity_logits) > min_opacity).nonzero()[:, 0]
    return keep if len(keep) else torch.arange(len(obj.gaussians))


def bounds(obj: ArticulatedObject, times: Sequence[float] = (0.0, 1.0)) -> Tensor:
    """Box of the solid Gaussians over the states, [2, 3], without the outermost 0.1 % (floaters)."""
    keep = solid_points(obj)
    points = torch.cat([pose(obj, t).means[keep] for t in times]).double()
    lo, hi = (torch.tensor(np.quantile(points.numpy(), q, axis=0)) for q in (0.001, 0.999))
    return torch.stack([lo, hi])


def orbit(
    obj: ArticulatedObject, count: int, elevation: float = 25.0, size: tuple[int, int] = (400, 400), up=(0.0, 0.0, 1.0)
) -> list[Camera]:
    """``count`` cameras on a ring around the object (turntable), far enough that all of it is in the picture."""
    lo, hi = bounds(obj)
    center, radius = (lo + hi) / 2, float((hi - lo).norm() / 2)
    up_vec = torch.tensor(up, dtype=torch.float64)
    side = torch.linalg.cross(up_vec, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    side = side if side.norm() > 0.1 else torch.linalg.cross(up_vec, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    front = torch.linalg.cross(side, up_vec)
    focal, e = 1.4 * min(size), math.radians(elevation)
    distance = 1.03 * radius / math.sin(math.atan(min(size) / 2 / focal))
    cameras = []
    for i in range(count):
        a = 2 * math.pi * i / count
        ray = math.cos(e) * (math.cos(a) * front + math.sin(a) * side) + math.sin(e) * up_vec
        cameras.append(look_at(center + distance * ray, center, up_vec, size[0], size[1], focal))
    return cameras


def point_labels(means: Tensor, part_ids: Tensor, camera: Camera, cell: int = 64) -> np.ndarray:
    """Part id seen in each cell of a coarse image, [h, w] int64, -1 where nothing is: nearest point wins."""
    cam = camera.scaled(cell, max(1, round(cell * camera.height / camera.width)))
    p = means.float() @ cam.viewmat[:3, :3].T + cam.viewmat[:3, 3]
    z = p[:, 2]
    uv = (p @ cam.K.T)[:, :2] / z[:, None].clamp_min(1e-6)
    u, v = uv[:, 0].floor().long(), uv[:, 1].floor().long()
    ok = (z > 1e-3) & (u >= 0) & (u < cam.width) & (v >= 0) & (v < cam.height)
    index, z, ids = (v[ok] * cam.width + u[ok]).numpy(), z[ok].numpy(), part_ids[ok].numpy()
    order = np.lexsort((z, index))
    first = np.unique(index[order], return_index=True)[1]
    out = np.full(cam.width * cam.height, -1, dtype=np.int64)
    out[index[order][first]] = ids[order][first]
    return out.reshape(cam.height, cam.width)


def view_score(obj: ArticulatedObject, start: Tensor, end: Tensor, camera: Camera) -> float:
    """How well a view tells the motion: for each moving part, what shows of it in both states and how much of the image
    it changes.

    start, end: means [M, 3] of the solid Gaussians in both states. Square roots, so that a view which shows every part
    a little beats one that shows one part well.
    """
    ids = obj.part_ids[solid_points(obj)]
    a, b = point_labels(start, ids, camera), point_labels(end, ids, camera)
    score = 0.0
    for part in obj.parts:
        if part.joint is not None:
            in_a, in_b = a == part.id, b == part.id
            score += math.sqrt(in_a.mean()) + math.sqrt(in_b.mean()) + math.sqrt((in_a ^ in_b).mean())
    border = np.concatenate([a[0], a[-1], a[:, 0], a[:, -1], b[0], b[-1], b[:, 0], b[:, -1]])
    return score * (1 - 0.7 * float((border >= 0).mean()))


def best_camera(obj: ArticulatedObject, cameras: Sequence[Camera]) -> int:
    """Index of the camera in which the moving parts and their motion are most visible. ``obj`` in the cameras'
    coordinates."""
    keep = solid_points(obj)
    start, end = pose(obj, 0.0).means[keep], pose(obj, 1.0).means[keep]
    return int(np.argmax([view_score(obj, start, end, c) for c in cameras]))
