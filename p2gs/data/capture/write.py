"""The scene folder: undistorted RGBA images in the ArtGS layout, a COLMAP model of them, a ``transforms.json`` per
state."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from p2gs.data.capture.colmap_io import write_model
from p2gs.data.capture.model import Lens, Model
from p2gs.data.exposure import corrected
from p2gs.types import UserError

STATES = ("start", "end")


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


def write_scene(
    model: Model, photos: Path, masks: dict[str, np.ndarray], gains: dict[int, np.ndarray], out: Path
) -> dict[str, str]:
    """Write everything; returns photograph's name -> file below ``out``.

    model: in scene coordinates, photographs named as the copies in ``photos``.  masks: [H, W] uint8 by name; a
    photograph without one is left out.  gains: see ``gains``.
    """
    import cv2

    pinholes = {key: pinhole_of(lens) for key, lens in model.lenses.items()}
    files, frames, flat = {}, {s: [] for s in STATES}, {}
    for key, photo in sorted(model.photos.items(), key=lambda kv: kv[1].name):
        if photo.name not in masks:
            continue
        state = photo.name.split("/")[0]
        pinhole, lens = pinholes[photo.lens], model.lenses[photo.lens]
        image = cv2.imread(str(photos / photo.name))[..., ::-1]
        image = corrected(image, gains.get(key, np.zeros(3)))
        rgba = np.dstack(
            [
                cv2.remap(image, *pinhole.maps, cv2.INTER_LINEAR),
                cv2.remap(masks[photo.name], *pinhole.maps, cv2.INTER_LINEAR),
            ]
        )
        path = f"{state}/train/rgba/{len(frames[state]):04d}.png"
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(out / path), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 3]):
            raise UserError(f"{out / path}: cannot be written")
        files[photo.name] = path
        K = pinhole.K
        c2w = np.linalg.inv(photo.viewmat)
        c2w[:3, 1:3] *= -1
        frames[state].append(
            {
                "file_path": path,
                "transform_matrix": c2w.tolist(),
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2],
                "cy": K[1, 2],
                "w": lens.width,
                "h": lens.height,
            }
        )
        normal = lens.rays(photo.xy)
        flat[key] = replace(photo, name=path, xy=normal * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]])
    for state in STATES:
        stale = sorted((out / state / "train/rgba").glob("*.png"))[len(frames[state]) :]
        for path in stale:  # of an earlier run with more photographs
            path.unlink()
        (out / f"transforms_train_{state}.json").write_text(json.dumps({"frames": frames[state]}, indent=1))
        own = [{**f, "file_path": f["file_path"].removeprefix(f"{state}/")} for f in frames[state]]
        (out / state / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": own}, indent=1))
    lenses = {
        k: Lens(
            "PINHOLE",
            model.lenses[k].width,
            model.lenses[k].height,
            np.array([p.K[0, 0], p.K[1, 1], p.K[0, 2], p.K[1, 2]]),
        )
        for k, p in pinholes.items()
    }
    used = np.unique(np.concatenate([p.point for p in flat.values()]))
    keep = np.isin(model.ids, used)
    write_model(Model(lenses, flat, model.ids[keep], model.xyz[keep], model.rgb[keep]), out / "sparse/0")
    return files
