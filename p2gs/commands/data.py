"""The commands on scene folders: ``p2gs data check``, ``synth`` and ``prepare``. Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
import sys

from p2gs.types import UserError


def data(args: argparse.Namespace) -> int:
    return {"check": check, "synth": synth, "prepare": prepare}[args.action](args)


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


def synth(args: argparse.Namespace) -> int:
    """Write a generated scene; prints how to train on it."""
    from p2gs.data.synthetic import synthesize

    given = {"size": args.size, "train_views": args.views, "test_views": args.test_views}
    for name, value in given.items():
        if value is not None and value < 1:
            raise UserError(f"data synth: {name} is {value}, expected at least 1")
    given = {k: v for k, v in given.items() if v is not None}
    folder = synthesize(args.out, seed=args.seed, kind=args.kind, format=args.format, depth=not args.no_depth, **given)
    print(f"{folder}: written; train on it with: p2gs fit -c preset/cpu.yaml -c data/{args.format}.yaml --data.root {folder}")
    return 0
