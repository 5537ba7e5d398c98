"""The oracle ladder of part discovery: which step loses which joint? A bench tool that reads ground truth, which no
phase may.

    python bench/ladder.py RUN... [--zoo DIR] [--out FILE]

RUN holds the single states of a scene (``p2gs fit ... --only single_state``), sharpened ones where it went on so far.
Discovery is run from them, anew, with this build's defaults, and its joints are held against the true ones: right is
type, axis <= 1 deg, position x10 <= 0.15, motion <= 1 deg or 0.01, or a listed tie. A line of JSON per run goes to
FILE. DIR: the zoo's lists of scenes and ties.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Callable

import numpy as np
import torch
import yaml
from scipy.optimize import linear_sum_assignment

from p2gs.config.run import load_config
from p2gs.data.ground_truth import load_ground_truth
from p2gs.gaussians import handover
from p2gs.metrics.joints import joint_errors, match_joints
from p2gs.metrics.modules import JointError
from p2gs.models.part_discovery import find_part_motions
from p2gs.models.registered import correct_scene, register_state, register_views
from p2gs.ops import se3
from p2gs.runtime.pipeline import Pipeline
from p2gs.visibility.evidence import gather_evidence

RIGHT = {"axis_angle": 1.0, "axis_position": 0.15, "turn": 1.0, "slide": 0.01}  # the field's bounds of a right joint


def to_input(T: torch.Tensor, similarity) -> torch.Tensor:
    """A motion [4, 4] in training units as one of the input's world."""
    c = torch.as_tensor(similarity.center, dtype=torch.float64)
    return se3.make(T[:3, :3], T[:3, 3] / similarity.scale + c - T[:3, :3] @ c)


def to_training(T: torch.Tensor, similarity) -> torch.Tensor:
    """A motion [4, 4] of the input's world in training units: what ``to_input`` takes back."""
    c = torch.as_tensor(similarity.center, dtype=torch.float64)
    return se3.make(T[:3, :3], (T[:3, :3] @ c + T[:3, 3] - c) * similarity.scale)


def joint_of(T: torch.Tensor, kind: str) -> SimpleNamespace:
    """A transform [4, 4] as the joint that the metrics read."""
    if kind == "prismatic":
        length = T[:3, 3].norm()
        return SimpleNamespace(
            type=kind, axis=T[:3, 3] / length.clamp_min(1e-9), origin=torch.zeros(3).double(), motion=float(length)
        )
    screw = se3.screw_parameters(T)
    return SimpleNamespace(type=kind, axis=screw.axis, origin=screw.origin, motion=math.degrees(float(screw.angle)))


def ties_of(name: str, zoo: Path) -> dict[str, list[float]]:
    """Other turns (degrees) that explain a scene's joints as well, by joint's index in its scenes.tsv line."""
    lines = (
        [line.split("\t") for line in (zoo / "ties.tsv").read_text().splitlines()]
        if (zoo / "ties.tsv").exists()
        else []
    )
    return {joint: [float(x) for x in other.split(",")] for scene, joint, _, other in lines if scene == name}


def is_right(gt, pred, others: list[float], within: dict[str, float] = RIGHT) -> bool:
    """Within bounds of the true joint, or of one with another turn that no picture tells from it."""
    if gt.type != pred.type:
        return False
    for motion in [gt.motion, *others]:
        e = joint_errors(pred, SimpleNamespace(type=gt.type, axis=gt.axis, origin=gt.origin, motion=motion))
        bound = within["turn"] if gt.type == "revolute" else within["slide"]
        if (
            e.axis_angle <= within["axis_angle"]
            and (e.axis_position or 0) <= within["axis_position"]
            and e.motion <= bound
        ):
            return True
    return False


def paired(found: list, truth: list, right: np.ndarray) -> dict[int, int]:
    """True joint -> found joint: as many as can be of those that are ``right`` [truth, found], the others as the
    metrics pair them. Two crosses of a tap may turn about one line, and what is a tie for one is then the other's turn
    to the metrics."""
    rows, columns = linear_sum_assignment(right, maximize=True)
    pairs = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if right[i, j]}
    rest = [
        [i for i in range(len(of)) if i not in used] for of, used in ((truth, pairs.keys()), (found, pairs.values()))
    ]
    left = match_joints([found[j] for j in rest[1]], [truth[i] for i in rest[0]])
    return pairs | {rest[0][i]: rest[1][j] for i, j in left.items()}


