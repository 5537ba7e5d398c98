"""``p2gs bench scaling``: how time and memory of one state grow with pixels, views and Gaussians.

Training steps of ``preset/cpu.yaml``'s single-state phase (its losses, its optimiser, no densification) on the scene of
``bench.scene``, whose photographs are drawn from 20,000 Gaussians; beside them what is done once for every photograph:
preparing it for training, and rendering its depth for part discovery. Every measurement is a process of its own, so
that its peak memory is its own. One thread is timed in CPU time, several in wall time.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Mapping, Sequence

from p2gs.types import UserError

BASE = {"px": 400, "views": 64, "gaussians": 20_000}  # what stays while one of them grows: the five scenes' own
GROWTH = {"px": (100, 400, 800), "views": (16, 64, 200), "gaussians": (20_000, 100_000, 400_000)}
QUICK = {"px": (50, 100, 200), "views": (4, 8, 16), "gaussians": (1_000, 2_000, 4_000)}
QUICK_BASE = {"px": 100, "views": 8, "gaussians": 2_000}
PHOTOGRAPHED = 20_000  # Gaussians that the photographs are drawn from
WARM = 5  # steps that are not counted: caches and the allocator fill
FIGURES = {
    "step_ms": "ms a step",
    "prepare_s": "s to prepare the views",
    "depth_s": "s for depth of all views",
    "memory_mib": "MiB",
}


@dataclass
class Measured:
    """step_ms: median of the steps.  prepare_s, depth_s: all views.  memory_mib: at most, less what the program has
    after its imports."""

    px: int
    views: int
    gaussians: int
    threads: int
    step_ms: float
    prepare_s: float
    depth_s: float
    memory_mib: float


def plan(sizes: Mapping[str, Sequence[int]], base: dict[str, int]) -> list[dict[str, int]]:
    """Every setting once: each quantity over its sizes, the others at the base."""
    settings = [{**base, name: size} for name, each in sizes.items() for size in each]
    return [s for i, s in enumerate(settings) if s not in settings[:i]]


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of log(value) over log(size), by least squares: 1 grows in proportion."""
    x, y = [math.log(s) for s in sizes], [math.log(max(v, 1e-9)) for v in values]
    mean_x, mean_y = statistics.fmean(x), statistics.fmean(y)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)


def exponents(rows: Sequence[Measured], sizes: Mapping[str, Sequence[int]], base: dict[str, int]) -> dict[str, dict]:
    """By quantity: by figure, the exponents over all its sizes (``all``) and from the middle one to the largest
    (``last``). Of pixels, their number is the size, not the edge."""
    out: dict[str, dict] = {}
    for name, each in sizes.items():
        counts, found = series(rows, name, each, base)
        out[name] = {}
        for figure in FIGURES:
            values = [getattr(r, figure) for r in found]
            out[name][figure] = {"all": exponent(counts, values), "last": exponent(counts[-2:], values[-2:])}
    return out


def series(
    rows: Sequence[Measured], name: str, each: Sequence[int], base: dict[str, int]
) -> tuple[list[int], list[Measured]]:
    """How much there is of a quantity over its sizes, of pixels their number, and what was measured then."""
    settings = [{**base, name: size} for size in each]
    found = [next(r for r in rows if all(getattr(r, n) == v for n, v in s.items())) for s in settings]
    return [size**2 if name == "px" else size for size in each], found


# -- one measurement, in a process of its own -------------------------------------------------------------------------


def peak_mib() -> float:
    """Most memory that this process has had, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def measure(px: int, views: int, gaussians: int, threads: int, steps: int) -> Measured:
    """Train, prepare and render depth at one setting."""
    import torch

    from p2gs.bench.scene import bench_scene
    from p2gs.config.run import load_config
    from p2gs.data.views import TrainingViews
    from p2gs.models.single_state import SingleStatePhase
    from p2gs.models.view_fit import ViewFitConfig
    from p2gs.types import TwoStateScene
    from p2gs.visibility.evidence import gather_evidence

    torch.set_num_threads(threads)
    phases = load_config(["preset/cpu.yaml"]).phases
    section, discovery = phases["single_state"], phases["discovery"].config
    now = time.process_time if threads == 1 else time.perf_counter
    before = peak_mib()
    shots = photographs(px, views)
    means = bench_scene(PHOTOGRAPHED, px).means
    scene = TwoStateScene("scaling", shots, box=torch.stack([means.amin(0), means.amax(0)]))
    began = now()
    prepared = TrainingViews(shots, [px])
    prepare_s = now() - began
    options: Any = section.config
    options.levels, options.level_starts, options.steps = [px], [0.0], WARM + steps
    options.initial_gaussians = 100  # replaced
    options.forgive = ViewFitConfig()  # its trials happen three times in a run and are no step's
    build: Any = SingleStatePhase
    phase = build(options, section.losses, scene, 0, prepared)
    phase.splats = start_of(gaussians, options.sh_degree)
    step_ms = 1e3 * time_of_a_step(phase, now)
    began = now()
    gather_evidence(phase.splats.tensors().detach(), shots, discovery.evidence_size, discovery.min_opacity)
    depth_s = now() - began
    return Measured(px, views, gaussians, threads, step_ms, prepare_s, depth_s, peak_mib() - before)


def photographs(px: int, count: int) -> tuple:
    """``count`` Views of px x px pixels on a ring around the scene."""
    import torch

    from p2gs.bench.scene import bench_scene
    from p2gs.render import rasterize
    from p2gs.types import Camera, View

    scene = bench_scene(PHOTOGRAPHED, px)
    means, quats, scales, opacities, sh = scene.tensors()
    shots = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        turned = torch.eye(4)
        turned[:2, :2] = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        camera = Camera(scene.camera.viewmat @ turned, scene.camera.K, px, px)
        with torch.no_grad():
            out = rasterize(means, quats, scales, opacities, sh, camera.viewmat, camera.K, px, px)
        colour = (out.colour / out.alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
        alpha = (out.alpha.clamp(0, 1) * 255).round().byte()
        shots.append(View(f"{k:03d}", 0, "train", camera, (colour * 255).round().byte(), alpha))
    return tuple(shots)


def start_of(count: int, sh_degree: int):
    """The scene's surface as ``count`` Gaussians to train."""
    from p2gs.bench.scene import bench_scene
    from p2gs.gaussians.splats import Splats
    from p2gs.types import GaussianTensors

    s = bench_scene(count, 100)
    coefficients = s.sh[:, : (sh_degree + 1) ** 2].contiguous()
    return Splats(GaussianTensors(s.means, s.quats, s.scales.log(), s.opacities.logit(), coefficients))


