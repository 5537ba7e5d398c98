"""The commands on a finished run: test, predict, export, view. Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from p2gs.registry import suggest
from p2gs.types import UserError

# what fit does not write by itself: name -> (module, function of the run folder)
FORMATS = {"ply": ("p2gs.export.mesh", "write_meshes")}


def finished_run(folder: str) -> Path:
    """The result folder of a finished fit. Raises UserError where it is none."""
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{path}: there is no such result folder")
    if not (path / "twin.json").is_file():
        begun = (path / "config.yaml").is_file()
        why = "the fit has not finished (give its command again)" if begun else "it is no result folder of p2gs fit"
        raise UserError(f"{path}: has no twin.json: {why}")
    return path


def test(args: argparse.Namespace) -> int:
    """Score a run, write metrics.json, print the figures."""
    from rich import print as rich_print

    from p2gs.export.evaluate import evaluate_run
    from p2gs.export.score_table import score_tables

    run = finished_run(args.run)
    rich_print(score_tables(evaluate_run(run, args.root)))
    print(f"written: {run / 'metrics.json'}")
    return 0


def predict(args: argparse.Namespace) -> int:
    """Pictures of the twin at the given states; prints the files."""
    run = finished_run(args.run)
    if args.size is not None and args.size < 16:
        raise UserError(f"--size: expected at least 16 pixels, got {args.size}")
    from p2gs.export.media import render_states

    for path in render_states(run, args.times, out=args.out, size=args.size, video=args.video):
        print(path)
    return 0


def view(args: argparse.Namespace) -> int:
    """The twin in the browser, until Ctrl-C."""
    from p2gs.export.viewer import serve

    serve(finished_run(args.run), args.host, args.port)
    return 0


def export(args: argparse.Namespace) -> int:
    """Other formats of the twin, written into the run folder."""
    run = finished_run(args.run)
    names = list(FORMATS) if args.format == ["all"] else args.format
    for name in names:
        if name not in FORMATS:
            raise UserError(f"export --format: there is no '{name}'{suggest(name, [*FORMATS, 'all'])}")
    for name in names:
        module, function = FORMATS[name]
        getattr(import_module(module), function)(run)
        print(f"{name}: written to {run}")
    return 0
