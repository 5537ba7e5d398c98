"""The PARIS layout: ``load/<source>/{start,end}/{train,val,test}/NNNN.png`` (RGBA) with
``camera_{train,val,test}.json``.

A camera file is a flat dict: ``"K"`` 3x3 and frame name -> 4x4 camera-to-world in OpenGL axes. The whole K is used,
principal point included (PARIS itself reads fx only and centres the rest). There is no depth. Format: PARIS,
datasets/blender_paris.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from p2gs.data.frames import STATES, Frame, check_frames, check_K, opengl_pose, read_json, there
from p2gs.data.report import Report

SPLITS = ("train", "val", "test")


def _is_base(folder: Path) -> bool:
    return any((folder / s / "camera_train.json").is_file() or (folder / s / "train").is_dir() for s in STATES)


def sources(root: Path) -> list[str]:
    """Source paths below ``root/load`` that hold a scene; ``""`` is ``load`` itself."""
    load = root / "load"
    if not load.is_dir():
        return []
    if _is_base(load):
        return [""]
    found = {p.parent for s in STATES for p in load.glob(f"**/{s}") if p.is_dir() and _is_base(p.parent)}
    return sorted(str(p.relative_to(load)) for p in found)


def detect(root: Path) -> bool:
    """Whether the folder looks like this layout (``load/...``, or already the inner folder with
    start/camera_train.json)."""
    return (root / "load").is_dir() or any((root / s / "camera_train.json").is_file() for s in STATES)


def find_base(root: Path, source: Optional[str], report: Report) -> Optional[Path]:
    """The folder that holds ``start`` and ``end``, or None after an error."""
    if source is not None:
        base = root / "load" / source
        if not base.is_dir():
            report.error(f"{base}: folder of the source '{source}' is missing")
            return None
        return base
    found = sources(root)
    if len(found) == 1:
        return root / "load" / found[0]
    if len(found) > 1:
        report.error(f"{root / 'load'}: holds {len(found)} scenes; name one by its source, for example '{found[0]}'")
        return None
    if _is_base(root):
        return root
    report.error(f"{root}: has no load/start and load/end folders of the PARIS layout")
    return None


def ground_truth_folder(root: Path, source: Optional[str] = None) -> Optional[Path]:
    """``data/<source>/textured_objs`` beside ``load/<source>``, or None where it is not."""
    if source is None:
        found = sources(root)
        source = found[0] if len(found) == 1 else None
    if source is not None:
        folder = root / "data" / source / "textured_objs"
        return folder if folder.is_dir() else None
    inner = root.resolve()
    for top in (inner, *inner.parents):  # root is the inner folder: .../load/<source>
        if top.name == "load":
            folder = top.parent / "data" / inner.relative_to(top) / "textured_objs"
            return folder if folder.is_dir() else None
    return None


def index(root: Path, report: Report, source: Optional[str] = None) -> list[Frame]:
    """Every frame of both states. Errors: missing camera file, frame without image, bad pose or K."""
    base = find_base(root, source, report)
    if base is None:
        return []
    frames: list[Frame] = []
    for state, state_name in enumerate(STATES):
        if not (base / state_name).is_dir():
            report.error(f"{base / state_name}: folder of the state '{state_name}' is missing")
            continue
        for split in SPLITS:
            folder, camera_file = base / state_name / split, base / state_name / f"camera_{split}.json"
            if split != "train" and not camera_file.is_file() and not folder.is_dir():
                continue  # val and test are optional
            cameras = read_json(camera_file, report)
            if cameras is None:
                continue
            if not isinstance(cameras, dict) or "K" not in cameras:
                report.error(f"{camera_file}: has no intrinsics under the key 'K'")
                continue
            K = check_K(cameras["K"], str(camera_file), report)
            if K is None:
                continue
            for name, matrix in cameras.items():
                if name == "K":
                    continue
                viewmat = opengl_pose(matrix, f"{camera_file}: frame '{name}'", report)
                image = folder / f"{name}.png"
                if not report.may_read(image):
                    continue
                if not there(image):
                    report.error(f"{image}: image is missing, but {camera_file.name} has a frame '{name}'")
                elif viewmat is not None:
                    frames.append(Frame(name, state, split, image, viewmat, K=K, K_source=camera_file))
            unposed = sorted(p.stem for p in folder.glob("*.png") if p.stem not in cameras) if folder.is_dir() else []
            if unposed:
                report.note(
                    f"{camera_file}: {len(unposed)} images have no camera frame and are left out, the first is "
                    f"{unposed[0]}.png"
                )
    check_frames(frames, root, report)
    return frames
