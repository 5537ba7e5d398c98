"""The commands on scene folders: ``p2gs data check``, ``synth``, ``render``, ``prepare``, ``capture`` and ``board``.

Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
import sys

from p2gs.types import UserError


def data(args: argparse.Namespace) -> int:
    actions = {"check": check, "synth": synth, "render": render, "prepare": prepare, "capture": capture, "board": board}
    return actions[args.action](args)


def prepare(args: argparse.Namespace) -> int:
    """What a downloaded tree has of the benchmarks; 2 where an object is missing or incomplete."""
    from p2gs.data.prepare import prepare, prepare_lines

    found = prepare(args.root, args.objects)
    for line in prepare_lines(found):
        print(line)
    return 0 if all(p.ready for p in found) else 2


def check(args: argparse.Namespace) -> int:
    """Every finding on its own line; 2 where there is an error."""
    from p2gs.data.check import check_dataset

    findings = check_dataset(args.root, args.format, strict_paths=args.strict_paths)
    errors = [f.message for f in findings if f.level == "error"]
    for finding in findings:
        if finding.level == "note":
            print(f"note: {finding.message}")
    for message in errors:
        print(f"error: {message}", file=sys.stderr)
    if not errors:
        print(f"{args.root}: can be trained on")
    return 2 if errors else 0


def synth(args: argparse.Namespace) -> int:
    """Write a generated scene; prints how to train on it."""
    from p2gs.data.generated.generate import synthesize

    given = {"size": args.size, "train_views": args.views, "test_views": args.test_views}
    for name, value in given.items():
        if value is not None and value < 1:
            raise UserError(f"data synth: {name} is {value}, expected at least 1")
    given = {k: v for k, v in given.items() if v is not None}
    folder = synthesize(args.out, seed=args.seed, kind=args.kind, format=args.format, depth=not args.no_depth, **given)
    print(
        f"{folder}: written; train on it with: p2gs fit -c preset/cpu.yaml -c data/{args.format}.yaml --data.root "
        f"{folder}"
    )
    return 0


def render(args: argparse.Namespace) -> int:
    """An asset in two states as a scene; without --joints, the joints that it has."""
    from pathlib import Path

    from p2gs.data.render.scene import RenderOptions, listed, read_asset, render

    if args.joints is None or args.out is None:
        asset = read_asset(Path(args.asset))
        print("\n".join(listed(asset)) or f"{args.asset}: no joint of it can move")
        if args.out is not None:
            raise UserError("data render: --joints is not given; expected NAME=START:END of joints above, with commas")
        return 0
    for name, least in (("size", 16), ("views", 1), ("test_views", 0)):
        if getattr(args, name) < least:
            raise UserError(f"data render: --{name} is {getattr(args, name)}, expected at least {least}")
    cameras = None if args.cameras is None else Path(args.cameras)
    options = RenderOptions(
        args.format,
        args.size,
        args.views,
        args.test_views,
        args.seed,
        args.samples,
        cameras,
        not args.no_depth,
        args.renderer,
    )
    folder = render(Path(args.asset), args.joints, Path(args.out), options, Progress())
    print(f"{folder}: written; train on it with: p2gs fit -c preset/cpu.yaml --data.root {folder}")
    return 0


class Progress:
    """Notes a line each; where the work stands on one line of a terminal, or every 32nd line of a file."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, text: str) -> None:
        if text.startswith("note: "):
            print(text, flush=True)
        elif sys.stdout.isatty():
            print(f"\r{text}  ", end="", flush=True)
        elif self.calls % 32 == 0:
            print(text, flush=True)
        self.calls += 1


def board(args: argparse.Namespace) -> int:
    """The marker sheet."""
    from pathlib import Path

    from p2gs.data.capture.board import write_board

    write_board(Path(args.out))
    print(f"{args.out}: print at 100 %, check the ruler, lay it flat on the floor beside the object for both states")
    return 0


def capture(args: argparse.Namespace) -> int:
    """Photographs to a scene; prints each stage and how to train on the result."""
    from pathlib import Path

    from p2gs.data.capture.pipeline import Options, capture_scene

    for name in ("max_views", "size"):
        if getattr(args, name) < 8:
            raise UserError(f"data capture: {name} is {getattr(args, name)}, expected at least 8")
    if args.height is not None and not 0 < args.height < float("inf"):
        raise UserError(f"data capture: --height is {args.height:g}, expected metres above 0")
    if args.length is not None and not 0 < args.length[0] < float("inf"):
        raise UserError(f"data capture: --length is {args.length[0]:g}, expected metres above 0")
    if args.poses is not None and args.static is not None:
        raise UserError("data capture: --static chooses how the states lie to one another, which --poses says already")
    options = Options(
        masks=None if args.masks is None else Path(args.masks), ignore=args.mask_means == "ignore",
        poses=None if args.poses is None else Path(args.poses), static=args.static, height=args.height,
        length=None if args.length is None else tuple(args.length),
        box=None if args.box is None else tuple(args.box), mask_model=args.mask_model,
        max_views=args.max_views, size=args.size, careful=args.careful,
    )  # fmt: skip
    folder = capture_scene(
        Path(args.start), Path(args.end), Path(args.out), options, progress=lambda text: print(text, flush=True)
    )
    print(
        f"{folder}: written; look at capture.html there, then: p2gs fit -c preset/cpu.yaml -c data/artgs.yaml "
        f"--data.root {folder}"
    )
    return 0
