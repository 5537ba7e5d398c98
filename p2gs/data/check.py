"""``p2gs data check DIR``: everything that is wrong, or only unusual, with a scene's files, one sentence each."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Optional

import torch

from p2gs.data.box import object_box
from p2gs.data.frames import STATES
from p2gs.data.images import check_sizes, read_views
from p2gs.data.layouts import detect_format, layout_named
from p2gs.data.report import Finding, Report
from p2gs.types import UserError, View

CHUNK = 32  # views whose colours are held at a time


def _slim(view: View) -> View:
    """The view without colours and depth values: what the box and the summary need."""
    nothing = torch.empty(0)
    return replace(view, image=nothing, depth=None if view.depth is None else nothing)


def _summary(root: Path, format: str, views: list[View]) -> str:
    counts = Counter((v.state, v.split) for v in views)
    order = [(s, split) for s in (0, 1) for split in ("train", "val", "test") if counts[s, split]]
    numbers = ", ".join(f"{counts[key]} {key[1]} ({STATES[key[0]]})" for key in order)
    sizes = sorted({(v.camera.width, v.camera.height) for v in views})
    size = f"{sizes[0][0]}x{sizes[0][1]} pixels" if len(sizes) == 1 else f"{len(sizes)} different sizes"
    depth = sum(v.depth is not None for v in views)
    return f"{root}: {format} layout, {numbers} views of {size}, {'depth in ' + str(depth) if depth else 'no depth'}"


def check_dataset(
    root, format: Optional[str] = None, source: Optional[str] = None, strict_paths: bool = False
) -> list[Finding]:
    """Every finding about the scene in ``root``, errors and notes, in the order in which a reader meets them.

    format: layout name (artgs, dta, paris), found from the folder if not given.  source: PARIS only.  strict_paths:
    files that lead out of the folder are errors and not read, else notes.  Never raises for a faulty scene; raises
    UserError for an unknown format name.
    """
    root = Path(root)
    report = Report(root=root, strict=strict_paths)
    if not root.is_dir():
        report.error(f"{root}: scene folder is missing")
        return report.findings
    format = format or detect_format(root)
    if format is None:
        marks = "artgs: transforms_train_start.json, dta: init_keyframes.yml, paris: load/start and load/end"
        report.error(f"{root}: is none of the known layouts ({marks})")
        return report.findings
    layout = layout_named(format)
    frames = layout.index(root, report, source) if format == "paris" else layout.index(root, report)
    views: list[View] = []
    for i in range(0, len(frames), CHUNK):
        views += [_slim(v) for v in read_views(frames[i : i + CHUNK], report)]
    check_sizes(frames, views, report)
    if not report.failed:
        try:
            object_box([v for v in views if v.split == "train"])
        except UserError as err:
            report.error(f"{root}: {err}")
    _check_ground_truth(root, format, source, report)
    if views:
        report.note(_summary(root, format, views))
    return report.findings


def _check_ground_truth(root: Path, format: str, source: Optional[str], report: Report) -> None:
    from p2gs.data.ground_truth import load_ground_truth

    try:
        truth = load_ground_truth(root, format, source)
    except UserError as err:
        report.note(f"{err}, so the result cannot be scored")
        return
    if truth is None:
        report.note(f"{root}: has no ground truth, so the result cannot be scored")
        return
    for state, meshes in enumerate((truth.start, truth.end)):
        if not (meshes.whole and meshes.static and meshes.dynamic):
            report.note(
                f"{truth.folder / STATES[state]}: lacks the mesh of the whole, the static or a moving part, shape "
                "cannot be scored"
            )
