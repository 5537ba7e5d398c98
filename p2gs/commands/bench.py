"""``p2gs bench`` and ``p2gs table``. Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
import importlib
import shlex

from p2gs.types import UserError


def bench(args: argparse.Namespace, words: list[str]) -> int:
    """Run a matrix; 1 where a run failed. Or one of the benches that time something: ``kernels`` the rasterizers,
    ``scaling`` how a state's time and memory grow, ``peers`` another program on the same views."""
    if args.action != "runs":
        return importlib.import_module(f"p2gs.bench.{args.action}").main(words)
    if not args.config:
        raise UserError("bench needs a file: p2gs bench -c bench/paris.yaml --root DIR (or: p2gs bench kernels)")
    from p2gs.bench.plan import read_bench

    for name in ("root", "out", "preset", "num_parts", "executor", "processes"):
        if getattr(args, name) is not None:
            words = [*words, f"--{name}", getattr(args, name)]
    if args.seeds:
        words = [*words, "--seeds", f"[{', '.join(args.seeds)}]"]
    plan = read_bench(args.config, words, args.objects, args.settings)
    plan.check_settings()
    if args.dry_run:
        for cell in plan.cells:
            print(f"{cell.name}: p2gs fit {shlex.join(cell.words)} --run {shlex.quote(cell.run)}")
        return 0
    from p2gs.bench.runner import run_bench

    counts = run_bench(plan, skip_failed=args.skip_failed)
    print(f"p2gs table {shlex.quote(str(plan.options.folder))} makes the tables")
    return 1 if counts["failed"] else 0


def table(args: argparse.Namespace) -> int:
    """Write the tables; prints the files."""
    from p2gs.bench.report import write_tables

    for path in write_tables(args.bench, args.tables, args.out):
        print(path)
    return 0
