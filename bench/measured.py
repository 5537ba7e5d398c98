"""Tables of docs/measured.md, straight from finished runs and from what bench/surface_split.py found of them.

    python bench/measured.py RUN... [--split FILE]

Prints Markdown: a row a run (joints right, parts too many, errors of each, Chamfer distances, PSNR, seconds), and with
--split, the file of surface_split.py, a row a run of where the Chamfer distance comes from. Right is: type, axis within
1 degree, position x10 within 0.15, motion within 1 degree or 0.01. Names and order of rows are the runs'.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Iterable, Optional

import numpy as np

from p2gs.stage_times import stages_file, wall_seconds

AXIS, POSITION, TURN, SLIDE = 1.0, 0.15, 1.0, 0.01
TERMS = ("seen", "lost", "hidden", "false", "closing")


def is_right(joint: dict[str, Any]) -> bool:
    """Whether a joint of metrics.json is within the bounds."""
    e = joint["errors"]
    if e is None or e["axis_angle"] is None or e["motion"] is None:
        return False
    near = e["axis_position"] is None or e["axis_position"] <= POSITION
    return e["axis_angle"] <= AXIS and near and e["motion"] <= (TURN if joint["type"] == "revolute" else SLIDE)


def told(joint: dict[str, Any]) -> str:
    """Axis / position x10 / motion, bold where the joint is wrong."""
    e = joint["errors"]
    if e is None:
        return "**F**"
    place = "-" if e["axis_position"] is None else f"{e['axis_position']:.3f}"
    motion = f"{e['motion']:.2f}" if joint["type"] == "revolute" else f"{e['motion']:.3f}"
    text = f"{e['axis_angle']:.2f} / {place} / {motion}"
    return text if is_right(joint) else f"**{text}**"


def run_row(run: Path) -> list[str]:
    found = json.loads((run / "metrics.json").read_text())
    joints, chamfer = found["joints"]["joints"], found.get("chamfer") or {}
    right = f"{sum(map(is_right, joints))} of {len(joints)}"
    distances = " / ".join(number(mean(chamfer.get(k)), 1) for k in ("static", "movable", "whole"))
    views = (found.get("views") or {}).get("mean") or {}
    seconds = wall_seconds(json.loads(stages_file(run).read_text()))
    return [
        run.name,
        right if right.split()[0] == right.split()[2] else f"**{right}**",
        str(len(found["joints"]["extra"])),
        ", ".join(map(told, joints)),
        distances,
        number(views.get("psnr_white"), 1),
        number(seconds, 0),
    ]


def mean(value: Any) -> Optional[float]:
    """Of what metrics.json has for one kind of Chamfer distance: a number, or a dict or list of them."""
    if isinstance(value, dict):
        value = value.get("mean", value.get("value", list(value.values())))
    if isinstance(value, list):
        known = [m for m in map(mean, value) if m is not None]
        return float(np.mean(known)) if known else None
    return None if value is None else float(value)


def number(value: Optional[float], digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def split_rows(rows: Iterable[dict[str, Any]]) -> Iterable[list[str]]:
    """Of each run its static part, and the mean of the moving ones that were found."""
    for row in rows:
        found = [part for part in row["movable"] if part["terms"]]
        for kind, parts in (("static", [row["static"]]), ("movable", found)):
            if parts:
                terms = [np.mean([p["terms"][t] for p in parts]) for t in TERMS]
                rest = [np.mean([p[k] for p in parts]) for k in ("sum", "floor", "seen_alone")]
                yield [row["run"], kind, *(f"{v:.2f}" for v in (rest[0], *terms, *rest[1:]))]


def table(head: list[str], rows: Iterable[list[str]], right_aligned: set[str]) -> str:
    rule = ["---:" if h in right_aligned else "---" for h in head]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--split", type=Path)
    options = parser.parse_args()
    if options.runs:
        head = [
            "Object",
            "right",
            "too many",
            "parts, degrees or units",
            "CD static / movable / whole",
            "PSNR",
            "seconds",
        ]
        print(table(head, map(run_row, options.runs), {"right", "too many", "PSNR", "seconds"}))
    if options.split:
        rows = [json.loads(line) for line in options.split.read_text().splitlines()]
        names = [run.name for run in options.runs] or [row["run"] for row in rows]
        chosen = sorted((r for r in rows if r["run"] in names), key=lambda r: names.index(r["run"]))
        head = ["Object", "part", "CD", *TERMS, "floor", "seen alone"]
        print("\n" + table(head, split_rows(chosen), {"CD", *TERMS, "floor", "seen alone"}))


if __name__ == "__main__":
    main()
