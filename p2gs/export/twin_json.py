"""RUN/twin.json: the joints of the twin, in the input's coordinates and units. The layout is a contract; other programs read it."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from p2gs.export.frame import object_to_input, with_counts
from p2gs.export.splat_ply import read_splat_ply
from p2gs.types import ArticulatedObject, Joint, Part, UserError

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
    """The parts (joints in float64) and the canonical time. Raises UserError when the file is missing or of another kind."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is not there: '{path.parent}' is no finished run (p2gs fit writes it at the end)")
    try:
        data = json.loads(path.read_text())
    except ValueError as err:
        raise UserError(f"{path} is not readable JSON: {err}") from err
    if data.get("format") != FORMAT:
        raise UserError(f"{path} says format '{data.get('format')}', expected '{FORMAT}'")
    return [_read_part(p) for p in data["parts"]], float(data["canonical_time"])


def load_twin(run_dir: Path | str) -> ArticulatedObject:
    """The finished twin of a run, in input coordinates (identity similarity)."""
    run_dir = Path(run_dir)
    parts, canonical_time = read_twin_json(run_dir / "twin.json")
    if not (run_dir / CANONICAL).is_file():
        raise UserError(f"{run_dir / CANONICAL} is missing; run 'p2gs fit' again to write it")
    gaussians, part_ids = read_splat_ply(run_dir / CANONICAL)
    if part_ids is None:
        raise UserError(f"{run_dir / CANONICAL} has no part_id column, so its Gaussians belong to no part")
    return ArticulatedObject(gaussians, part_ids, parts, canonical_time)


def _part_dict(part: Part) -> dict:
    if part.joint is None:
        return {"id": part.id, "kind": "static", "gaussians": part.gaussians, "confidence": float(part.confidence)}
    joint = part.joint
    return {
        "id": part.id,
        "kind": "movable",
        "joint": {
            "type": joint.type,
            "axis": joint.axis.tolist(),
            "origin": joint.origin.tolist(),
            "motion": joint.motion,
            "limits": list(joint.limits),
            "transform": joint.transform.tolist(),
        },
        "gaussians": part.gaussians,
        "confidence": float(part.confidence),
    }


def _read_part(data: dict) -> Part:
    if data["kind"] == "static":
        return Part(int(data["id"]), None, int(data.get("gaussians", 0)), float(data.get("confidence", 1.0)))
    j = data["joint"]

    def tensor(value) -> torch.Tensor:
        return torch.tensor(value, dtype=torch.float64)

    limits = (float(j["limits"][0]), float(j["limits"][1]))
    joint = Joint(j["type"], tensor(j["axis"]), tensor(j["origin"]), float(j["motion"]), limits, tensor(j["transform"]))
    return Part(int(data["id"]), joint, int(data["gaussians"]), float(data["confidence"]))
