"""Ground truth of a scene, for scoring only: joints from ``trans.json`` and part meshes. No training code imports this
module.

``trans_info`` is a dict (one joint) or a list: axis origin ``o`` and direction ``d``, type rotate (degrees) or
translate (scene units), range ``l`` (start) to ``r`` (end). The motion start -> end is (r - l) about or along the axis.
Format: PARIS, DTA, ArtGS.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import torch
from torch import Tensor

from p2gs.data.layouts import detect_format, layout_named
from p2gs.types import Joint, UserError, short


@dataclass(frozen=True)
class MeshPaths:
    """Meshes of one state; None or () where the file is not there. dynamic: in the order of the joints."""

    whole: Optional[Path]
    static: Optional[Path]
    dynamic: tuple[Path, ...]


@dataclass(frozen=True)
class GroundTruth:
    """folder: where it was read.  joints: input units, float64, in the file's order.  start, end: the states'
    meshes."""

    folder: Path
    joints: tuple[Joint, ...]
    start: MeshPaths
    end: MeshPaths

    def meshes(self, state: int) -> MeshPaths:
        return self.end if state else self.start


def rotation_about(axis: Tensor, origin: Tensor, degrees: float) -> Tensor:
    """[4, 4] rotation by degrees about the line (origin [3], unit axis [3]); Rodrigues' formula."""
    x, y, z = axis.tolist()
    K = axis.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    T = torch.eye(4, dtype=axis.dtype)
    T[:3, :3] += math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)
    T[:3, 3] = origin - T[:3, :3] @ origin
    return T


def parse_joint(entry: dict, where: str) -> Joint:
    """One ``trans_info`` entry. Raises UserError where a number is missing or the axis has no length."""
    try:
        kind = entry["type"]
        axis, origin = (torch.tensor(entry["axis"][k], dtype=torch.float64).reshape(3) for k in "do")
        span = entry[kind]
        motion = float(span["r"]) - float(span["l"])
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as err:
        raise UserError(
            f"{where} does not describe a joint (axis o and d, type rotate or translate, range l and r): {short(err)}"
        ) from err
    if not (torch.isfinite(axis).all() and torch.isfinite(origin).all() and math.isfinite(motion)):
        raise UserError(f"{where} holds numbers that are not finite, expected an axis o and d and a range l and r")
    if kind not in ("rotate", "translate") or not axis.norm() > 0:
        raise UserError(
            f"{where} needs the type rotate or translate and an axis of some length, but has {short(kind)} and "
            f"{axis.tolist()}"
        )
    axis = axis / axis.norm()
    if kind == "rotate":
        T = rotation_about(axis, origin, motion)
    else:
        T = torch.eye(4, dtype=torch.float64)
        T[:3, 3] = axis * motion
    limits = (min(0.0, motion), max(0.0, motion))
    return Joint("revolute" if kind == "rotate" else "prismatic", axis, origin, motion, limits, T)


def _meshes(folder: Path, state: str, joints: int) -> MeshPaths:
    def there(path: Path) -> Optional[Path]:
        return path if path.is_file() else None

    base = folder / state
    single = there(base / f"{state}_dynamic_rotate.ply")
    numbered = [base / f"{state}_dynamic_{i}_rotate.ply" for i in range(joints)]
    dynamic = (single,) if single and joints == 1 else tuple(p for p in numbered if p.is_file())
    return MeshPaths(
        there(base / f"{state}_rotate.ply"),
        there(base / f"{state}_static_rotate.ply"),
        dynamic if len(dynamic) == joints else (),
    )


def load_ground_truth(root, format: Optional[str] = None, source: Optional[str] = None) -> Optional[GroundTruth]:
    """The scene's ground truth in input coordinates and units, or None where the scene has none.

    format: layout name, found from the folder if not given.  source: PARIS only.  Raises UserError where trans.json is
    there but cannot be understood.
    """
    root = Path(root)
    format = format or detect_format(root)
    if format is None:
        return None
    layout = layout_named(format)
    folder = layout.ground_truth_folder(root, source) if format == "paris" else layout.ground_truth_folder(root)
    if folder is None or not (folder / "trans.json").is_file():
        return None
    path = folder / "trans.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))["trans_info"]
    except (ValueError, KeyError, TypeError, RecursionError, OSError) as err:
        raise UserError(f"{path}: has no readable 'trans_info' ({err})") from err
    entries = info if isinstance(info, list) else [info]
    joints = tuple(parse_joint(e, f"{path}: joint {i}") for i, e in enumerate(entries))
    return GroundTruth(folder, joints, *(_meshes(folder, s, len(joints)) for s in ("start", "end")))
