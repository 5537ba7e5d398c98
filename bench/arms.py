"""What the articulation phase buys: arms of configs/bench/main_ablation.yaml that share all stages up to fusion.

    python bench/arms.py OUT [RUN|SCENE...] [--objects NAME...] [--threads N] [--zoo DIR]

RUN is a finished run of the default preset: its stages up to fusion are copied to OUT. Of a SCENE folder the first arm
makes them. Articulation, the last stage and the scores are made in every arm by `p2gs bench`, which leaves finished
arms alone, so that a call that was cut off goes on where it was. Prints Markdown of every object in OUT whose arms are
all finished: axis error after discovery, after the articulation phase and at the end; then what else the end scores.
Means are of joints that were found with the right type; how many those are is told. Ground truth is read for the scores
alone.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Optional

import numpy as np
import torch
import yaml
from ladder import Case, joint_of, to_input
from measured import is_right, mean, number, table

from p2gs.gaussians import handover
from p2gs.metrics.modules import JointError

ARMS = {
    "full": "all on (the default)",
    "no_art": "L_art off (no_art)",
    "no_part_loss": "L_part off (no_part_loss)",
    "no_articulation": "phase off (no_articulation)",
}
LATE = ("articulation", "finish")  # stages that every arm makes itself


@dataclass
class Arm:
    """One arm of one object. axis: mean error in degrees after discovery, after the articulation phase, at the end.
    joints: (found with the right type, right within the bounds, true ones) at the end.  relabelled: share of the
    Gaussians whose part the phase changed."""

    axis: tuple[Optional[float], Optional[float], Optional[float]]
    joints: tuple[int, int, int]
    relabelled: float
    turn: Optional[float]
    slide: Optional[float]
    penetration: float
    psnr: float
    movable: Optional[float]


def folder(out: Path, arm: str, name: str) -> Path:
    return out / "runs" / arm / name / "seed0"


def hand_over(run: Path, out: Path) -> None:
    """The run's stages up to fusion, once, to where the first arm looks for them."""
    target = folder(out, "full", run.name)
    if (target / "checkpoints").exists():
        return
    part = target / "checkpoints.part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(run / "checkpoints", part)
    for stage in LATE:
        for path in part.glob(f"{stage}*"):
            path.unlink()
    part.rename(target / "checkpoints")


def run_arms(given: Path, out: Path, threads: int) -> int:
    """The arms of one object, a run's or a scene's; the exit code of p2gs bench."""
    root = str(given)
    if (given / "config.yaml").is_file():
        hand_over(given, out)
        root = yaml.safe_load((given / "config.yaml").read_text())["data"]["root"]
    words = ["bench", "-c", "bench/main_ablation.yaml", "--root", root, "--objects", given.name, "--out", str(out)]
    words += ["--settings", *ARMS, "--seeds", "0", "--threads", str(threads)]
    words += ["--data.depth", "never", "--phases.finish.exports", "[]"]
    return subprocess.run([sys.executable, "-m", "p2gs", *words]).returncode


def axis_error(case: Case, transforms: torch.Tensor, types: list[str]) -> Optional[float]:
    """Mean axis error of the joints that a stage found with the right type."""
    metric = JointError()
    found: list[SimpleNamespace] = [
        joint_of(to_input(T.double(), case.similarity), kind) for T, kind in zip(transforms, types, strict=True)
    ]
    assert case.truth is not None  # p2gs test has scored its joints
    metric.update(found, case.truth.joints)
    return metric.report.axis_angle_mean


def stage(run: Path, name: str) -> Any:
    return handover.load(run / "checkpoints" / f"{name}.pt")[0]


