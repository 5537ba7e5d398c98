"""``p2gs data prepare DIR``: which objects of the benchmarks a downloaded tree has, and what of them is missing or
unlike the list.

Looks at camera files, at which images, depth maps and meshes are there, and at the ground truth's joints; reads no
pixels (that is ``p2gs data check SCENE``). No checksums: none are published.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Iterable, Optional

from p2gs.data.frames import STATES
from p2gs.data.ground_truth import load_ground_truth
from p2gs.data.layouts import layout_named
from p2gs.data.objects import BenchmarkObject, Location, find_objects, pick_objects
from p2gs.data.report import Report
from p2gs.types import UserError

SHOWN = 3  # problems told of one object


@dataclass
class Prepared:
    """What was found of one object. where: None where it is not in the tree.  problems: sentences, training or scoring
    will fail.

    notes: sentences worth knowing.  summary: views, sizes and joints in words.
    """

    object: BenchmarkObject
    where: Optional[Location] = None
    summary: str = ""
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        return self.where is not None and not self.problems


def prepare(root: Path | str, names: Iterable[str] = ("all",)) -> list[Prepared]:
    """Check a downloaded tree against the object lists. names: benchmarks or ids. Raises UserError for an unknown name
    or no folder."""
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder")
    objects = pick_objects(names)
    places = find_objects(root, objects)
    return [check_object(o, places.get(o.id)) for o in objects]


def check_object(o: BenchmarkObject, where: Optional[Location]) -> Prepared:
    """Files and ground truth of one object against the list."""
    found = Prepared(o, where)
    if where is None:
        return found
    report, layout = Report(), layout_named(where.format)
    extra = (where.source,) if where.format == "paris" else ()
    frames = layout.index(where.root, report, *extra)
    found.problems += [f.message for f in report.findings if f.level == "error"]
    found.notes += [f.message for f in report.findings if f.level == "note"]
    counts = Counter((f.state, f.split) for f in frames)
    depth = sum(f.depth is not None for f in frames)
    views = [
        f"{counts[s, split]} {split} ({STATES[s]})"
        for split in ("train", "val", "test")
        for s in (0, 1)
        if counts[s, split]
    ]
    found.summary = f"{where.format} layout, {', '.join(views) or 'no views'}, depth in {depth}"
    if frames and not any(f.split == "test" for f in frames):
        found.notes.append("there are no test views: pictures will be scored on the training views")
    check_truth(found)
    return found


def check_truth(found: Prepared) -> None:
    """The ground truth's joints and meshes against the list's."""
    o, where = found.object, found.where
    try:
        truth = load_ground_truth(where.root, where.format, where.source)
    except UserError as err:
        found.problems.append(str(err))
        return
    if truth is None:
        found.problems.append(
            "there is no ground truth (gt/trans.json, or data/<source>/textured_objs/trans.json), so results cannot "
            "be scored"
        )
        return
    kinds = [j.type for j in truth.joints]
    if Counter(kinds) != Counter(o.joints):
        found.problems.append(
            f"{truth.folder / 'trans.json'}: has joints {', '.join(kinds)}, the list says {', '.join(o.joints)}"
        )
    for state, meshes in zip(STATES, (truth.start, truth.end), strict=True):
        parts = (("the whole", meshes.whole), ("the static part", meshes.static), ("the moving parts", meshes.dynamic))
        lacking = [name for name, there in parts if not there]
        if lacking:
            found.problems.append(
                f"{truth.folder / state}: lacks the mesh of {', '.join(lacking)}, so shape cannot be scored"
            )


def prepare_lines(found: list[Prepared]) -> list[str]:
    """What ``p2gs data prepare`` prints: a line an object, its problems below it, a sum at the end."""
    width = max((len(p.object.id) for p in found), default=0)
    lines = []
    for p in found:
        joints = Counter(p.object.joints)
        kinds = ", ".join(f"{n} {kind}" for kind, n in joints.items())
        state = "missing" if p.where is None else "ready" if p.ready else "incomplete"
        lines.append(
            f"{p.object.id:<{width}}  {state:<10}  {p.object.parts} parts ({kinds})"
            + (f"; {p.summary}" if p.summary else "")
        )
        lines += [f"{'':<{width}}    problem: {text}" for text in p.problems[:SHOWN]]
        if len(p.problems) > SHOWN:
            lines.append(
                f"{'':<{width}}    and {len(p.problems) - SHOWN} more problems (p2gs data check {p.where.root})"
            )
        lines += [f"{'':<{width}}    note: {text}" for text in p.notes[:SHOWN]]
    ready = sum(p.ready for p in found)
    missing = [p.object.id for p in found if p.where is None]
    lines.append(
        f"{ready} of {len(found)} objects are ready" + (f"; not there: {', '.join(missing)}" if missing else "")
    )
    return lines
