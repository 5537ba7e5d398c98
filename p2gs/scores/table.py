"""metrics.json as a table for the terminal."""

from __future__ import annotations

from typing import Any, Optional


def score_tables(metrics: dict) -> Any:
    """What ``rich.print`` shows of the metrics: joints, surfaces, pictures, and what is missing."""
    from rich.console import Group

    items = [f"[bold]{metrics['scene']}[/]: {metrics['num_parts']} parts, {metrics['gaussians']:,} Gaussians"]
    items += [
        t
        for t in (
            joint_table(metrics.get("joints")),
            chamfer_table(metrics.get("chamfer"), metrics.get("chamfer_seen")),
            view_table(metrics.get("views")),
        )
        if t
    ]
    items += [f"[dim]missing: {text}[/]" for text in metrics["missing"]]
    return Group(*items)


def joint_table(joints: Optional[dict]) -> Any:
    """One row per ground-truth joint; F where it was not found or wrongly typed."""
    if not joints:
        return None
    table = _table("joint", "type", "axis angle [deg]", "axis position x10", "motion [deg | length]")
    for j in joints["joints"]:
        e = j["errors"]
        if e is None:
            why = "not found" if j["pred"] is None else f"found as {j['pred_type']}"
            table.add_row(str(j["gt"] + 1), f"{j['type']} ({why})", "F", "F", "F", style="red")
        else:
            table.add_row(
                str(j["gt"] + 1), j["type"], _num(e["axis_angle"]), _num(e["axis_position"]), _num(e["motion"])
            )
    table.add_section()
    mean = [joints["axis_angle_mean"], joints["pos_mean_revolute"], joints["motion_mean"]]
    table.add_row("mean", f"{joints['failures']} failed, {len(joints['extra'])} extra", *map(_num, mean))
    return table


def chamfer_table(chamfer: Optional[dict], seen: Optional[dict] = None) -> Any:
    """Chamfer distances x1000, with the sampling floor beside each; ``seen``: those without guessed faces, where they
    were measured."""
    if not chamfer:
        return None
    table = _table("Chamfer x1000", "value", *(["without guesses"] if seen else []), "sampling floor")
    for name in ("static", "movable", "whole"):
        values = [chamfer[name]["value"], *([seen[name]["value"]] if seen else []), chamfer[name]["floor"]]
        table.add_row(name, *map(_num, values))
    return table


def view_table(views: Optional[dict]) -> Any:
    if not views:
        return None
    depth = any("depth_median" in v for v in views.values())
    perceived = any("lpips" in v for v in views.values())
    more = (["LPIPS"] if perceived else []) + (["depth median", "depth p90"] if depth else [])
    table = _table("views", "", "PSNR white", "PSNR black", "SSIM white", "PSNR object", *more)
    for name, v in views.items():
        cells = [_num(v.get(k), 2) for k in ("psnr_white", "psnr_black")] + [
            _num(v.get("ssim_white")),
            _num(v.get("psnr_masked"), 2),
        ]
        cells += [_num(v.get("lpips"))] if perceived else []
        cells += [_num(v.get(k), 4) for k in ("depth_median", "depth_p90")] if depth else []
        table.add_row(name, f"{v['count']} {v['split']}" if "count" in v else "", *cells)
    return table


def _table(*columns: str) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD)
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i < 2 else "right")
    return table


def _num(value: Optional[float], digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
