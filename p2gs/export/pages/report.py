"""RUN/report.html: one self-contained page about a finished run, for a phone or a desktop, light or dark."""

from __future__ import annotations

import base64
import html
import json
import math
from importlib import resources
from pathlib import Path
from typing import Any, Optional, Sequence

import numpy as np

from p2gs.export.pages.report_view import chip, view_section
from p2gs.gaussians.twin_json import load_twin
from p2gs.stage_times import stages_file, wall_seconds
from p2gs.types import ArticulatedObject

CURVE_COLOURS = ("#e07010", "#1a80d8", "#1aa672", "#d84088", "#8058cc", "#c9a020", "#60b8e8", "#909090")


def write_report(run_dir: Path | str) -> Path:
    """The page: mesh and splats in 3D with a slider per joint, pictures, joints, scores, losses, times. What the run
    lacks is left out.

    The 3D view needs RUN/meshes (made by ``write_meshes``); scores need RUN/metrics.json, which ``p2gs test`` writes.
    Raises UserError for a run without a twin.
    """
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    metrics = _json(run_dir / "metrics.json")
    sections = [
        view_section(run_dir, obj),
        picture_section(run_dir),
        joint_section(obj, metrics),
        doubt_section(run_dir),
        score_section(metrics),
        curve_section(run_dir / "logs"),
        time_section(_json(stages_file(run_dir))),
    ]
    name = html.escape(run_dir.resolve().name)
    moving = [p for p in obj.parts if p.joint is not None]
    lead = f"{len(obj.parts)} parts, {len(moving)} of them moving; {len(obj.gaussians):,} Gaussians"
    css = resources.files("p2gs.export").joinpath("report.css").read_text()
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{name} - p2gs</title>\n<link rel="icon" href="data:,">\n<style>\n{css}</style>\n</head>\n<body>\n'
        f'<h1>{name}</h1>\n<p class="lead">{lead}</p>\n' + "\n".join(s for s in sections if s) + "\n</body>\n</html>\n"
    )
    path = run_dir / "report.html"
    path.write_text(page)
    return path


def picture_section(run_dir: Path) -> str:
    """Photographs beside renders, and the states between."""
    rows = []
    told = {
        "compare": "Photograph, twin, parts and joints: start state above, end state below.",
        "states": "From start to end.",
    }
    for name, text in told.items():
        path = run_dir / "media" / f"{name}.png"
        if path.is_file():
            data = base64.b64encode(path.read_bytes()).decode()
            rows.append(f'<img src="data:image/png;base64,{data}" alt="{text}"><p class="soft">{text}</p>')
    return "<h2>Pictures</h2>\n" + "\n".join(rows) if rows else ""


def joint_section(obj: ArticulatedObject, metrics: Optional[dict]) -> str:
    """A row per part: colour, type, axis, range, confidence, and its errors where they are known."""
    joints = (metrics or {}).get("joints")
    errors = {j["pred"]: j["errors"] for j in joints["joints"] if j["pred"] is not None} if joints else {}
    head = ["part", "type", "axis", "through", "start to end", "confidence", "Gaussians"]
    head += ["axis error", "position error x10", "motion error"] if joints else []
    rows, moving = [], 0
    for part in obj.parts:
        j = part.joint
        count = int((obj.part_ids == part.id).sum())
        if j is None:
            cells = [f"{chip(part.id)}{part.id}", "static", "", "", "", "", f"{count:,}"] + ([""] * 3 if joints else [])
        else:
            revolute = j.type == "revolute"
            reach = f"{j.motion:.1f}&deg;" if revolute else f"{j.motion:.3f}"
            # an alternative has the same axis, in one sense or the other
            reach += "".join(f" or {o.motion * float((o.axis @ j.axis).sign()):.0f}&deg;" for o in part.alternatives)
            through = _vector(j.origin) if revolute else ""
            cells = [
                f"{chip(part.id)}{part.id}",
                j.type,
                _vector(j.axis),
                through,
                reach,
                f"{part.confidence:.2f}",
                f"{count:,}",
            ]
            if joints:
                e = errors.get(moving)
                unit = "&deg;" if revolute else ""
                cells += (
                    ["F"] * 3
                    if e is None
                    else [f"{e['axis_angle']:.3f}&deg;", _number(e["axis_position"]), f"{e['motion']:.4f}{unit}"]
                )
            moving += 1
        rows.append(cells)
    return "<h2>Parts and joints</h2>\n" + table(head, rows)


def doubt_section(run_dir: Path) -> str:
    """A link to the diagnosis, with its warnings."""
    d = _json(run_dir / "diagnostics.json")
    if d is None:
        return ""
    items = "".join(f"<li>{html.escape(v['text'])}</li>" for v in d["verdict"] if v["level"] == "warning")
    return f'<p><a href="diagnostics.html">Diagnosis of every stage</a></p><ul class="notes">{items}</ul>'


