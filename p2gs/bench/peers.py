"""``p2gs bench peers``: another trainer's program against our single state, on the same photographs, in one run.

The program is the user's own (OpenSplat's CPU build; it is under the AGPL, and nothing of it is here): it is started as
a process on a nerfstudio folder that is written for it. Both get the same training views at the same size, the same
start points and the same steps; photographs are laid over the one background that it composites over itself, as ours
are over random ones. Both results are drawn by our rasterizer over white at the same test views.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Optional, Sequence

import numpy as np
import torch

from p2gs.data.views import TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.splat_ply import read_splat_ply
from p2gs.metrics.image import psnr
from p2gs.types import GaussianTensors, TwoStateScene, UserError

BACKGROUND = (0.6130, 0.0101, 0.3984)  # what OpenSplat composites over (nerfstudio's default); it has no option for it
HELD_OUT = 8  # every eighth training view is a test view where a scene has none, as Mip-NeRF 360's users do
SNAPSHOTS = 20  # of a training, at which its test PSNR is taken
POLL = 0.1  # seconds between two looks at the program's CPU time
LEVEL = 2.0  # dB between two rows of the table
WHITE = (1.0, 1.0, 1.0)


@dataclass
class Point:
    """A training after so many seconds (without what scoring takes): PSNR in dB over test views.

    seconds: wall time.  cpu: CPU time of the process with its start, which other programs on the machine disturb little
    (None where the system does not tell it of another process).
    """

    seconds: float
    cpu: Optional[float]
    step: int
    psnr: float
    gaussians: int


@dataclass
class Task:
    """One state: what both are given and scored by. views: images at the size of training."""

    scene: TwoStateScene
    state: int
    size: int
    train: TrainingViews
    test: TrainingViews


def make_task(root: str, state: int, words: Sequence[str]) -> tuple[Task, Any]:
    """The state's views, and the config of ``preset/cpu.yaml`` with the words laid on it. Raises UserError."""
    from dataclasses import replace

    from p2gs.config.run import load_config

    cfg = load_config(["preset/cpu.yaml"], ["--data.root", root, "--data.depth", "never", *words])
    scene = cfg.data.scene()
    shots = scene.select(state=state)
    if not any(v.split == "test" for v in shots):
        names = [v.name for v in shots if v.split == "train"][::HELD_OUT]
        scene = scene.with_views(replace(v, split="test") if v.name in names else v for v in scene.views)
    train, test = (scene.select(state=state, split=split) for split in ("train", "test"))
    if not train or not test:
        raise UserError(f"{root}: state {state} has {len(train)} training and {len(test)} test views; both are needed")
    size = max(cfg.phases["single_state"].config.levels)
    whole = TrainingViews(train, [size], crop=False), TrainingViews(test, [size], crop=False)
    return Task(scene, state, size, *whole), cfg


def score(g: GaussianTensors, test: TrainingViews) -> float:
    """Mean PSNR over white."""
    white, found = torch.tensor(WHITE), []
    for i in range(len(test)):
        shot = test.get(i, 0, white)
        with torch.no_grad():
            found.append(psnr(render_gaussians(g, shot.camera, white).colour.clamp(0, 1), shot.image))
    return sum(found) / len(found)


# -- ours -------------------------------------------------------------------------------------------------------------