def read_arm(run: Path, case: Case) -> Arm:
    """What a finished arm's stages and scores say."""
    scores = json.loads((run / "metrics.json").read_text())
    joints = scores["joints"]
    found, learned = stage(run, "discovery"), stage(run, "articulation")
    before = stage(run, "canonical_fusion").labels
    return Arm(
        axis=(
            axis_error(case, found.transforms, found.types),
            axis_error(case, learned.transforms, learned.types),
            joints["axis_angle_mean"],
        ),
        joints=(
            sum(j["errors"] is not None for j in joints["joints"]),
            sum(map(is_right, joints["joints"])),
            len(joints["joints"]),
        ),
        relabelled=float((learned.part_ids != before).double().mean()),
        turn=joints["motion_mean_revolute"],
        slide=joints["motion_mean_prismatic"],
        penetration=scores["penetration"]["mean"],
        psnr=scores["views"]["mean"]["psnr_white"],
        movable=mean(scores["chamfer"]["movable"]),
    )


def finished(out: Path) -> list[str]:
    """Objects of which every arm is finished, in the order of their runs."""
    done = [p.parent for p in (out / "runs" / "full").glob("*/seed0/metrics.json")]
    done.sort(key=lambda p: (p / "metrics.json").stat().st_mtime)
    names = [p.parent.name for p in done]
    return [n for n in names if all((folder(out, arm, n) / "metrics.json").is_file() for arm in ARMS)]


def average(values: list[Optional[float]]) -> Optional[float]:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def axis_rows(arms: dict[str, dict[str, Arm]], names: list[str]) -> list[list[str]]:
    """After discovery; then each arm's error after the phase -> at the end. The last column is the objects' mean."""
    start = [arms["full"][n].axis[0] for n in names]
    rows = [["*after discovery*", *(f"*{number(v, 3)}*" for v in [*start, average(start)])]]
    for arm, label in ARMS.items():
        errors = [[arms[arm][n].axis[k] for n in names] for k in (1, 2)]
        pairs = zip(*(values + [average(values)] for values in errors), strict=True)
        rows.append([label, *(f"{number(a, 3)} -> {number(b, 3)}" for a, b in pairs)])
    return rows


def end_rows(arms: dict[str, dict[str, Arm]], names: list[str]) -> list[list[str]]:
    """Joints, relabelled Gaussians and scores at the end, each the objects' mean, and penetration by object."""
    rows = []
    for arm, label in ARMS.items():
        here = [arms[arm][n] for n in names]
        sums = [sum(a.joints[k] for a in here) for k in range(3)]
        rows.append(
            [
                label,
                *(f"{100 * a.penetration:.2f}" for a in here),
                number(average([100 * a.penetration for a in here]), 2),
                f"{sums[0]} / {sums[1]} of {sums[2]}",
                number(average([100 * a.relabelled for a in here]), 1),
                number(average([a.turn for a in here]), 3),
                number(average([a.slide for a in here]), 4),
                number(average([a.movable for a in here]), 2),
                number(average([a.psnr for a in here]), 2),
            ]
        )
    return rows


def tables(out: Path, zoo: Path, chosen: Optional[list[str]]) -> str:
    """Of the chosen objects (None: all) that have a joint in some arm; those that have none are named below."""
    names = [n for n in finished(out) if chosen is None or n in chosen]
    if not names:
        return f"{out}: no object has all of its arms"
    cases = {n: Case(folder(out, "full", n), zoo) for n in names}
    arms = {arm: {n: read_arm(folder(out, arm, n), cases[n]) for n in names} for arm in ARMS}
    without = [n for n in names if all(arms[arm][n].joints[0] == 0 for arm in ARMS)]
    names = [n for n in names if n not in without]
    axis = ["Arm", *names, "mean"]
    end = ["Arm", *names, "mean", "found / right", "relabelled, %", "turn", "slide", "CD movable", "PSNR"]
    made = [
        table(head, rows, set(head) - {"Arm"})
        for head, rows in ((axis, axis_rows(arms, names)), (end, end_rows(arms, names)))
    ]
    return "\n\n".join([*made, *([f"No joint in any arm: {', '.join(without)}"] if without else [])])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("given", type=Path, nargs="*", metavar="RUN|SCENE")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--objects", nargs="+", help="of OUT, to be printed (default: all)")
    parser.add_argument("--zoo", type=Path, default=Path("../shared/zoo"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    failed = [given.name for given in options.given if run_arms(given, options.out, options.threads) != 0]
    print(tables(options.out, options.zoo, options.objects))
    for name in failed:
        print(f"error: p2gs bench failed on {name}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
