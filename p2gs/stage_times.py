"""RUN/logs/stages.json: what each stage of a run took."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Optional


def stages_file(run_dir: Path | str) -> Path:
    return Path(run_dir) / "logs" / "stages.json"


def note_stage(run_dir: Path | str, name: str, seconds: float, peak_memory: int, beside: Optional[str] = None) -> None:
    """Write a stage's seconds (of a resumed one the last sitting's) and peak memory (MiB). beside: the stage that ran
    at the same time."""
    path = stages_file(run_dir)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        times = json.loads(path.read_text())
    # a run that was killed while an older version wrote it; times are told, nothing hangs on them
    except (FileNotFoundError, ValueError):
        times = {}
    times[name] = {"seconds": round(seconds, 2), "peak_memory_mib": peak_memory} | (
        {"beside": beside} if beside else {}
    )
    part = path.with_suffix(".part")
    part.write_text(json.dumps(times, indent=1))
    os.replace(part, path)


def wall_seconds(stages: dict[str, dict]) -> float:
    """What the stages took together: one that ran beside another counts by how much longer it took."""
    beside = {name: stages.get(s.get("beside", ""), {"seconds": 0.0}) for name, s in stages.items()}
    return sum(max(s["seconds"] - beside[name]["seconds"], 0.0) for name, s in stages.items())
