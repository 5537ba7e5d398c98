"""``python -m p2gs.bench.basin BENCH_DIR``: up to which opening each setting of a bench like ``bench/basin.yaml`` finds
the joint.

Scenes are one object at several openings, named NAME_<degrees>. A run succeeds where every joint is found with its
type, and axis and motion are within a degree. The basin of a setting is the largest opening that two of three of its
seeds solve; what a single seed solves beyond it is told beside. Writes basin.md, basin.csv and, with matplotlib,
basin.png into BENCH_DIR/tables.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from p2gs.types import UserError

WITHIN = 1.0  # degrees of axis and of motion: ten times what a found joint has, a tenth of what a missed one has
SOLVED, SEEDS = 2 / 3, 2  # share of the seeds, and how many it takes at least


@dataclass(frozen=True)
class Outcome:
    """One run. axis, motion: errors in degrees, None where the joint was not found or has the wrong type."""

    setting: str
    opening: float
    seed: int
    axis: Optional[float]
    motion: Optional[float]

    @property
    def success(self) -> bool:
        return self.axis is not None and self.motion is not None and max(self.axis, self.motion) <= WITHIN


def outcomes(folder: Path | str) -> list[Outcome]:
    """Every finished run of a bench folder. Raises UserError where it is none, or a scene's name does not end in its
    opening."""
    folder = Path(folder)
    if not (folder / "cells.json").is_file():
        raise UserError(f"{folder}: has no cells.json: it is no result folder of p2gs bench")
    found = []
    for path in sorted(folder.glob("runs/*/*/seed*/metrics.json")):
        setting, scene, seed = path.parts[-4:-1]
        opening = re.search(r"_(\d+(?:\.\d+)?)$", scene)
        if opening is None:
            raise UserError(
                f"{path.parent}: the scene's name '{scene}' does not end in its opening; expected NAME_<degrees>"
            )
        joints = json.loads(path.read_text())["joints"]["joints"]
        errors = [j["errors"] for j in joints]
        lost = not errors or any(e is None for e in errors)
        worst = [None, None] if lost else [max(e[k] for e in errors) for k in ("axis_angle", "motion")]
        found.append(Outcome(setting, float(opening.group(1)), int(seed.removeprefix("seed")), *worst))
    if not found:
        raise UserError(f"{folder}: no run is finished")
    return found


def basin(runs: list[Outcome], seeds: int = SEEDS) -> Optional[float]:
    """The largest opening of one setting that two thirds of its seeds, and at least ``seeds`` of them, solve; None
    where it solves none."""
    shares = {o: share(runs, o) for o in {r.opening for r in runs}}
    solved = [o for o, (won, of) in shares.items() if won >= max(SOLVED * of, seeds)]
    return max(solved, default=None)


def told(runs: list[Outcome]) -> str:
    """The basin of one setting in words: ``none``, ``45 deg``, ``45 deg (60 by one seed)``."""
    sure, single = basin(runs), basin(runs, 1)
    words = "none" if sure is None else f"{sure:g} deg"
    return words if single == sure else f"{words} ({single:g} by one seed)"


def share(runs: list[Outcome], opening: float) -> tuple[int, int]:
    """(successes, runs) at an opening."""
    here = [r for r in runs if r.opening == opening]
    return sum(r.success for r in here), len(here)


def markdown(found: list[Outcome]) -> str:
    """Settings down, openings across: successes of how many runs; the basin last."""
    openings = sorted({r.opening for r in found})
    lines = [
        "| Start | " + " | ".join(f"{o:g} deg" for o in openings) + " | basin |",
        "|---|" + "---:|" * (len(openings) + 1),
    ]
    for setting in dict.fromkeys(r.setting for r in found):
        runs = [r for r in found if r.setting == setting]
        cells = [f"{a} of {n}" if n else "" for a, n in (share(runs, o) for o in openings)]
        lines.append(f"| {setting} | " + " | ".join(cells) + f" | {told(runs)} |")
    return "\n".join(lines) + "\n"


def draw(found: list[Outcome], path: Path) -> bool:
    """Largest of axis and motion error by opening, a line a setting through its seeds' medians; False without
    matplotlib."""
    from p2gs.bench.plots import lines

    series = {}
    for setting in dict.fromkeys(r.setting for r in found):
        runs = [r for r in found if r.setting == setting]
        points = {}
        for o in sorted({r.opening for r in runs}):
            errors = sorted(
                180.0 if r.axis is None or r.motion is None else max(r.axis, r.motion) for r in runs if r.opening == o
            )
            points[o] = errors[len(errors) // 2]
        series[setting] = points
    return lines(path, series, "opening, degrees", "axis or motion error, degrees (median of seeds)", WITHIN)


def main(words: list[str]) -> int:
    """Write the files; prints them."""
    if len(words) != 1:
        print("usage: python -m p2gs.bench.basin BENCH_DIR", file=sys.stderr)
        return 2
    try:
        found = outcomes(words[0])
    except UserError as err:
        print(f"error: {err}", file=sys.stderr)
        return 1
    target = Path(words[0]) / "tables"
    target.mkdir(parents=True, exist_ok=True)
    (target / "basin.md").write_text(markdown(found), encoding="utf-8")
    with open(target / "basin.csv", "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["setting", "opening", "seed", "axis", "motion", "success"])
        out.writerows([r.setting, r.opening, r.seed, r.axis, r.motion, int(r.success)] for r in found)
    drawn = draw(found, target / "basin.png")
    print(*(target / name for name in ("basin.md", "basin.csv", *(["basin.png"] if drawn else []))), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