def time_of_a_step(phase, now) -> float:
    """Seconds of a training step with a Trainer, the median after ``WARM`` steps."""
    from p2gs.bench.bare import train_bare
    from p2gs.callbacks.base import Callback

    class Clock(Callback):
        changes_result = False

        def __init__(self):
            self.moments: list[float] = []

        def on_step(self, trainer, phase):
            self.moments.append(now())

    clock = Clock()
    train_bare(phase, [clock])
    counted = clock.moments[WARM - 1 :: 2]  # two steps at a time: one loss is looked at in every second
    return statistics.median(b - a for a, b in zip(counted, counted[1:], strict=False)) / 2


# -- all of them ------------------------------------------------------------------------------------------------------


def in_a_process(setting: dict[str, int], threads: int, steps: int) -> Measured:
    """Raises UserError where the measurement failed."""
    words = [f"{name}={value}" for name, value in {**setting, "threads": threads, "steps": steps}.items()]
    done = subprocess.run([sys.executable, "-m", "p2gs.bench.scaling", *words], capture_output=True, text=True)
    if done.returncode:
        why = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()[-1]
        raise UserError(f"bench scaling: {' '.join(words)}: {why}")
    return Measured(**json.loads(done.stdout.splitlines()[-1]))


def markdown(rows: Sequence[Measured], found: dict[str, dict]) -> str:
    """The two tables of docs/cpu.md."""
    names = {"px": "pixels (edge)", "views": "views", "gaussians": "Gaussians"}
    lines = [f"| {' | '.join([*names.values(), *FIGURES.values()])} |", "|" + "---:|" * (len(names) + len(FIGURES))]
    for r in rows:
        figures = [f"{r.step_ms:.1f}", f"{r.prepare_s:.2f}", f"{r.depth_s:.2f}", f"{r.memory_mib:.0f}"]
        lines.append(f"| {r.px} | {r.views} | {r.gaussians:,} | {' | '.join(figures)} |")
    lines += ["", f"| exponent over | {' | '.join(FIGURES.values())} |", "|---|" + "---:|" * len(FIGURES)]
    for name, by in found.items():
        cells = [f"{by[f]['all']:.2f} ({by[f]['last']:.2f})" for f in FIGURES]
        lines.append(f"| {'number of pixels' if name == 'px' else names[name]} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def bench_scaling(out: Path, threads: int = 1, steps: int = 40, quick: bool = False) -> dict[str, dict]:
    """Measure, write OUT/scaling.md, scaling.json and (with matplotlib) scaling.png; returns the exponents."""
    from p2gs.bench import plots

    sizes, base = (QUICK, QUICK_BASE) if quick else (GROWTH, BASE)
    rows = []
    for setting in plan(sizes, base):
        rows.append(in_a_process(setting, threads, steps))
        print(", ".join(f"{k} {v:.4g}" for k, v in asdict(rows[-1]).items()), flush=True)
    found = exponents(rows, sizes, base)
    out.mkdir(parents=True, exist_ok=True)
    (out / "scaling.md").write_text(markdown(rows, found), encoding="utf-8")
    (out / "scaling.json").write_text(json.dumps({"rows": [asdict(r) for r in rows], "exponents": found}, indent=1))
    panels = {}
    for name, each in sizes.items():
        at, chosen = series(rows, name, each, base)
        label = "pixels" if name == "px" else name
        panels[label] = at, {text: [getattr(r, f) for r in chosen] for f, text in FIGURES.items()}
    plots.growth(out / "scaling.png", panels)
    print(markdown(rows, found))
    return found


def options() -> argparse.ArgumentParser:
    """The options of ``p2gs bench scaling``."""
    parser = argparse.ArgumentParser(
        prog="p2gs bench scaling", description="How a state's time and memory grow with pixels, views and Gaussians."
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench/scaling"), metavar="DIR", help="default %(default)s"
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="default 1, timed in CPU time")
    parser.add_argument("--steps", type=int, default=40, metavar="N", help="of a measurement (default 40)")
    parser.add_argument("--quick", action="store_true", help="small sizes, a minute: does it run?")
    return parser


def main(words: list[str]) -> int:
    """``p2gs bench scaling``: the arguments behind these words; returns the exit code."""
    args = options().parse_args(words)
    if args.threads < 1 or args.steps < 4:
        raise UserError("bench scaling: expected at least 1 thread and 4 steps")
    bench_scaling(**vars(args))
    return 0


if __name__ == "__main__":
    print(json.dumps(asdict(measure(**{k: int(v) for k, v in (word.split("=") for word in sys.argv[1:])}))))
