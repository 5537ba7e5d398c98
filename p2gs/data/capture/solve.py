"""Structure from motion of both states, and their points brought into one model: what ``pipeline`` does where nobody
brings poses."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.capture import board as marker_board
from p2gs.data.capture import keypoint_fit, page
from p2gs.data.capture.cache import Cache, Progress
from p2gs.data.capture.child import run_job
from p2gs.data.capture.colmap_io import find_model, read_model, write_model
from p2gs.data.capture.hypotheses import Hypothesis, State
from p2gs.data.capture.joint import join
from p2gs.data.capture.model import Model
from p2gs.data.capture.photos import Shot, lens_groups
from p2gs.data.capture.poses import MIN_REGISTERED, MIN_SHARE, some_of
from p2gs.data.capture.static import LINKED, check_link, choose, hypotheses_of, link
from p2gs.data.frames import STATES
from p2gs.types import UserError


def told(shots: list[Shot]) -> list:
    """What says that photographs are the same."""
    return [(s.source, s.sharpness) for s in shots]


def _reconstruction_there(folder: Path, result: dict) -> bool:
    """Whether the files of a state's reconstruction are there; one that placed nothing has none."""
    there = find_model(folder / "model") is not None and (folder / "descriptors.npz").is_file()
    return there or result["registered"] == 0


def _reconstructed(state: str, shots: list[Shot], work: Path, cache: Cache, careful: bool, progress: Progress) -> State:
    """A state alone: with quick settings, with careful ones where those place too few. Raises UserError where both
    do."""
    from p2gs.data.capture.sfm import default_effort

    total, result, name = len(shots), {"registered": 0, "models": 0}, state
    for effort in [True] if careful else [False, True]:
        name = f"{state}_careful" if effort else state
        job = {
            "images": str((work / "photos").resolve()),
            "groups": lens_groups(shots),
            "effort": default_effort(effort),
            "out": str((work / name).resolve()),
        }
        depends = [job, told(shots)]

        def make(job=job, name=name) -> dict:
            return run_job("reconstruct", job, work / name, lambda text: progress(f"{state}: {text}"))

        result = cache.get(f"sfm_{name}", depends, make, progress, partial(_reconstruction_there, work / name))
        if result["registered"] >= max(MIN_SHARE * total, MIN_REGISTERED):
            progress(f"{state}: {result['registered']} of {total} photographs placed, {result['error']:.2f} px")
            model = read_model(work / name / "model")
            d = np.load(work / name / "descriptors.npz")["descriptors"].astype(np.float32)
            return State(model, d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6))
    placed = {p.name for p in read_model(work / name / "model").photos.values()} if result["registered"] else set()
    missing = some_of([Path(s.source).name for s in shots if s.name not in placed])
    raise UserError(
        f"{Path(shots[0].source).parent}: only {result['registered']} of {total} photographs could be placed, not "
        f"{missing}; take them closer together (a step to the side each), with the room in view, "
        "and lay newspapers or a patterned rug around the object"
    )


def solved(
    shots: list[Shot], work: Path, cache: Cache, careful: bool, static: Optional[int], progress: Progress
) -> tuple[Model, dict[int, int], dict]:
    """(joint model, {corner: point id}, facts) by structure from motion; writes ``hypotheses.html`` beside ``work``.
    static: which hypothesis to take (None: the widest).

    Raises UserError where the photographs of a state do not hang together, or the states do not."""
    states = [
        _reconstructed(s, [x for x in shots if x.name.startswith(s)], work, cache, careful, progress) for s in STATES
    ]
    progress("looking for the marker board")
    seen = marker_board.find_board([s.name for s in shots], work / "photos")
    found = hypotheses_of(states[0], states[1], seen)
    page.write_hypotheses(work.parent, states[0].model, found)
    static = choose(found, static, Path(shots[0].source).parent)
    chosen: Hypothesis = found[static]
    facts = {"hypotheses": [h.to_dict() for h in found], "static": static}
    progress(f"static scene: hypothesis {static} with {len(chosen.pairs)} votes, spread {chosen.spread:.2f}")
    corners: dict[int, int] = {}
    board_rms: float | None = None

    def with_board(model: Model) -> Model:
        nonlocal corners
        model, corners = marker_board.with_corners(model, seen, marker_board.WEIGHT)
        return model

    def on_board(model: Model) -> tuple[Model, list[int]]:
        nonlocal board_rms
        model, known, board_rms = marker_board.measured(model, corners, marker_board.WEIGHT)
        return model, known

    def by_pixels(model: Model) -> Model:
        board = np.array(marker_board.ids_of(corners, marker_board.WEIGHT), np.int64)
        model, share = keypoint_fit.refined(model, work / "photos", board)
        progress(f"{100 * share:.0f} % of the features placed by their pixels")
        return model

    lenses = {s.name: s.lens for s in shots}
    folder, steps = work / "joint", (with_board, on_board, by_pixels, progress)
    joined = partial(join, states[0], states[1], chosen.T, folder, *steps, lens_of=lenses)
    # the name is what this stage is: what an earlier build kept had other numbers for the board's points
    sightings = [sorted((k, v.tolist()) for k, v in m.items()) for m in seen.values()]
    depends = ["placed by pixels", chosen.T.tolist(), sightings, sorted(lenses.items())]

    def make() -> dict:
        model = joined(by_board=bool(chosen.board) and not chosen.wide)
        if chosen.board and chosen.wide and not link(model) < LINKED:
            model = joined(by_board=True)  # a few points that hardly moved passed for the room
        write_model(model, work / "joined")
        return {"corners": corners, "board_rms": board_rms}

    result = cache.get("joint", depends, make, progress, lambda result: find_model(work / "joined") is not None)
    corners = {int(k): v for k, v in result["corners"].items()}
    if result.get("board_rms") is not None:  # before the board was held
        facts["board_rms_mm"] = round(1000 * result["board_rms"], 2)
    model = read_model(work / "joined")
    check_link(link(model), bool(chosen.board), Path(shots[0].source).parent)
    return model, corners, facts
