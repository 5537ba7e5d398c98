"""The commands that work on a finished run, on a scene folder or on the kernels. Each takes the parsed arguments, returns the exit code."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

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


def synth(args: argparse.Namespace) -> int:
    """Write a generated scene; prints how to train on it."""
    from p2gs.data.synthetic import synthesize

    given = {"size": args.size, "train_views": args.views, "test_views": args.test_views}
    for name, value in given.items():
        if value is not None and value < 1:
            raise UserError(f"data synth: {name} is {value}, expected at least 1")
    folder = synthesize(
        args.out, seed=args.seed, kind=args.kind, format=args.format, depth=not args.no_depth, **{k: v for k, v in given.items() if v is not None}
    )
    print(f"{folder}: written; train on it with: p2gs fit -c preset/cpu.yaml -c data/{args.format}.yaml --data.root {folder}")
    return 0


def test(args: argparse.Namespace) -> int:
    """Score a run, write metrics.json, print the figures."""
    from p2gs.export.evaluate import evaluate_run

    run = finished_run(args.run)
    for line in figures(evaluate_run(run, args.root)):
        print(line)
    print(f"written: {run / 'metrics.json'}")
    return 0


def figures(metrics: dict) -> list[str]:
    """The lines a person reads of metrics.json (see export.evaluate): joints, pictures, surfaces, what is missing."""
    lines = [f"{metrics['scene']}: {metrics['num_parts']} parts, {metrics['gaussians']:,} Gaussians"]
    joints = metrics.get("joints")
    for joint in joints["joints"] if joints else []:
        unit = "deg" if joint["type"] == "revolute" else "units"
        errors = joint["errors"]
        if errors is None:
            found = f"found as {joint['pred_type']}" if joint["pred_type"] else "not found"
            lines.append(f"joint {joint['gt']} ({joint['type']}): FAILED, {found}")
            continue
        position = "" if errors["axis_position"] is None else f", position {errors['axis_position']:.3f} (x10)"
        lines.append(f"joint {joint['gt']} ({joint['type']}): axis {errors['axis_angle']:.3f} deg{position}, motion {errors['motion']:.4f} {unit}")
    if joints and joints["extra"]:
        lines.append(f"joints that the object does not have: {len(joints['extra'])}")
    for name in ("start", "end"):
        views = metrics["views"].get(name)
        if views:
            lines.append(
                f"{name}: PSNR {views['psnr_white']:.2f} dB, SSIM {views['ssim_white']:.4f} over {views['count']} {views['split']} views"
                + (f", depth median {views['depth_median']:.4f}" if "depth_median" in views else "")
            )
    chamfer = metrics.get("chamfer")
    if isinstance(chamfer, dict):
        values = [f"{k} {v:.3f}" for k, v in chamfer.get("mean", chamfer).items() if isinstance(v, (int, float))]
        if values:
            lines.append(f"Chamfer (x1000): {', '.join(values)}")
    return lines + [f"note: {sentence}" for sentence in metrics.get("missing", [])]


def predict(args: argparse.Namespace) -> int:
    """Pictures of the twin at the given states; prints the files."""
    run = finished_run(args.run)
    if args.size is not None and args.size < 16:
        raise UserError(f"--size: expected at least 16 pixels, got {args.size}")
    from p2gs.export.media import render_states

    for path in render_states(run, args.times, out=args.out, size=args.size, video=args.video):
        print(path)
    return 0
