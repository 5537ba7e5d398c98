"""``p2gs bench kernels``: how long a training step and its parts take, beside the reference rasterizer in the same run.

The scene is ``bench.scene``. One thread is timed in CPU time of the process, which other programs on the machine
disturb little; several threads and CUDA in wall time. All figures are minima over repetitions.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Callable, Optional

import torch
from torch import Tensor

from p2gs.bench.scene import bench_scene
from p2gs.models.adam import NamedAdam
from p2gs.native import native
from p2gs.ops.ssim import l1_ssim
from p2gs.render import rasterize
from p2gs.types import UserError

NAMES = ("means", "quats", "scales", "opacities", "sh")
SIZES, QUICK_SIZES = (200, 400, 800), (200, 400)
COUNTS, QUICK_COUNTS = (5_000, 20_000, 100_000), (5_000, 20_000)
REFERENCE_LIMIT = 20_000 * 400 * 400  # Gaussians times pixels: beyond it the reference is not worth the wait


@dataclass
class Row:
    """Milliseconds; None where not measured. rel_grad_err: against the reference in float64, the worst of all inputs
    (L2, relative)."""

    device: str
    backend: str
    isa: Optional[str]
    n: int
    px: int
    threads: int
    fwd_ms: float
    bwd_ms: float
    loss_ms: Optional[float] = None
    adam_ms: Optional[float] = None
    step_ms: Optional[float] = None
    rel_grad_err: Optional[float] = None
    speedup: Optional[float] = None  # fwd + bwd, over the reference in torch on as many threads


def _clock(device: str, threads: int) -> Callable[[], float]:
    if device != "cpu":

        def now() -> float:
            torch.cuda.synchronize()
            return time.perf_counter()

        return now
    return time.process_time if threads == 1 else time.perf_counter


def _minima(
    run: Callable[[Callable[[], float]], list[float]], clock: Callable[[], float], seconds: float, least: int
) -> list[float]:
    """``run`` returns the moments between its parts; the least duration of each part over repetitions, in ms."""
    best: list[float] = []
    end, repetitions = time.perf_counter() + seconds, 0
    gc.disable()
    try:
        while repetitions < least or time.perf_counter() < end:
            moments = run(clock)
            parts = [1e3 * (b - a) for a, b in zip(moments, moments[1:], strict=False)]
            best = [min(a, b) for a, b in zip(best, parts, strict=True)] if best else parts
            repetitions += 1
    finally:
        gc.enable()
    return best


def _leaves(n: int, px: int, device: str, dtype: torch.dtype = torch.float32):
    scene = bench_scene(n, px)
    leaves = [t.to(device, dtype).requires_grad_() for t in scene.tensors()]
    return leaves, scene.camera


def _render(leaves: list[Tensor], camera, backend: str):
    return rasterize(*leaves, camera.viewmat, camera.K, camera.width, camera.height, backend=backend)


def _time(n: int, px: int, threads: int, device: str, backend: str, seconds: float, reference: bool) -> Row:
    torch.set_num_threads(threads)
    leaves, camera = _leaves(n, px, device)
    g = torch.Generator().manual_seed(0)
    directions = [torch.randn(s, generator=g).to(device) for s in ((px, px, 3), (px, px), (px, px))]
    clock = _clock(device, threads)

    def passes(now):
        moments = [now()]
        out = _render(leaves, camera, backend)
        moments.append(now())
        torch.autograd.grad((out.colour, out.alpha, out.depth), leaves, directions)
        return [*moments, now()]

    fwd, bwd = _minima(passes, clock, seconds, 1 if reference else 3)
    isa = native.isa() if backend == "cpu" else None
    row = Row(device, backend, isa, n, px, threads, fwd, bwd)
    if reference:
        return row

    with torch.no_grad():
        image = _render(leaves, camera, backend).colour
    target = (image + 0.1 * torch.rand_like(image)).clamp(0, 1)
    image.requires_grad_()
    cache: dict = {}

    def loss(now):
        moments = [now()]
        torch.autograd.grad(l1_ssim(image, target, cache=cache, key="target"), image)
        return [*moments, now()]

    groups = [{"params": [t], "name": name, "lr": 1e-9} for t, name in zip(leaves, NAMES, strict=True)]
    optimizer = NamedAdam(groups)
    for t in leaves:
        t.grad = torch.randn_like(t)

    def adam(now):
        moments = [now()]
        optimizer.step()
        return [*moments, now()]

    def step(now):
        moments = [now()]
        optimizer.zero_grad(set_to_none=True)
        l1_ssim(_render(leaves, camera, backend).colour, target, cache=cache, key="target").backward()
        optimizer.step()
        return [*moments, now()]

    (row.loss_ms,), (row.adam_ms,), (row.step_ms,) = (_minima(f, clock, seconds / 2, 3) for f in (loss, adam, step))
    return row


def gradient_error(n: int, px: int, device: str, backend: str) -> float:
    """Worst relative L2 error of a gradient (of a random linear function of colour, alpha and depth) against
    float64."""
    gradients = []
    for name, dtype in ((backend, torch.float32), ("torch_ref", torch.float64)):
        leaves, camera = _leaves(n, px, device, dtype)
        out = _render(leaves, camera, name)
        g = torch.Generator().manual_seed(0)
        directions = [
            torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in (out.colour, out.alpha, out.depth)
        ]
        gradients.append(torch.autograd.grad((out.colour, out.alpha, out.depth), leaves, directions))
    return max(float((a.double() - b).norm() / b.norm()) for a, b in zip(*gradients, strict=True))


def bench_kernels(
    device: str = "cpu", json_path: Optional[str] = None, quick: bool = False, all_isas: bool = False
) -> list[Row]:
    """Measure, print a table, write the rows as JSON where a path is given, and return them.

    json_path: a file, or "-" for standard output (the table then goes to standard error).
    device: "cpu" (one and all threads, against ``torch_ref``) or "cuda".  quick: fewer sizes and repetitions, under a
    minute.
    all_isas: every instruction set that this machine runs instead of the one in use.  Raises UserError when there is
    nothing to time.
    """
    if device == "cpu" and native is None:
        raise UserError(
            "bench kernels: p2gs was installed without its native kernels, there is nothing to time on the CPU"
        )
    if device != "cpu" and not torch.cuda.is_available():
        raise UserError(f"bench kernels: no CUDA device for --device {device}")
    before_threads, before_isa = torch.get_num_threads(), native.isa() if native is not None else None
    counts, sizes, seconds = (QUICK_COUNTS, QUICK_SIZES, 0.4) if quick else (COUNTS, SIZES, 2.0)
    backend = "cpu" if device == "cpu" else "gsplat"
    isas = native.available_isas() if all_isas and device == "cpu" else [before_isa]
    threads = sorted({1, before_threads}) if device == "cpu" else [before_threads]
    rows: list[Row] = []
    try:
        for n in counts:
            for px in sizes:
                for count in threads:
                    slow = None
                    if n * px * px <= REFERENCE_LIMIT and not (quick and n > QUICK_COUNTS[0]):
                        slow = _time(n, px, count, device, "torch_ref", 0.0, reference=True)
                        rows.append(slow)
                    for isa in isas:
                        if device == "cpu":
                            native.set_isa(isa)
                        row = _time(n, px, count, device, backend, seconds, reference=False)
                        if slow is not None:
                            row.speedup = (slow.fwd_ms + slow.bwd_ms) / (row.fwd_ms + row.bwd_ms)
                        if n == COUNTS[0] and px == SIZES[0]:
                            row.rel_grad_err = gradient_error(n, px, device, backend)
                        rows.append(row)
    finally:
        torch.set_num_threads(before_threads)
        if native is not None:
            native.set_isa(before_isa)
    _print(rows, to_stderr=json_path == "-")
    if json_path is not None:
        text = json.dumps([asdict(r) for r in rows], indent=1)
        if json_path == "-":
            print(text)
        else:
            Path(json_path).write_text(text, encoding="utf-8")
    return rows


def _print(rows: list[Row], to_stderr: bool = False) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(padding=(0, 0), title="milliseconds (minima; CPU time where threads = 1)")
    for head in ("N", "px", "thr", "rasterizer", "fwd", "bwd", "f+b", "loss", "Adam", "step", "vs torch", "grad err"):
        table.add_column(head, justify="left" if head == "rasterizer" else "right", no_wrap=True)
    for r in rows:
        figures = (r.fwd_ms, r.bwd_ms, r.fwd_ms + r.bwd_ms, r.loss_ms, r.adam_ms, r.step_ms)
        table.add_row(
            str(r.n), str(r.px), str(r.threads), r.backend + (f" {r.isa}" if r.isa else ""),
            *("" if f is None else f"{f:.1f}" if f < 100 else f"{f:.0f}" for f in figures),
            "" if r.speedup is None else f"{r.speedup:.0f}x", "" if r.rel_grad_err is None else f"{r.rel_grad_err:.0e}",
        )  # fmt: skip
    Console(stderr=to_stderr).print(table)


def main(words: list[str]) -> int:
    """``p2gs bench kernels``: the arguments behind these words; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="p2gs bench kernels", description="Time the rasterizer and the training step on this machine."
    )
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    where = "also write the rows there, or to standard output"
    parser.add_argument("--json", dest="json_path", nargs="?", const="-", metavar="FILE", help=where)
    parser.add_argument("--quick", action="store_true", help="fewer sizes, under a minute")
    parser.add_argument("--all-isas", action="store_true", help="every instruction set this machine runs")
    bench_kernels(**vars(parser.parse_args(words)))
    return 0