def train_ours(task: Task, cfg, folder: Path) -> list[Point]:
    """Our single state, scored at ``SNAPSHOTS`` moments."""
    from p2gs.bench.bare import train_bare
    from p2gs.callbacks.base import Callback
    from p2gs.models.single_state import SingleStatePhase

    section, points = cfg.phases["single_state"], []
    build: Any = SingleStatePhase
    train = task.scene.select(state=task.state, split="train")
    began, began_cpu = time.perf_counter(), time.process_time()
    views = TrainingViews(train, section.config.levels)
    phase = build(section.config, section.losses, task.scene, task.state, views, seed=cfg.seed)
    every = max(phase.total_steps // SNAPSHOTS, 1)

    class Scores(Callback):
        changes_result = False
        scoring = scoring_cpu = 0.0

        def on_step(self, trainer, phase):
            if phase.step % every and phase.step != phase.total_steps:
                return
            at, cpu = time.perf_counter(), time.process_time()
            value = score(phase.splats.tensors().detach(), task.test)
            took = at - began - self.scoring, cpu - began_cpu - self.scoring_cpu
            points.append(Point(*took, phase.step, value, len(phase.splats)))
            self.scoring += time.perf_counter() - at
            self.scoring_cpu += time.process_time() - cpu

    deciding = [c for c in section.new_callbacks().values() if c.changes_result]
    for callback in deciding:
        callback.prepare(cfg, task.scene)
    train_bare(phase, [*deciding, Scores()], folder)
    return points


# -- theirs -----------------------------------------------------------------------------------------------------------


def write_project(task: Task, folder: Path, count: int, seed: int) -> None:
    """A nerfstudio folder: images over ``BACKGROUND``, ``transforms.json``, start points as ours.

    count: of start points.
    """
    import cv2

    from p2gs.models.initial import initial_points

    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(len(task.train)):
        shot = task.train.get(i, 0, torch.tensor(BACKGROUND))
        name, camera = f"images/{i:04d}.png", shot.camera
        if not cv2.imwrite(str(folder / name), (shot.image.numpy()[..., ::-1] * 255).round().astype(np.uint8)):
            raise UserError(f"{folder / name}: cannot be written")
        c2w = np.linalg.inv(camera.viewmat.double().numpy())
        c2w[:3, 1:3] *= -1  # OpenGL axes
        lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
        frames.append(
            {"file_path": name, "w": camera.width, "h": camera.height, **lens, "transform_matrix": c2w.tolist()}
        )
    about = {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
    generator = torch.Generator().manual_seed(seed)
    points, colours, _ = initial_points(task.scene, task.state, (count, count), "random", generator)
    rows = np.zeros(len(points), [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for i, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[axis], rows[colour] = points[:, i], (colours[:, i] * 255).round()
    properties = [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    (folder / "points.ply").write_bytes(("\n".join(head) + "\n").encode() + rows.tobytes())


def train_theirs(task: Task, cfg, program: str, folder: Path, threads: int, minutes: float, more: Sequence[str]):
    """Start the program, and score what it has saved by when it was saved. Raises UserError where it gives nothing."""
    options = cfg.phases["single_state"].config
    write_project(task, folder, options.initial_gaussians, cfg.seed)
    steps, out = options.steps, folder / "splat.ply"
    words = [program, str(folder), "-o", str(out), "-n", str(steps), "--cpu", "--keep-crs"]
    words += ["-s", str(max(steps // SNAPSHOTS, 1))]
    words += ["--resolution-schedule", str(max(steps // 10, 1)), *more]  # its default, 3,000 of 30,000, in these steps
    with open(folder / "program.log", "wb") as log:
        began = time.time()
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        child = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment)
        spent: list[tuple[float, float]] = []  # (moment, CPU seconds until then)
        try:
            while (code := child.poll()) is None and time.time() - began < minutes * 60:
                cpu = cpu_seconds(child.pid)
                spent += [] if cpu is None else [(time.time(), cpu)]
                time.sleep(POLL)
        finally:
            child.kill()
            child.wait()
    told = (folder / "program.log").read_text(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
    if code:
        raise UserError(f"{program}: ended with code {code}: {told[0]}")
    points = []
    for path in sorted(folder.glob("splat_*.ply"), key=lambda p: int(p.stem.rpartition("_")[2])):
        if code is None and time.time() - path.stat().st_mtime < 1:
            continue  # may have been stopped amid writing it
        g, _ = read_splat_ply(path)
        step, moment = int(path.stem.rpartition("_")[2]), path.stat().st_mtime
        cpu = float(np.interp(moment, [t for t, _ in spent], [c for _, c in spent])) if spent else None
        points.append(Point(moment - began, cpu, step, score(g, task.test), len(g)))
    if not points:
        raise UserError(f"{program}: saved nothing within {minutes:g} minutes ({told[0]})")
    return points


def cpu_seconds(pid: int) -> Optional[float]:
    """CPU time of a running process, by Linux's /proc; None elsewhere or where it has ended."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return None


# -- both -------------------------------------------------------------------------------------------------------------


def time_to(points: Sequence[Point], level: float) -> Optional[Point]:
    """When the test PSNR was first at the level; None where it never was."""
    return next((p for p in points if p.psnr >= level), None)


def markdown(ours: Sequence[Point], theirs: Sequence[Point], name: str) -> str:
    """Time to equal test PSNR, and where each ended."""
    best = [max(p.psnr for p in points) for points in (ours, theirs)]
    common = min(best)
    first = min(ours[0].psnr, theirs[0].psnr)  # lower levels say nothing: both have them at their first snapshot
    levels = np.arange(np.floor(common / LEVEL) * LEVEL, first, -LEVEL)[::-1]
    lines = [
        f"| test PSNR, dB | p2gs, s (CPU s) | {name}, s (CPU s) | times as long (in CPU time) |",
        "|---:|---:|---:|---:|",
    ]
    for level in [*levels, common]:
        a, b = time_to(ours, level), time_to(theirs, level)
        assert a is not None and b is not None
        both = [(a.seconds, b.seconds), (a.cpu, b.cpu)]
        times = ["-" if x is None or y is None else f"{y / max(x, 1e-9):.1f}" for x, y in both]
        cells = [f"{p.seconds:.1f} ({'-' if p.cpu is None else f'{p.cpu:.1f}'})" for p in (a, b)]
        lines.append(f"| {level:.2f} | {cells[0]} | {cells[1]} | {times[0]} ({times[1]}) |")
    for label, points, top in (("p2gs", ours, best[0]), (name, theirs, best[1])):
        last = points[-1]
        lines.append(
            f"\n{label}: {last.step} steps in {last.seconds:.1f} s, {last.psnr:.2f} dB (best {top:.2f}), "
            f"{last.gaussians:,} Gaussians."
        )
    return "\n".join(lines) + "\n"


def options() -> argparse.ArgumentParser:
    """The options of ``p2gs bench peers``; those of our fit come beside them."""
    parser = argparse.ArgumentParser(
        prog="p2gs bench peers",
        description="OpenSplat's CPU build, which you have built, against our single state: time to equal test PSNR.",
        epilog="Options of our fit may follow as --phases.single_state.steps N; of the program behind --.",
    )
    parser.add_argument("--program", default="opensplat", metavar="PATH", help="default: opensplat of the PATH")
    parser.add_argument("--root", required=True, metavar="SCENE", help="scene folder")
    parser.add_argument("--state", type=int, choices=(0, 1), default=0, help="default 0")
    parser.add_argument("--out", type=Path, default=Path("runs/bench/peers"), metavar="DIR", help="default %(default)s")
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="of each, one after the other (default 2)")
    parser.add_argument("--minutes", type=float, default=60.0, metavar="M", help="the program may take (default 60)")
    return parser


def main(words: list[str]) -> int:
    """``p2gs bench peers``: the arguments behind these words; returns the exit code."""
    more = words[words.index("--") + 1 :] if "--" in words else []
    args, rest = options().parse_known_args(words[: words.index("--")] if "--" in words else words)
    program = shutil.which(args.program)
    if program is None:
        raise UserError(
            f"bench peers: there is no program {args.program}; build OpenSplat for the CPU and name it with --program"
        )
    before = torch.get_num_threads()
    torch.set_num_threads(args.threads)
    try:
        task, cfg = make_task(args.root, args.state, rest)
        shutil.rmtree(args.out / "project", ignore_errors=True)
        args.out.mkdir(parents=True, exist_ok=True)
        ours = train_ours(task, cfg, args.out)
        theirs = train_theirs(task, cfg, program, args.out / "project", args.threads, args.minutes, more)
    finally:
        torch.set_num_threads(before)
    text = markdown(ours, theirs, Path(program).name)
    (args.out / "peers.md").write_text(text, encoding="utf-8")
    kept = {"ours": [asdict(p) for p in ours], "theirs": [asdict(p) for p in theirs]}
    (args.out / "peers.json").write_text(json.dumps(kept, indent=1))
    print(text)
    return 0