class Case:
    """A run, its states as discovery had them (registered) and its truth."""

    def __init__(self, run: Path, zoo: Path, preset: str = "configs/preset/cpu.yaml"):
        self.name = run.name
        root = yaml.safe_load((run / "config.yaml").read_text())["data"]["root"]  # all else is this build's default
        self.pipeline = Pipeline(
            load_config([preset], ["--data.root", root, "--data.depth", "never", "--run", str(run)])
        )
        states = [handover.load(run / "checkpoints" / f"single_state_{s}.pt")[0] for s in (0, 1)]
        registration = handover.load(run / "checkpoints" / "registration.pt")[0]
        self.pipeline.context.take(register_views(correct_scene(self.pipeline.scene, states), registration))
        self.states = [register_state(s, registration) for s in states]
        sharp = [run / "checkpoints" / f"sharpen_{s}.pt" for s in (0, 1)]
        self.sharpened = [handover.load(f)[0] for f in sharp] if all(f.exists() for f in sharp) else None
        self.scene, self.cfg = self.pipeline.scene, self.pipeline.cfg
        self.truth = load_ground_truth(self.cfg.data.root)
        names = next(
            (
                row.split("\t")[3]
                for row in (zoo / "scenes.tsv").read_text().splitlines()
                if row.split("\t")[2] == self.name
            ),
            "",
        )
        self.joints = [part.split("=")[0] for part in names.split(",")] if names else []
        self.ties = ties_of(self.name, zoo)

    @property
    def similarity(self):
        return self.scene.similarity

    def score(self, transforms: torch.Tensor, types: list[str], within: dict[str, float] = RIGHT) -> dict:
        """Each true joint's errors and whether it is right, by the bounds ``within``; how many parts are too many."""
        found = [
            joint_of(to_input(T.double(), self.similarity), kind) for T, kind in zip(transforms, types, strict=True)
        ]
        truth = self.truth.joints
        others = [self.ties.get(name, []) for name in self.joints] or [[] for _ in truth]
        right = [[is_right(gt, p, o, within) for p in found] for gt, o in zip(truth, others, strict=True)]
        right = np.array(right).reshape(len(truth), len(found))
        metric = JointError()
        metric.update(found, truth, paired(found, truth, right))
        report = metric.report
        rows = []
        for s in report.joints:
            e = s.errors
            errors = None
            if e is not None:
                position = None if e.axis_position is None else round(e.axis_position, 3)
                errors = [round(e.axis_angle, 3), position, round(e.motion, 4)]
            good = s.pred is not None and bool(right[s.gt, s.pred])
            rows.append({"joint": s.gt, "type": s.type, "pred": s.pred, "right": good, "errors": errors})
        return {"right": sum(r["right"] for r in rows), "of": len(rows), "extra": len(report.extra), "joints": rows}

    def evidence(self) -> list:
        """What discovery looks at of both states."""
        config = self.cfg.phases["discovery"].config
        options = (config.evidence_size, config.min_opacity, self.cfg.rasterizer, self.pipeline.device)
        views = [self.scene.select(state=s.state, split="train") for s in self.states]
        return [gather_evidence(s.gaussians, v, *options) for s, v in zip(self.states, views, strict=True)]

    def discover(self, report=None):
        """Discovery as a run does it. Returns PartMotions and seconds."""
        clock = time.perf_counter()
        motions = find_part_motions(
            self.states,
            self.scene,
            self.pipeline.views,
            self.cfg.num_parts,
            self.cfg.phases["discovery"].config,
            sharpened=self.sharpened,
            seed=self.cfg.seed,
            backend=self.cfg.rasterizer,
            device=self.pipeline.device,
            report=report,
        )
        return motions, time.perf_counter() - clock


def runs_parser(about: str) -> argparse.ArgumentParser:
    """Options of the benches that look at runs: RUN..., --zoo, --out, --threads."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--zoo", type=Path, default=Path("../shared/zoo"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    return parser


def of_found(motions: list) -> tuple[torch.Tensor, list[str]]:
    """Transforms [K, 4, 4] and types of an explanation's motions."""
    return torch.stack([torch.as_tensor(m.transform).double() for m in motions]), [m.type for m in motions]


def write_rows(
    args: argparse.Namespace, row_of: Callable[[Case], dict], told: Callable[[dict], str] = json.dumps
) -> None:
    """A line of JSON per run, printed as ``told`` says and, where asked for, written."""
    torch.set_num_threads(args.threads)
    for run in args.runs:
        write_row(row_of(Case(run, args.zoo)), args.out, told)


def write_row(row: dict, out: Path | None, told: Callable[[dict], str] = json.dumps) -> None:
    """The row printed as ``told`` says and, as a line of JSON, added to the file ``out``, if any."""
    print(told(row), flush=True)
    if out:
        with out.open("a") as f:
            f.write(json.dumps(row) + "\n")


def rungs(case: Case) -> dict:
    """A run's line."""
    motions, seconds = case.discover()
    row = {"name": case.name, "seconds": round(seconds, 1), **case.score(motions.transforms, motions.types)}
    row["found"] = [[t, round(float(c), 3)] for t, c in zip(motions.types, motions.confidence, strict=True)]
    return row


def in_words(row: dict) -> str:
    """The line as it is printed."""
    told = f"{row['name']}: {row['right']} of {row['of']} right, {row['extra']} too many, {row['seconds']} s"
    return f"{told} {row['joints']} {row['found']}"


def main() -> None:
    write_rows(runs_parser(__doc__.splitlines()[0]).parse_args(), rungs, in_words)


if __name__ == "__main__":
    main()
