"""The ArtGS layout: ``transforms_{train,test}_{start,end}.json`` and
``{start,end}/{train,test}/{rgba,depth}/NNNN.png``.

One field of view for all views (``camera_angle_x``, ``camera_angle_y``), principal point in the centre, camera-to-world
poses in OpenGL axes, depth (optional) as uint16 millimetres at the rgba path with ``rgba`` replaced by ``depth``.
Beyond ArtGS itself, ``fl_x, fl_y, cx, cy`` of the file or of a frame are honoured; ``w, h`` beside them are the image's
size. Format: ArtGS, scene/dataset_readers.py.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.frames import STATES, Frame, check_frames, check_K, opengl_pose, read_json, there
from p2gs.data.report import Report
from p2gs.types import short

SPLITS = ("train", "val", "test")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def detect(root: Path) -> bool:
    return any(root.glob("transforms_*_start.json")) or any(root.glob("transforms_*_end.json"))


def ground_truth_folder(root: Path) -> Optional[Path]:
    return root / "gt" if (root / "gt").is_dir() else None


def image_path(root: Path, file_path: str) -> Path:
    """Where a frame's RGBA image lies: ``.png`` added where there is no suffix, ``.jpg`` beside an ``rgba`` folder sent
    there."""
    path = root / file_path
    if path.suffix.lower() in (".jpg", ".jpeg") and (path.parent.parent / "rgba").is_dir():
        path = path.parent.parent / "rgba" / f"{path.stem}.png"
    return path if path.suffix or not path.name else path.with_name(path.name + ".png")


def _number(value) -> float:
    """The number, or NaN for what is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _size(both: dict) -> Optional[tuple[int, int]]:
    """Width and height that ``w, h`` tell, None where they tell none."""
    w, h = _number(both.get("w")), _number(both.get("h"))
    return (int(w), int(h)) if math.isfinite(w) and math.isfinite(h) else None


def depth_path(image: Path) -> Optional[Path]:
    """The depth beside an image (last ``rgba`` folder of its path replaced), or None where there is no such file."""
    if image.parent.name != "rgba":
        return None
    path = image.parent.parent / "depth" / f"{image.stem}.png"
    return path if there(path) else None


def _intrinsics(meta: dict, frame: dict, where: str, report: Report):
    """(K, fov) with one of them None, or None after an error."""
    both = {**meta, **frame}
    distorted = [k for k in DISTORTION if both.get(k)]
    if distorted:
        report.error(f"{where}: lens distortion ({', '.join(distorted)}) is not supported; undistort the images first")
        return None
    if both.get("fl_x"):
        fx = both["fl_x"]
        if "cx" not in both or "cy" not in both:
            report.error(f"{where}: has fl_x but no principal point cx, cy")
            return None
        K = check_K([[fx, 0, both["cx"]], [0, both.get("fl_y", fx), both["cy"]], [0, 0, 1]], where, report)
        return None if K is None else (K, None)
    angle_x, angle_y = both.get("camera_angle_x"), both.get("camera_angle_y")
    if angle_x is None:
        report.error(f"{where}: has neither camera_angle_x nor fl_x")
        return None
    for key, angle in (("camera_angle_x", angle_x), ("camera_angle_y", angle_y)):
        if angle is not None and not 0 < _number(angle) < np.pi:
            report.error(f"{where}: {key} is {short(angle)}, but it should be an angle in radians between 0 and pi")
            return None
    return None, (float(angle_x), None if angle_y is None else float(angle_y))


def index(root: Path, report: Report) -> list[Frame]:
    """Every frame of both states. Errors: missing transforms file, frame without image, bad pose or intrinsics."""
    frames: list[Frame] = []
    for state, state_name in enumerate(STATES):
        for split in SPLITS:
            camera_file = root / f"transforms_{split}_{state_name}.json"
            if split != "train" and not camera_file.is_file():
                continue
            meta = read_json(camera_file, report)
            if meta is None:
                continue
            if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
                report.error(f"{camera_file}: has no list 'frames'")
                continue
            shared = {k: v for k, v in meta.items() if k != "frames"}
            for i, entry in enumerate(meta["frames"]):
                where = f"{camera_file}: frame {i}"
                if not isinstance(entry, dict) or "file_path" not in entry or "transform_matrix" not in entry:
                    report.error(f"{where} needs 'file_path' and 'transform_matrix'")
                    continue
                if not isinstance(entry["file_path"], str) or not entry["file_path"]:
                    report.error(
                        f"{where}: file_path is {short(entry['file_path'])}, expected the path of an image below {root}"
                    )
                    continue
                image = image_path(root, entry["file_path"])
                viewmat = opengl_pose(entry["transform_matrix"], where, report)
                intrinsics = _intrinsics(shared, entry, where, report)
                depth = depth_path(image)
                if not report.may_read(image) or (depth is not None and not report.may_read(depth)):
                    continue
                if not there(image):
                    report.error(f"{image}: image is missing, but {camera_file.name} lists it as frame {i}")
                elif viewmat is not None and intrinsics is not None:
                    K, fov = intrinsics
                    if entry.get("time") not in (None, state):
                        report.note(
                            f"{where} has time {short(entry['time'])}, but it is read as state {state} by the file's "
                            "name"
                        )
                    size = None if K is None else _size({**shared, **entry})
                    frames.append(
                        Frame(image.stem, state, split, image, viewmat, K, fov, camera_file, size, depth=depth)
                    )
                if report.failed and intrinsics is None:
                    break  # the file's own intrinsics are wrong: once is enough
    with_depth = [f for f in frames if f.depth is not None]
    if with_depth and len(with_depth) < len(frames):
        lacking = next(f for f in frames if f.depth is None)
        report.note(f"{lacking.image}: has no depth, though {len(with_depth)} of {len(frames)} frames have")
    check_frames(frames, root, report)
    return frames
