"""The DTA (DigitalTwinArt) layout: one ``cam_K.txt``, ``init_keyframes.yml``, ``color_segmented``, ``mask``,
``depth_filtered``.

A frame id is ``<t>_<view>`` with t = 0 or 1; ``cam_in_ob`` is camera-to-world in OpenGL axes; depth is uint16
millimetres. All frames are training views. Format: DigitalTwinArt, main.py and preproc/gen_correspondence.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.frames import Frame, camera_file, check_frames, check_K, opengl_pose, there
from p2gs.data.report import Report
from p2gs.types import short


def detect(root: Path) -> bool:
    return (root / "init_keyframes.yml").is_file() or (root / "color_segmented").is_dir()


def ground_truth_folder(root: Path) -> Optional[Path]:
    return root / "gt" if (root / "gt").is_dir() else None


def _read_K(path: Path, report: Report) -> Optional[np.ndarray]:
    if not camera_file(path, report):
        return None
    try:
        values = np.array(path.read_text(encoding="utf-8").replace(",", " ").split(), dtype=np.float64)
    except (ValueError, OSError):
        values = np.empty(0)
    if values.size != 9:
        report.error(f"{path}: should hold the 9 numbers of K")
        return None
    return check_K(values.tolist(), str(path), report)


def _read_keyframes(path: Path, report: Report) -> Optional[dict]:
    import yaml

    if not camera_file(path, report):
        return None
    try:
        keyframes = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError, OverflowError, OSError) as err:
        # beside its own errors the loader lets those of a date, a number or a tag through that are none
        report.error(f"{path}: is not valid YAML ({(str(err) or type(err).__name__).splitlines()[0]})")
        return None
    if not isinstance(keyframes, dict) or not keyframes:
        report.error(f"{path}: has no frames")
        return None
    return keyframes


def index(root: Path, report: Report) -> list[Frame]:
    """Every frame of both states. Errors: missing camera file, image or mask, bad pose, K or frame name."""
    K = _read_K(root / "cam_K.txt", report)
    keyframes = _read_keyframes(root / "init_keyframes.yml", report)
    if K is None or keyframes is None:
        return []
    frames: list[Frame] = []
    has_depth = (root / "depth_filtered").is_dir()
    if not has_depth:
        report.note(f"{root / 'depth_filtered'}: folder is missing, so the scene is read without depth")
    for key, entry in keyframes.items():
        if not isinstance(key, (str, int)):
            report.error(f"{root / 'init_keyframes.yml'}: {short(key)} is no name of a frame")
            continue
        name, where = str(key).removeprefix("frame_"), f"{root / 'init_keyframes.yml'}: frame '{key}'"
        if not isinstance(entry, dict) or "cam_in_ob" not in entry:
            report.error(f"{where} has no camera pose 'cam_in_ob'")
            continue
        prefix = name.split("_")[0]
        time = entry.get("time", int(prefix) if prefix.isdecimal() and len(prefix) < 10 else None)
        if time not in (0, 1):
            report.error(f"{where} belongs to the time {short(time)}, but only the states 0 and 1 are supported")
            continue
        viewmat = opengl_pose(entry["cam_in_ob"], where, report)
        image, mask, depth = (root / folder / f"{name}.png" for folder in ("color_segmented", "mask", "depth_filtered"))
        needed = [image, mask, depth] if has_depth else [image, mask]
        if not all(report.may_read(p) for p in needed):
            continue
        missing = [p for p in needed if not there(p)]
        for path in missing:
            report.error(f"{path}: image is missing, but init_keyframes.yml has the frame '{key}'")
        if viewmat is not None and not missing:
            depth = depth if has_depth else None
            frames.append(
                Frame(
                    name, int(time), "train", image, viewmat, K=K, K_source=root / "cam_K.txt", mask=mask, depth=depth
                )
            )
    known = {str(key).removeprefix("frame_") for key in keyframes}
    unposed = sorted(p.stem for p in (root / "color_segmented").glob("*.png") if p.stem not in known)
    if unposed:
        report.note(
            f"{root / 'init_keyframes.yml'}: {len(unposed)} images have no frame and are left out, the first is "
            f"{unposed[0]}.png"
        )
    check_frames(frames, root, report)
    return frames
