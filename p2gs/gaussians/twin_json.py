"""RUN/twin.json: the joints of the twin, in the input's coordinates and units. The layout is a contract; other programs
read it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch

from p2gs.gaussians.frame import object_to_input, with_counts
from p2gs.gaussians.splat_ply import read_splat_ply
from p2gs.types import ArticulatedObject, Joint, Part, UserError, short

FORMAT = "p2gs-twin/1"
CANONICAL = "splats/canonical.ply"


def twin_dict(obj: ArticulatedObject) -> dict:
    """What twin.json holds. Lengths are in input units, angles in degrees, 0 is the start state."""
    obj = object_to_input(obj)
    return {
        "format": FORMAT,
        "num_parts": len(obj.parts),
        "canonical_time": obj.canonical_time,
        "parts": [_part_dict(part) for part in with_counts(obj)],
    }


def write_twin_json(obj: ArticulatedObject, path: Path | str) -> None:
    """Write it whole or not at all, so that a reader never meets half a file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".tmp")
    part.write_text(json.dumps(twin_dict(obj), indent=1) + "\n")
    part.replace(path)


def read_twin_json(path: Path | str) -> tuple[list[Part], float]:
    """The parts (joints in float64) and the canonical time. Raises UserError when the file is missing or of another
    kind."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is not there: '{path.parent}' is no finished run (p2gs fit writes it at the end)")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as err:
        raise UserError(f"{path} is not readable JSON: {err}") from err
    kind = data.get("format") if isinstance(data, dict) else None
    if kind != FORMAT:
        raise UserError(f"{path} says format {short(kind)}, expected '{FORMAT}'")
    parts = []
    try:
        time = float(data["canonical_time"])
        for part in data["parts"]:
            parts.append(_read_part(part, len(parts)))
        if not parts or not 0 <= time <= 1:
            raise ValueError(f"{len(parts)} parts, canonical_time {time:g}")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, RuntimeError, AttributeError) as err:
        raise UserError(
            f"{path}: part {len(parts)} cannot be read ({type(err).__name__}: {short(str(err))}); expected a "
            "canonical_time in 0..1, "
            "the static part 0 and movable ones with a joint (type, axis, origin, motion, limits, transform)"
        ) from err
    return parts, time


def load_twin(run_dir: Path | str) -> ArticulatedObject:
    """The finished twin of a run, in input coordinates (identity similarity)."""
    run_dir = Path(run_dir)
    parts, canonical_time = read_twin_json(run_dir / "twin.json")
    if not (run_dir / CANONICAL).is_file():
        raise UserError(f"{run_dir / CANONICAL} is missing; run 'p2gs fit' again to write it")
    gaussians, part_ids = read_splat_ply(run_dir / CANONICAL)
    if part_ids is None:
        raise UserError(f"{run_dir / CANONICAL} has no part_id column, so its Gaussians belong to no part")
    if len(gaussians) == 0 or int(part_ids.min()) < 0 or int(part_ids.max()) >= len(parts):
        raise UserError(
            f"{run_dir / CANONICAL} does not fit twin.json: its part_id leave 0..{len(parts) - 1}, or it holds no "
            "Gaussian"
        )
    return ArticulatedObject(gaussians, part_ids, parts, canonical_time)


def _part_dict(part: Part) -> dict:
    measured = {"gaussians": part.gaussians, "confidence": float(part.confidence)}
    if part.joint is None:
        return {"id": part.id, "kind": "static", **measured}
    others = [_joint_dict(j) for j in part.alternatives]
    return {"id": part.id, "kind": "movable", "joint": _joint_dict(part.joint), **measured, "alternatives": others}


def _joint_dict(joint: Joint) -> dict:
    return {
        "type": joint.type,
        "axis": joint.axis.tolist(),
        "origin": joint.origin.tolist(),
        "motion": joint.motion,
        "limits": list(joint.limits),
        "transform": joint.transform.tolist(),
    }


def _read_part(data: dict, number: int) -> Part:
    """The part of that number. Raises one of the errors of an index, a conversion or a value for what is none."""
    if data["kind"] != ("movable" if number else "static") or int(data["id"]) != number:
        raise ValueError(f"kind {short(data['kind'])}, id {short(data['id'])}")
    count, confidence = int(data.get("gaussians", 0)), float(data.get("confidence", 1.0))
    if count < 0 or not math.isfinite(confidence):
        raise ValueError(f"gaussians {count}, confidence {confidence}")
    if number == 0:
        return Part(0, None, count, confidence)
    joint, *others = (_read_joint(j) for j in (data["joint"], *data.get("alternatives", [])))
    return Part(number, joint, count, confidence, tuple(others))


def _read_joint(j: dict) -> Joint:
    """The joint. Raises as ``_read_part``."""

    def tensor(key: str, *shape: int) -> torch.Tensor:
        value = torch.tensor(j[key], dtype=torch.float64)
        if tuple(value.shape) != shape or not bool(torch.isfinite(value).all()):
            raise ValueError(f"{key} {short(j[key])}")
        return value

    axis, transform = tensor("axis", 3), tensor("transform", 4, 4)
    low, high = float(j["limits"][0]), float(j["limits"][1])
    motion = float(j["motion"])
    if j["type"] not in ("revolute", "prismatic") or abs(float(axis.norm()) - 1) > 1e-3:
        raise ValueError(f"type {short(j['type'])}, axis {short(j['axis'])}")
    if not (math.isfinite(motion) and math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f"motion {motion}, limits {low}, {high}")
    return Joint(j["type"], axis, tensor("origin", 3), motion, (low, high), transform)
