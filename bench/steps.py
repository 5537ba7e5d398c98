"""What is each step of part discovery worth? A bench tool that reads ground truth, which no phase may.

    python bench/steps.py RUN... [--steps NAME...] [--zoo DIR] [--out FILE]

RUN holds the single states of a scene (``p2gs fit ... --only registration``). Discovery is run from them with all
steps, and once more without each step that changed something then (a step that did not is worth nothing on that
object). A line of JSON per run goes to FILE; what it holds already is not run again.
"""

from __future__ import annotations

import json
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Callable, Iterator
from unittest import mock

import torch
from ladder import RIGHT, Case, runs_parser, write_row

import p2gs.models.part_discovery as stage
import p2gs.motion.discovery.explanations as explanations
import p2gs.motion.discovery.pipeline as search
import p2gs.parts.settle as settle

NEAR = {"axis_angle": 5.0, "axis_position": 0.5, "turn": 5.0, "slide": 0.03}  # found, if not to the field's bounds


@dataclass
class Step:
    """A function that can be left out.

    where, name: the modules that call it and its name there.  without: what is called instead.  changed: of what it
    returned and its arguments, whether it did anything.  when: of its arguments, whether this call is one of the step's
    (the others stay).
    """

    where: tuple
    name: str
    without: Callable
    changed: Callable[[Any, tuple], bool]
    when: Callable[[tuple], bool] = lambda arguments: True


def differ(a, b) -> bool:
    """Are two sets of motions, or their labels, not the same?"""
    if a.types != b.types or not torch.equal(a.transforms, b.transforms):
        return True
    return not all(map(torch.equal, a.labels, b.labels))


def moved(at: int, alone: bool = False) -> Callable[[Any, tuple], bool]:
    """Does what a step returns (its first part, unless it is ``alone``) differ from its argument number ``at``?"""
    return lambda out, arguments: differ(out if alone else out[0], arguments[at])


def given(at: int, *rest) -> Callable:
    """Instead of a step: its argument number ``at``, followed by ``rest``."""
    return lambda *arguments, **options: (arguments[at], *rest) if rest else arguments[at]


def any_returned(out, arguments) -> bool:
    return bool(out)


STEPS = {
    "another explanation": Step((stage,), "better", lambda *a: False, any_returned),
    "parts left out or made one": Step((stage,), "simplify", given(1), moved(1, alone=True)),
    "labels by cuts": Step((stage,), "expand", given(1, []), moved(1)),
    "types": Step((stage, settle), "settle_types", given(1), moved(1, alone=True)),
    "bodies: seen between": Step((stage,), "one_part_a_body", given(1, []), moved(1), lambda a: not a[4]),
    "bodies: another's surface between": Step((stage,), "one_part_a_body", given(1, []), moved(1), lambda a: a[4]),
    "shifts along itself": Step((stage,), "leave_false_minima", given(1, []), moved(1)),
    "exchanged": Step((settle,), "_with_part", lambda *a: [], any_returned, lambda a: a[3] is not None),
    "added": Step((settle,), "_with_part", lambda *a: [], any_returned, lambda a: a[3] is None),
    "turned over": Step((settle,), "_turned_over", lambda *a: [], any_returned),
    "crossed": Step((settle,), "places_changed", lambda *a: [], any_returned),
    "parted": Step((settle,), "in_two", lambda *a: [], any_returned),
    "in a row": Step((settle,), "in_rows", lambda *a: [], any_returned),
    "sought": Step((stage,), "seek", given(1, []), moved(1)),
    "settled": Step((stage,), "settle_labels", given(1, []), moved(1)),
    "side by side": Step((stage,), "part_side_by_side", given(2, []), moved(2)),
    "seamless": Step((stage,), "join_seamless", given(1, []), moved(1)),
    "fronts": Step((stage,), "part_fronts", given(3, []), moved(3)),
    "axes laid": Step((stage,), "lay_axes", given(1, None, []), moved(1)),
    "searched again": Step((search,), "again", lambda *a: [], any_returned),
    "extended": Step((search,), "extended", given(3), lambda out, a: out is not a[3]),
    "divided": Step((search,), "divided", given(2), lambda out, a: out is not a[2]),
    "twins": Step((explanations,), "twins", lambda *a: None, lambda out, a: out is not None),
    "hinges": Step((explanations,), "unlikely_hinges", lambda *a: 0.0, lambda out, a: out > 0),
}
# proposals are many, what is taken is in discovery's report
PROPOSED = {"exchanged", "added", "turned over", "crossed", "parted", "in a row"}


@contextmanager
def watched() -> Iterator[set[str]]:
    """The names of the steps that changed something."""
    acted: set[str] = set()

    def watch(name: str, step: Step, real: Callable, *arguments, **options):
        out = real(*arguments, **options)
        if step.when(arguments) and step.changed(out, arguments):
            acted.add(name)
        return out

    with ExitStack() as stack:
        for name, step in STEPS.items():
            for where in step.where:
                real = getattr(where, step.name)  # of two steps of one function the other's watch
                stack.enter_context(mock.patch.object(where, step.name, partial(watch, name, step, real)))
        yield acted


@contextmanager
def left_out(name: str) -> Iterator[None]:
    """Without the step."""
    step = STEPS[name]
    real = getattr(step.where[0], step.name)

    def instead(*arguments, **options):
        return (step.without if step.when(arguments) else real)(*arguments, **options)

    with ExitStack() as stack:
        for where in step.where:
            stack.enter_context(mock.patch.object(where, step.name, instead))
        yield


def taken(reports: list[dict], further: float) -> set[str]:
    """Changes of ``reconsider`` that would be taken by what it reported."""
    good = [r for r in reports if r.get("energy", 1.0) < 0 and r.get("own_share", further) >= further]
    return {r["change"] for r in good}


def measured(case: Case) -> tuple[dict, Any]:
    """Right joints, joints near the truth, parts too many, errors; and what discovery found."""
    motions, seconds = case.discover()
    score, near = (case.score(motions.transforms, motions.types, within) for within in (RIGHT, NEAR))
    row = {"right": score["right"], "near": near["right"], "of": score["of"], "extra": score["extra"]}
    return row | {"errors": [j["errors"] for j in score["joints"]], "seconds": round(seconds, 1)}, motions


def whole(case: Case) -> dict:
    """A run with all steps, and which of them acted."""
    with watched() as acted:
        row, motions = measured(case)
    further = case.cfg.phases["discovery"].config.part_penalty
    acted -= PROPOSED - taken(motions.diagnostics["reconsidered"], further)
    return row | {"acted": sorted(acted)}


def rows_of(case: Callable[[], Case], name: str, steps: list[str], known: list[dict]) -> Iterator[dict]:
    """The lines of the run ``name`` that are not among the ``known``."""
    mine = {row["without"]: row for row in known if row["name"] == name}
    if None not in mine:
        mine[None] = {"name": name, "without": None, **whole(case())}
        yield mine[None]
    for step in steps:
        if step in mine[None]["acted"] and step not in mine:
            with left_out(step):
                yield {"name": name, "without": step, **measured(case())[0]}


def main() -> None:
    parser = runs_parser(__doc__.splitlines()[0])
    parser.add_argument("--steps", nargs="*", default=list(STEPS), choices=list(STEPS), metavar="NAME")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    known = []
    if args.out and args.out.exists():
        known = [json.loads(line) for line in args.out.read_text("utf-8").splitlines()]
    for run in args.runs:
        for row in rows_of(partial(Case, run, args.zoo), run.name, args.steps, known):
            write_row(row, args.out)


if __name__ == "__main__":
    main()
