"""What the runs of a bench scored, from their metrics.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Optional

from p2gs.bench.cell import read_record
from p2gs.bench.published import CHAMFER, SEEN
from p2gs.stage_times import stages_file, wall_seconds
from p2gs.types import UserError

JOINT = ("ang", "pos", "motion")


@dataclass
class Run:
    """One run. column: the object's name in the paper's tables.  values: by metric, None where there is nothing to
    score.
    failed: joints (or parts) not found, of how many.  floors: sampling floors of the Chamfer numbers.  error: of a run
    that failed.
    """

    object: str
    column: str
    setting: str
    seed: int
    status: str
    values: dict[str, Optional[float]] = field(default_factory=dict)
    failed: dict[str, tuple[int, int]] = field(default_factory=dict)
    floors: dict[str, float] = field(default_factory=dict)
    slides_only: bool = False
    error: Optional[str] = None


@dataclass
class Results:
    """All runs of a bench folder. tables: those the bench names.  about: version, commit and command it was run by, and
    the presets."""

    name: str
    runs: list[Run]
    tables: list[str]
    settings: list[str]
    columns: list[str]
    about: dict


def collect(folder: Path | str) -> Results:
    """Read a bench's result folder. Raises UserError where it is none."""
    folder = Path(folder)
    path = folder / "cells.json"
    if not path.is_file():
        raise UserError(f"{folder}: has no cells.json: it is no result folder of p2gs bench")
    about = json.loads(path.read_text())
    scenes = {s["name"]: s for s in about["scenes"]}
    runs = [read_run(folder / c["run"], c, scenes[c["object"]]) for c in about["cells"]]
    settings = list(dict.fromkeys(c["setting"] for c in about["cells"]))
    return Results(
        about["name"], runs, about["tables"], settings, [s["column"] for s in about["scenes"]], made_by(about)
    )


def made_by(about: dict) -> dict:
    """Version, commit and presets of a bench, as text by name."""
    presets = about.get("presets")
    return {**(about.get("p2gs") or {}), **({"preset": " + ".join(presets)} if presets else {})}


def read_run(folder: Path, cell: dict, scene: dict) -> Run:
    """One run's scores. A run that failed has lost all its joints, where their number is known."""
    run = Run(cell["object"], scene["column"], cell["setting"], cell["seed"], "todo")
    record = read_record(folder)
    run.status, run.error = record.get("status", "todo"), record.get("error")
    if not (folder / "metrics.json").is_file():
        if run.status == "failed" and scene["parts"]:
            lost = scene["parts"] - 1
            run.failed = {name: (lost, lost) for name in (*JOINT, "cd_movable")}
        return run
    run.status, run.error = "done", None
    read_metrics(run, json.loads((folder / "metrics.json").read_text()))
    stages = stages_file(folder)
    if stages.is_file():
        run.values["minutes"] = wall_seconds(json.loads(stages.read_text())) / 60
    return run


def read_metrics(run: Run, metrics: dict) -> None:
    """Take what the tables need out of a metrics.json (``scores.evaluate`` says what is in it)."""
    joints = metrics.get("joints")
    if joints:
        run.slides_only = all(j["type"] == "prismatic" for j in joints["joints"])
        run.values |= {"ang": joints["axis_angle_mean"], "motion": joints["motion_mean"]}
        run.values["pos"] = None if run.slides_only else joints["pos_mean_artgs"]
        total = len(joints["joints"])
        run.failed |= {name: (joints["failures"], total) for name in JOINT}
    chamfer = metrics.get("chamfer")
    if chamfer:
        for name in CHAMFER:
            entry = chamfer[name.removeprefix("cd_")]
            run.values[name] = entry["value"]
            if entry["floor"] is not None:
                run.floors[name] = entry["floor"]
        seen = metrics.get("chamfer_seen")  # runs of older builds have none
        if seen:
            run.values |= {name: seen[name.removeprefix("cd_").removesuffix("_seen")]["value"] for name in SEEN}
        run.failed["cd_movable"] = (chamfer["failures"], len(chamfer["parts"]))
    views = (metrics.get("views") or {}).get("mean") or {}
    run.values |= {
        name: views.get(key) for name, key in (("psnr", "psnr_white"), ("ssim", "ssim_white"), ("lpips", "lpips"))
    }
    if joints:
        run.values["extra"] = float(len(joints["extra"]))
    slots = metrics.get("slots")
    if slots and any(s["spare"] for s in slots):
        run.values["spare"] = 100 * sum(s["share"] for s in slots if s["spare"])
    penetration = metrics.get("penetration")
    if penetration:
        run.values["penetration"] = penetration["mean"]
