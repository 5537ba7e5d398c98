"""The scene folder: undistorted RGBA images about the object in the ArtGS layout, a COLMAP model of them, a
``transforms.json`` per state."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from p2gs.data.box import mask_bounds
from p2gs.data.capture.colmap_io import write_model
from p2gs.data.capture.model import Lens, Model
from p2gs.data.exposure import corrected
from p2gs.data.frames import STATES
from p2gs.data.views import MARGIN
from p2gs.types import UserError


@dataclass(frozen=True)
class Pinhole:
    """A lens without its distortion. K: [3, 3].  maps: what cv2.remap wants."""

    K: np.ndarray
    maps: tuple


def pinhole_of(lens: Lens) -> Pinhole:
    """The pinhole camera of the same size whose image the lens fills."""
    import cv2

    size, centre = (lens.width, lens.height), np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    K0 = centre @ lens.K  # OpenCV's pixel centres are at 0
    if lens.fisheye:
        K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K0, lens.distortion, size, np.eye(3), balance=0.0)
        maps = cv2.fisheye.initUndistortRectifyMap(K0, lens.distortion, np.eye(3), K, size, cv2.CV_32FC1)
    else:
        K = cv2.getOptimalNewCameraMatrix(K0, lens.distortion, size, 0, size)[0]
        maps = cv2.initUndistortRectifyMap(K0, lens.distortion, None, K, size, cv2.CV_32FC1)
    return Pinhole(np.linalg.inv(centre) @ K, maps)


def window_of(mask: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner, [2] pixels each, the highest exclusive, of what is kept of a photograph: its principal
    point stays in the middle, and ``mask`` [H, W] is in with ``MARGIN`` beside it.

    Training scales pictures to a size. A kitchen around the fridge would leave the fridge half of it.
    """
    x0, y0, x1, y1 = mask_bounds(torch.from_numpy(mask))
    middle = K[:2, 2]
    half = np.maximum(middle - [x0, y0], [x1, y1] - middle)
    half = half + MARGIN * 2 * half.max()
    low = np.maximum(np.floor(middle - half), 0).astype(int)
    return low, np.minimum(np.ceil(middle + half), mask.shape[::-1]).astype(int)


def write_scene(
    model: Model, photos: Path, masks: dict[str, np.ndarray], gains: dict[int, np.ndarray], out: Path
) -> dict[str, str]:
    """Write everything; returns photograph's name -> file below ``out``.

    model: in scene coordinates, photographs named as the copies in ``photos``.  masks: [H, W] uint8 by name; a
    photograph without one is left out.  gains: see ``gains``.
    """
    import cv2

    pinholes = {key: pinhole_of(lens) for key, lens in model.lenses.items()}
    files, frames, flat, lenses = {}, {s: [] for s in STATES}, {}, {}
    for key, photo in sorted(model.photos.items(), key=lambda kv: kv[1].name):
        if photo.name not in masks:
            continue
        state = photo.name.split("/")[0]
        pinhole = pinholes[photo.lens]
        image = cv2.imread(str(photos / photo.name))[..., ::-1]
        image = corrected(image, gains.get(key, np.zeros(3)))
        mask = cv2.remap(masks[photo.name], *pinhole.maps, cv2.INTER_LINEAR)
        low, high = window_of(mask, pinhole.K)
        rgba = np.dstack([cv2.remap(image, *pinhole.maps, cv2.INTER_LINEAR), mask])[low[1] : high[1], low[0] : high[0]]
        path = f"{state}/train/rgba/{len(frames[state]):04d}.png"
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(out / path), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 3]):
            raise UserError(f"{out / path}: cannot be written")
        files[photo.name] = path
        focal, middle, (width, height) = pinhole.K[[0, 1], [0, 1]], pinhole.K[:2, 2] - low, (high - low).tolist()
        lenses[key] = Lens("PINHOLE", width, height, np.concatenate([focal, middle]))
        c2w = np.linalg.inv(photo.viewmat)
        c2w[:3, 1:3] *= -1
        intrinsics = dict(zip(("fl_x", "fl_y", "cx", "cy"), lenses[key].params.tolist(), strict=True))
        placed = {"file_path": path, "transform_matrix": c2w.tolist()}
        frames[state].append({**placed, **intrinsics, "w": width, "h": height})
        xy = model.lenses[photo.lens].rays(photo.xy) * focal + middle
        seen = ((xy >= 0) & (xy < [width, height])).all(1)
        flat[key] = replace(photo, name=path, lens=key, xy=xy[seen], point=photo.point[seen])
    for state in STATES:
        stale = sorted((out / state / "train/rgba").glob("*.png"))[len(frames[state]) :]
        for path in stale:  # of an earlier run with more photographs
            path.unlink()
        (out / f"transforms_train_{state}.json").write_text(json.dumps({"frames": frames[state]}, indent=1))
        own = [{**f, "file_path": f["file_path"].removeprefix(f"{state}/")} for f in frames[state]]
        (out / state / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": own}, indent=1))
    used = np.unique(np.concatenate([p.point for p in flat.values()]))
    keep = np.isin(model.ids, used)
    write_model(Model(lenses, flat, model.ids[keep], model.xyz[keep], model.rgb[keep]), out / "sparse/0")
    return files