def score_section(metrics: Optional[dict]) -> str:
    """Pictures and surfaces against what the scene has, and what is missing."""
    if metrics is None:
        return ""
    out = ["<h2>Scores</h2>"]
    views = metrics.get("views") or {}
    if views:
        depth = any("depth_median" in v for v in views.values())
        columns = {
            "psnr_white": "PSNR on white",
            "psnr_black": "on black",
            "ssim_white": "SSIM",
            "psnr_masked": "PSNR of the object",
        }
        columns |= {"lpips": "LPIPS"} if any("lpips" in v for v in views.values()) else {}
        columns |= {"depth_median": "depth error, median", "depth_p90": "90 %"} if depth else {}
        keys, head = list(columns), ["state", "views", *columns.values()]
        counts = {k: html.escape(f"{v['count']} {v['split']}") if "count" in v else "" for k, v in views.items()}
        rows = [[html.escape(k), counts[k], *(_number(v.get(n)) for n in keys)] for k, v in views.items()]
        out.append(table(head, rows))
    chamfer = metrics.get("chamfer")
    if chamfer:
        seen = metrics.get("chamfer_seen")  # runs of older builds have none
        shown = {"value": chamfer, **({"without guesses": seen} if seen else {})}
        rows = [
            [k, *(_number(scores[k]["value"]) for scores in shown.values()), _number(chamfer[k]["floor"])]
            for k in ("static", "movable", "whole")
        ]
        out.append(table(["Chamfer x1000", *shown, "sampling floor"], rows))
    if metrics.get("missing"):
        out.append('<ul class="notes">' + "".join(f"<li>{html.escape(m)}</li>" for m in metrics["missing"]) + "</ul>")
    return "\n".join(out)


def curve_section(logs: Path) -> str:
    """Losses by step, a chart per training stage, from TensorBoard's files."""
    charts = []
    for folder in sorted(p for p in logs.iterdir() if p.is_dir()) if logs.is_dir() else []:
        curves = {
            tag.split("/")[-1]: points
            for tag, points in read_scalars(folder).items()
            if is_loss(tag) and len(points) > 1
        }
        if curves:
            charts.append(f"<h3>{html.escape(folder.name.replace('_', ' '))}</h3>\n{chart(curves)}")
    return "<h2>Losses</h2>\n" + "\n".join(charts) if charts else ""


def is_loss(tag: str) -> bool:
    """Scalars are logged as stage/name; summaries have more levels or are counts."""
    return (
        tag.count("/") <= 2
        and ("loss" in tag or tag.count("/") == 1)
        and tag.split("/")[-1] not in ("gaussians", "parts")
    )


def read_scalars(folder: Path) -> dict[str, np.ndarray]:
    """tag -> [n, 2] (step, value), steps rising: where a stage was run again, what is newer replaces the older from its
    step on."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 2000})
    events.Reload()
    out = {}
    for tag in events.Tags()["scalars"]:
        kept: list[tuple[int, float]] = []
        for e in sorted(events.Scalars(tag), key=lambda e: e.wall_time):
            while kept and kept[-1][0] >= e.step:
                kept.pop()
            kept.append((e.step, e.value))
        out[tag] = np.array(kept)
    return out


def chart(curves: dict[str, np.ndarray], width: int = 640, height: int = 180) -> str:
    """Curves [n, 2] (step, value) on a logarithmic scale, as SVG. Values that are not positive are left out."""
    curves = {k: v[(v[:, 1] > 0) & np.isfinite(v[:, 1])] for k, v in curves.items()}
    curves = {k: v for k, v in curves.items() if len(v) > 1}
    if not curves:
        return ""
    last = max(float(v[:, 0].max()) for v in curves.values()) or 1.0
    values = np.concatenate([np.log10(v[:, 1]) for v in curves.values()])
    lo, hi = math.floor(values.min()), math.ceil(values.max() + 1e-9)
    left, bottom, right = 44, 22, 130

    def xy(row) -> str:
        x = left + (width - left - right) * row[0] / last
        return f"{x:.1f},{8 + (height - bottom - 8) * (1 - (math.log10(row[1]) - lo) / max(hi - lo, 1)):.1f}"

    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="losses by step">']
    for power in range(lo, hi + 1):
        y = 8 + (height - bottom - 8) * (1 - (power - lo) / max(hi - lo, 1))
        parts.append(f'<path d="M{left},{y:.1f}H{width - right}" stroke="currentColor" opacity="0.12"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">1e{power}</text>')
    for i, (name, points) in enumerate(curves.items()):
        colour = CURVE_COLOURS[i % len(CURVE_COLOURS)]
        thin = points[:: max(1, len(points) // 200)]
        parts.append(f'<path d="M{"L".join(xy(p) for p in thin)}" stroke="{colour}"/>')
        if 16 + 14 * i < height - 8:
            parts.append(
                f'<text x="{width - right + 8}" y="{16 + 14 * i}" style="fill:{colour}">{html.escape(name)}</text>'
            )
    parts.append(f'<text x="{width - right}" y="{height - 6}" text-anchor="end">{last:.0f} steps</text></svg>')
    return "".join(parts)


def time_section(stages: Optional[dict]) -> str:
    """Seconds and memory of each stage."""
    if not stages:
        return ""
    rows = [
        [html.escape(k.replace("_", " ")), f"{v['seconds']:.1f}", f"{v['peak_memory_mib']:,}"]
        for k, v in stages.items()
    ]
    rows.append(["all", f"{wall_seconds(stages):.1f}", ""])
    return "<h2>Time</h2>\n" + table(["stage", "seconds", "peak memory [MiB]"], rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Cells are HTML already."""
    body = "".join(
        "<tr>" + "".join(f'<td class="bad">{c}</td>' if c == "F" else f"<td>{c}</td>" for c in row) + "</tr>"
        for row in rows
    )
    heads = "".join(f"<th>{h}</th>" for h in head)
    return f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def _vector(v: Any) -> str:
    return "(" + ", ".join(f"{round(float(x), 3) + 0.0:.3f}" for x in v) + ")"


def _number(value: Optional[float]) -> str:
    return "" if value is None else f"{value:.3f}"


def _json(path: Path) -> Optional[dict]:
    return json.loads(path.read_text()) if path.is_file() else None
