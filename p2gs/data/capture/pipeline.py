"""``p2gs data capture``: the stages in their order, each kept in ``SCENE/.capture`` and skipped when what it read is
unchanged."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.capture import board as marker_board
from p2gs.data.capture import frame, gains, given_masks, keypoint_fit, page, poses, world, write
from p2gs.data.capture.auto_masks import auto_masks
from p2gs.data.capture.child import run_job
from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.facts import facts_of
from p2gs.data.capture.hypotheses import Hypothesis, State
from p2gs.data.capture.joint import is_end, join
from p2gs.data.capture.model import Model
from p2gs.data.capture.photos import Shot, copy_photos, drop_blurred, lens_groups
from p2gs.data.capture.segmenters import segmenter_of
from p2gs.data.capture.static import (
    LINKED,
    check_joint_support,
    check_link,
    choose,
    hypotheses_of,
    link,
    loose_poses,
)
from p2gs.types import UserError

STATES = ("start", "end")
MIN_SHARE = 0.9  # of a state's photographs must be placed
MIN_ARC = 60.0  # degrees around the object
MIN_REGISTERED = 8
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Options:
    """masks: folder of masks.  ignore: nerfstudio's meaning of them.  poses: COLMAP model or transforms.json.  static:
    number of the hypothesis to take.  height: metres of the object.  box: x0 y0 z0 x1 y1 z1 that the object is within,
    as capture.html has it.  mask_model: draws masks' edges (``segmenters``).  max_views: photographs a state.  size:
    long edge in pixels."""

    masks: Optional[Path] = None
    ignore: bool = False
    poses: Optional[Path] = None
    static: Optional[int] = None
    height: Optional[float] = None
    box: Optional[tuple[float, ...]] = None
    mask_model: Optional[str] = None
    max_views: int = 60
    size: int = 1600
    careful: bool = False


class Cache:
    """Results of stages by a key of all that they depend on."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, stage: str, depends: object, make: Callable[[], dict], progress: Progress) -> dict:
        """The stage's result, from disk where ``depends`` (anything JSON knows) is the same as when it was made."""
        key = hashlib.sha256(json.dumps(depends, sort_keys=True, default=str).encode()).hexdigest()
        path = self.folder / f"{stage}.json"
        if path.is_file():
            kept = json.loads(path.read_text())
            if kept["key"] == key:
                progress(f"{stage}: unchanged")
                return kept["result"]
        path.unlink(missing_ok=True)
        result = make()
        path.write_text(json.dumps({"key": key, "result": result}))
        return result


def _stamp(source: Path) -> list:
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    return [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files if p.is_file()]


def capture_scene(start: Path, end: Path, out: Path, options: Options, progress: Progress = lambda text: None) -> Path:
    """Write the scene of two states' photographs; returns its folder. Raises UserError where the photographs cannot
    carry it."""
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not (out / ".capture").is_dir()):
        raise UserError(f"{out}: is there already and was not made by p2gs data capture; expected a new folder")
    segmenter = None if options.mask_model is None else segmenter_of(options.mask_model)
    cache = Cache(out / ".capture")
    work = cache.folder
    shots, left_out = _photos({"start": start, "end": end}, work, cache, options, progress)
    masks = _masks(shots, work / "photos", options)
    if options.poses is not None:
        model = poses.onto_copies(poses.read_poses(options.poses), shots, start, end)
        facts = {"hypotheses": [], "support": check_joint_support(model), "poses": str(options.poses)}
        seen = marker_board.find_board([s.name for s in shots], work / "photos")
        model, corners = marker_board.with_corners(model, seen)
        if (loose := loose_poses(model)) is not None:
            progress(f"warning: {options.poses}: {loose}")
    else:
        model, corners, facts = _solved(shots, work, cache, options, progress)
    for state in STATES:
        _check_arc(model, state)
    progress("exposure and white balance")
    found = gains.photo_gains(model, work / "photos")
    model, about = world.oriented(model, corners)
    if masks is None:
        within = world.given_box(options.box, about, out)
        masks = auto_masks(model, work / "photos", found, progress, within, segmenter)
        _keep(masks, out / "masks")
    model = world.scaled(model, masks, options.height, about)
    source = "given" if options.masks else "alpha" if shots[0].alpha else options.mask_model or "auto"
    facts = about | facts | {"masks": source}
    progress("writing")
    files = write.write_scene(model, work / "photos", masks, found, out)
    box = world.box_of(model, masks)
    left_out |= {s.name: (s.source, "its mask is empty") for s in shots if s.name not in masks}
    shots = [s for s in shots if s.name in masks]
    facts |= facts_of(model, shots, left_out, files, found, box)
    (out / "capture.json").write_text(json.dumps(facts, indent=1))
    page.write_page(out, model, box, facts)
    return out


def _photos(sources: dict[str, Path], work: Path, cache: Cache, options: Options, progress: Progress):
    """(sharp photographs of both states, {name: (source, reason)} of the others)."""
    shots, left_out = [], {}
    for state, source in sources.items():
        if not source.exists():
            raise UserError(f"{source}: there is no such folder of photographs, nor such a video")

        def make(state=state, source=source) -> dict:
            progress(f"{state}: copying photographs")
            shutil.rmtree(work / "photos" / state, ignore_errors=True)
            return {
                "shots": [
                    s.to_dict() for s in copy_photos(source, state, work / "photos", options.size, options.max_views)
                ]
            }

        depends = [_stamp(source), options.size, options.max_views]
        mine = [Shot(**s) for s in cache.get(f"photos_{state}", depends, make, progress)["shots"]]
        kept, reasons = drop_blurred(mine)
        left_out |= {s.name: (s.source, reasons[s.name]) for s in mine if s.name in reasons}
        shots += kept
    return shots, left_out


