"""The commands on a finished run: test, predict, export, view. Each takes the parsed arguments, returns the exit
code."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from p2gs.config.files import run_values
from p2gs.registry import load_plugins
from p2gs.types import UserError


def finished_run(folder: str) -> Path:
    """The result folder of a finished fit. Raises UserError where it is none."""
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{path}: there is no such result folder")
    if not (path / "twin.json").is_file():
        begun = (path / "config.yaml").is_file()
        why = "the fit has not finished (give its command again)" if begun else "it is no result folder of p2gs fit"
        raise UserError(f"{path}: has no twin.json: {why}")
    load_run_plugins(path)
    return path


def load_run_plugins(run: Path) -> None:
    """Import what the fit imported: a rasterizer of the user's own draws the run's pictures, too. Raises UserError
    where it cannot be."""
    named = run_values(run).get("plugins") or []
    try:
        load_plugins(tuple(map(str, named if isinstance(named, list) else [named])))
    except UserError as err:
        raise UserError(
            f"{err}; {run / 'config.yaml'} names it: start p2gs where it lies, or have its folder on PYTHONPATH"
        ) from err


def test(args: argparse.Namespace) -> int:
    """Score a run, write metrics.json, print the figures; a report.html that is there is written anew, now with
    scores."""
    from rich import print as rich_print

    from p2gs.callbacks.hparams import write_hparams
    from p2gs.export.pages.report import write_report
    from p2gs.scores.evaluate import evaluate_run
    from p2gs.scores.table import score_tables

    run = finished_run(args.run)
    if args.truth is not None:
        from p2gs.scores.capture import capture_lines, evaluate_capture

        for line in capture_lines(evaluate_capture(run, args.truth, args.root)):
            print(line)
        print(f"written: {run / 'capture_metrics.json'}")
        return 0
    rich_print(score_tables(evaluate_run(run, args.root, args.match)))
    write_hparams(run)
    if (run / "report.html").is_file():
        write_report(run)
    print(f"written: {run / 'metrics.json'}")
    return 0


def predict(args: argparse.Namespace) -> int:
    """Pictures of the twin at the given states; prints the files."""
    run = finished_run(args.run)
    if args.size is not None and args.size < 16:
        raise UserError(f"--size: expected at least 16 pixels, got {args.size}")
    from p2gs.export.pages.states import render_states

    for path in render_states(run, args.times, out=args.out, size=args.size, video=args.video):
        print(path)
    return 0


def view(args: argparse.Namespace) -> int:
    """The twin in the browser, until Ctrl-C."""
    from p2gs.export.pages.viewer import serve

    serve(finished_run(args.run), args.host, args.port)
    return 0


def export(args: argparse.Namespace) -> int:
    """Other formats of the twin; prints the files. With --check the verdict on those that are there: 1 where one
    fails."""
    run = finished_run(args.run)
    if args.check:
        return _check(run if args.out is None else Path(args.out))
    from p2gs.export.formats import export_profile, export_run
    from p2gs.export.naming import parse_names

    if args.meta is not None and args.profile is None:
        raise UserError("--meta: no format but a profile holds it; give --profile simready or partnet as well")
    if args.profile is not None and args.format is not None:
        raise UserError(f"--format: the profile {args.profile} has its own; give one or the other")
    options = {name: getattr(args, name) for name in ("up", "origin", "extend_range", "material", "fixed", "splats")}
    options |= {
        "scale": _metres_per_unit(args, run),
        "names": None if args.name is None else parse_names(args.name),
        "note": _warn,
    }
    if args.profile is not None:
        written = export_profile(run, args.profile, args.out, args.meta, **options)
    else:
        written = export_run(run, args.format or ["all"], out=args.out, texture=args.texture, **options)
    for path in written:
        print(path)
    return 0


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def _metres_per_unit(args: argparse.Namespace, run: Path) -> float:
    """Of --scale or --height, else 1; warns where a capture has no scale, and where the object comes out in a size that
    its kind has not."""
    from p2gs.export.asset import start_box
    from p2gs.export.metadata import read_meta
    from p2gs.export.sizes import unlikely_size

    if args.scale is not None and not args.scale > 0:
        raise UserError(f"--scale: expected a positive number of metres per unit, got {args.scale:g}")
    box = start_box(run)
    scale, sides = 1.0 if args.scale is None else args.scale, box[1] - box[0]
    if args.height is not None:
        if not args.height > 0:
            raise UserError(f"--height: expected a positive number of metres, got {args.height:g}")
        scale = args.height / float(sides[2])
    elif args.scale is None and not _in_metres(run):
        _warn(
            "the capture says nothing of metres, so the object's diagonal is taken for 1 m: give its --height, or lay "
            "the marker board (p2gs data board) beside the object when you photograph it"
        )
    category = "" if args.meta is None else str(read_meta(args.meta).get("category", ""))
    unlikely = unlikely_size(scale * float(sides.max()), f"{category} {run.resolve().name}")
    if unlikely is not None:
        _warn(unlikely)
    return scale


def _in_metres(run: Path) -> bool:
    """False where the run's scene was captured without anything that says how long a metre is."""
    data = run_values(run).get("data")
    root = data.get("root") if isinstance(data, dict) else None
    try:
        facts = json.loads((Path(str(root)) / "capture.json").read_text()) if root else {}
        return bool(facts["scale"]["metric"])
    except (OSError, ValueError, TypeError, KeyError):  # no capture, or gone since
        return True


def _check(folder: Path) -> int:
    from rich import print as rich_print

    from p2gs.export.checks.check import check_folder, check_table

    results = check_folder(folder)
    rich_print(check_table(results))
    return 1 if any(r.state == "fails" for r in results) else 0
