"""The commands that work on a finished run, on a scene folder or on the kernels. Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from p2gs.types import UserError


def finished_run(folder: str) -> Path:
    """The result folder of a finished fit. Raises UserError where it is none."""
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{path}: there is no such result folder")
    if not (path / "twin.json").is_file():
        begun = "the fit has not finished (give its command again)" if (path / "config.yaml").is_file() else "it is no result folder of p2gs fit"
        raise UserError(f"{path}: has no twin.json: {begun}")
    return path


def data(args: argparse.Namespace) -> int:
    return check(args) if args.action == "check" else synth(args)


def check(args: argparse.Namespace) -> int:
    """Every finding on its own line; 2 where there is an error."""
    from p2gs.data.check import check_dataset

    findings = check_dataset(args.root, args.format)
    errors = [f.message for f in findings if f.level == "error"]
    for finding in findings:
        if finding.level == "note":
            print(f"note: {finding.message}")
    for message in errors:
        print(f"error: {message}", file=sys.stderr)
    if not errors:
        print(f"{args.root}: can be trained on")
    return 2 if errors else 0
