"""Scores of a captured scene's run in true metres: ``p2gs test RUN --truth DIR``.

The capture has a frame and a unit of its own. Its registered start cameras, matched to the true ones through
``capture.json``, give the similarity to the true world; what is left of the end cameras after it is the states'
misalignment.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Optional

import numpy as np
import torch

from p2gs.data.capture.model import similarity
from p2gs.data.capture.poses import c2w_of
from p2gs.data.frames import STATES
from p2gs.data.ground_truth import parse_joint
from p2gs.gaussians.twin_json import load_twin
from p2gs.metrics.modules import JointError
from p2gs.models.registered import REGISTRATION, read_registration
from p2gs.scores.evaluate import scene_folder
from p2gs.types import Joint, UserError, short


def _json(path: Path, key: str, kind: type | tuple[type, ...]):
    """What the file has under a key. Raises UserError where it is missing or has none of that kind."""
    if not path.is_file():
        raise UserError(f"{path}: is missing, so the capture cannot be scored")
    try:
        value = json.loads(path.read_text())[key]
        if not isinstance(value, kind):
            raise ValueError(f"it is {short(value)}")
        return value
    except (ValueError, KeyError, TypeError, RecursionError) as err:
        raise UserError(
            f"{path}: has no readable '{key}' ({short(str(err))}), so the capture cannot be scored"
        ) from err


def camera_pairs(scene: Path, truth: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """State -> (own, true) camera-to-world matrices [N, 4, 4] of the photographs that both know. OpenGL axes.

    Raises UserError, naming the file, where one cannot be read or two do not belong together.
    """
    true, facts = _json(truth / "cameras.json", "c2w", dict), scene / "capture.json"
    images = _json(facts, "images", list)
    try:
        source = {i["file"]: str(i["source"]) for i in images if i["file"]}
    except (KeyError, TypeError) as err:
        raise UserError(f"{facts}: an image has no 'file' and 'source'; expected what p2gs data capture wrote") from err
    return {s: _pairs_of(s, scene / f"transforms_train_{s}.json", source, facts, true, truth) for s in STATES}


def _pairs_of(
    state: str, path: Path, source: dict, facts: Path, true: dict, truth: Path
) -> tuple[np.ndarray, np.ndarray]:
    """A state's ``camera_pairs``. path: its transforms.  source: by file, of the capture.json ``facts``."""
    own, other = [], []
    for i, frame in enumerate(_json(path, "frames", list)):
        file = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(file, str) or file not in source:
            raise UserError(
                f"{facts}: has no image {short(file)}, which {path.name} has as frame {i}; expected both as the same "
                "p2gs data capture wrote them"
            )
        key = f"{state}/{Path(source[file]).stem}"
        if key in true:
            own.append(c2w_of(frame.get("transform_matrix"), f"{path}: frame {i}"))
            other.append(c2w_of(true[key], f"{truth / 'cameras.json'}: {key}"))
    if len(own) < 3:
        raise UserError(
            f"{truth / 'cameras.json'}: knows {len(own)} photographs of state '{state}', expected at least 3"
        )
    return np.array(own), np.array(other)


def rigid_between(own: np.ndarray, other: np.ndarray, with_scale: bool) -> np.ndarray:
    """[4, 4] least squares own -> other of camera centres."""
    return similarity(own[:, :3, 3], other[:, :3, 3], with_scale=with_scale)


def moved_joint(joint: Joint, T: np.ndarray) -> Joint:
    """A joint after the similarity T, [4, 4]."""
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    R = torch.tensor(T[:3, :3] / scale)
    origin = scale * (R @ joint.origin.double()) + torch.tensor(T[:3, 3])
    unit = 1.0 if joint.type == "revolute" else scale
    limits = (joint.limits[0] * unit, joint.limits[1] * unit)
    placed = torch.tensor(T)
    transform = placed @ joint.transform.double() @ torch.linalg.inv(placed)
    return Joint(joint.type, R @ joint.axis.double(), origin, joint.motion * unit, limits, transform)


def base_points(truth: Path, count: int = 2000) -> Optional[np.ndarray]:
    """[n, 3] points of the true base's surface, or None where its mesh is not there."""
    import trimesh

    for name in ("start_static_rotate.ply", "start_rotate.ply"):
        path = truth / "start" / name
        if path.is_file():
            mesh = trimesh.load(path, process=False, force="mesh")
            return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
    return None


def evaluate_capture(run: Path | str, truth: Path | str, root: Optional[Path | str] = None) -> dict:
    """Joints in metres and degrees, scale, the states' misalignment; also written to RUN/capture_metrics.json.

    truth: folder with cameras.json, trans.json and meshes. Raises UserError, naming the file, where one is missing.
    """
    run, truth = Path(run), Path(truth)
    truth = truth / "gt" if (truth / "gt").is_dir() else truth
    scene = Path(root) if root is not None else scene_folder(run)
    pairs = camera_pairs(scene, truth)
    T = rigid_between(*pairs["start"], with_scale=True)
    end_own, end_true = pairs["end"]
    end_own = read_registration(run / REGISTRATION)[0].transform.numpy() @ end_own  # where the run has put them
    placed = end_own.copy()
    placed[:, :3, 3] = end_own[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    D = rigid_between(placed, end_true, with_scale=False)
    points = base_points(truth)
    off = None if points is None else np.linalg.norm(points @ D[:3, :3].T + D[:3, 3] - points, axis=1)
    info = _json(truth / "trans.json", "trans_info", (dict, list))
    true = [
        parse_joint(e, f"{truth / 'trans.json'}: joint {i}")
        for i, e in enumerate(info if isinstance(info, list) else [info])
    ]
    found = [moved_joint(p.joint, T) for p in load_twin(run).parts if p.joint is not None]
    joints = JointError()
    joints.update(found, true)
    result = {
        "format": "p2gs-capture-metrics/1", "metres_per_unit": float(np.cbrt(np.linalg.det(T[:3, :3]))),
        "state_misalignment_mm": None if off is None else 1000 * float(off.mean()), "joints": joints.report.to_dict(),
    }  # fmt: skip
    (run / "capture_metrics.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


def capture_lines(result: dict) -> list[str]:
    """The result as lines for the terminal."""
    off, joints = result["state_misalignment_mm"], result["joints"]
    lines = [f"metres per unit: {result['metres_per_unit']:.5f}"]
    lines += [] if off is None else [f"states apart on the base: {off:.2f} mm"]
    for j in joints["joints"]:
        e = j["errors"]
        if e is None:
            lines.append(
                f"joint {j['gt'] + 1} ({j['type']}): F, "
                + ("not found" if j["pred"] is None else f"found as {j['pred_type']}")
            )
            continue
        place = "" if e["axis_position"] is None else f", axis {100 * e['axis_position']:.1f} mm off"
        motion = f"{e['motion']:.2f} deg" if j["type"] == "revolute" else f"{1000 * e['motion']:.1f} mm"
        lines.append(f"joint {j['gt'] + 1} ({j['type']}): axis {e['axis_angle']:.2f} deg{place}, motion {motion}")
    return [*lines, f"{joints['failures']} failed, {len(joints['extra'])} extra"]