def _masks(shots: list[Shot], folder: Path, options: Options) -> Optional[dict[str, np.ndarray]]:
    """Masks that are there already, or None: to be made from 3D."""
    if options.masks is not None:
        return given_masks.folder_masks(shots, options.masks, options.ignore)
    return given_masks.alpha_masks(shots, folder)


def _keep(masks: dict[str, np.ndarray], folder: Path) -> None:
    """As PNGs that can be edited and given back with --masks."""
    import cv2

    for name, mask in masks.items():
        path = (folder / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), mask)


def _reconstructed(state: str, shots: list[Shot], work: Path, cache: Cache, careful: bool, progress: Progress) -> State:
    """A state alone: with quick settings, with careful ones where those place too few. Raises UserError where both
    do."""
    from p2gs.data.capture.sfm import default_effort

    total, result = len(shots), {"registered": 0, "models": 0}
    for effort in [True] if careful else [False, True]:
        name = f"{state}_careful" if effort else state
        job = {
            "images": str((work / "photos").resolve()),
            "groups": lens_groups(shots),
            "effort": default_effort(effort),
            "out": str((work / name).resolve()),
        }
        depends = [job, [(s.source, s.sharpness) for s in shots]]

        def make(job=job, name=name) -> dict:
            return run_job("reconstruct", job, work / name, lambda text: progress(f"{state}: {text}"))

        result = cache.get(f"sfm_{name}", depends, make, progress)
        if result["registered"] >= max(MIN_SHARE * total, MIN_REGISTERED):
            progress(f"{state}: {result['registered']} of {total} photographs placed, {result['error']:.2f} px")
            model = read_model(work / name / "model")
            d = np.load(work / name / "descriptors.npz")["descriptors"].astype(np.float32)
            return State(model, d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6))
    raise UserError(
        f"{Path(shots[0].source).parent}: only {result['registered']} of {total} photographs could be placed; "
        "take them closer together (a step to the side each), with the room in view, "
        "and lay newspapers or a patterned rug around the object"
    )


def _solved(shots: list[Shot], work: Path, cache: Cache, options: Options, progress: Progress):
    """(joint model, {corner: point id}, facts) by structure from motion."""
    states = [
        _reconstructed(s, [x for x in shots if x.name.startswith(s)], work, cache, options.careful, progress)
        for s in STATES
    ]
    progress("looking for the marker board")
    seen = marker_board.find_board([s.name for s in shots], work / "photos")
    found = hypotheses_of(*states, seen)
    facts = {"hypotheses": [h.to_dict() for h in found]}
    static = choose(found, options.static, Path(shots[0].source).parent)
    chosen: Hypothesis = found[static]
    facts["static"] = static
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

    joined = partial(join, *states, chosen.T, work / "joint", with_board, on_board, by_pixels, progress)
    # the name is what this stage is: what an earlier build kept had other numbers for the board's points
    sightings = [sorted((k, v.tolist()) for k, v in m.items()) for m in seen.values()]
    depends = ["placed by pixels", chosen.T.tolist(), sightings]

    def make() -> dict:
        model = joined(by_board=bool(chosen.board) and not chosen.wide)
        if chosen.board and chosen.wide and not link(model) < LINKED:
            model = joined(by_board=True)  # a few points that hardly moved passed for the room
        write_model(model, work / "joined")
        return {"corners": corners, "board_rms": board_rms}

    result = cache.get("joint", depends, make, progress)
    corners = {int(k): v for k, v in result["corners"].items()}
    if result.get("board_rms") is not None:  # before the board was held
        facts["board_rms_mm"] = round(1000 * result["board_rms"], 2)
    model = read_model(work / "joined")
    check_link(link(model), bool(chosen.board), Path(shots[0].source).parent)
    return model, corners, facts


def _check_arc(model: Model, state: str) -> None:
    """Raises UserError where a state's photographs are too few, or from one side alone."""
    mine = [p for p in model.photos.values() if is_end(p.name) == (state == "end")]
    few = UserError(
        f"state '{state}': only {len(mine)} photographs are placed surely, expected at least {MIN_REGISTERED}; "
        "take more, closer together, with the room in view"
    )
    if not mine:
        raise few
    (centre, _), up = model.centre(), frame.mean_up(model)
    away = np.array([p.position for p in mine]) - centre
    x = np.linalg.svd(up[None])[2][1]
    angles = np.sort(np.degrees(np.arctan2(away @ np.cross(up, x), away @ x)))
    arc = 360 - np.diff(np.append(angles, angles[0] + 360)).max()
    if arc < MIN_ARC:
        raise UserError(f"state '{state}': the photographs go only {arc:.0f} degrees around the object, expected at "
                        f"least {MIN_ARC:.0f}; "
                        "walk from one side of the front to the other, at two or three heights")  # fmt: skip
    if len(mine) < MIN_REGISTERED:
        raise few
