"""``p2gs data capture``: the stages in their order, each kept in ``SCENE/.capture`` and skipped when what it read is
unchanged."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.capture import board as marker_board
from p2gs.data.capture import frame, gains, given_masks, page, poses, world, write
from p2gs.data.capture.auto_masks import auto_masks
from p2gs.data.capture.cache import Cache, Progress
from p2gs.data.capture.facts import facts_of
from p2gs.data.capture.joint import is_end
from p2gs.data.capture.kept_masks import check_unedited, kept_masks
from p2gs.data.capture.model import Model
from p2gs.data.capture.photos import Shot, copy_photos, drop_blurred
from p2gs.data.capture.segmenters import Segmenter, segmenter_of
from p2gs.data.capture.solve import solved, told
from p2gs.data.capture.static import check_joint_support, loose_poses
from p2gs.data.frames import STATES
from p2gs.types import UserError

MIN_ARC = 60.0  # degrees around the object


@dataclass(frozen=True)
class Options:
    """masks: folder of masks.  ignore: nerfstudio's meaning of them.  poses: COLMAP model or transforms.json.  static:
    number of the hypothesis to take.  height: metres of the object.  length: metres, and x0 y0 z0 x1 y1 z1
    of two places so far apart, as capture.html has them.  box: x0 y0 z0 x1 y1 z1 that the object is within, as
    capture.html has it.  mask_model: draws masks' edges (``segmenters``).  max_views: photographs a state.  size:
    long edge in pixels."""

    masks: Optional[Path] = None
    ignore: bool = False
    poses: Optional[Path] = None
    static: Optional[int] = None
    height: Optional[float] = None
    length: Optional[tuple[float, ...]] = None
    box: Optional[tuple[float, ...]] = None
    mask_model: Optional[str] = None
    max_views: int = 60
    size: int = 1600
    careful: bool = False


def _stamp(source: Path) -> list:
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    return [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files if p.is_file()]


def capture_scene(start: Path, end: Path, out: Path, options: Options, progress: Progress = lambda text: None) -> Path:
    """Write the scene of two states' photographs; returns its folder. Raises UserError where the photographs cannot
    carry it."""
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not (out / ".capture").is_dir()):
        raise UserError(f"{out}: is there already and was not made by p2gs data capture; expected a new folder")
    if start.exists() and end.exists() and start.samefile(end):
        raise UserError(f"{start}: is given for both states; expected the object in another joint state in each")
    segmenter = None if options.mask_model is None else segmenter_of(options.mask_model)  # before minutes of work
    cache = Cache(out / ".capture")
    if options.masks is None:
        check_unedited(cache, out / "masks")
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
        model, corners, facts = solved(shots, work, cache, options.careful, options.static, progress)
    for state in STATES:
        _check_arc(model, state)
    progress("exposure and white balance")
    found = gains.photo_gains(model, work / "photos")
    model, about = world.oriented(model, corners)
    if masks is None:
        masks = _made_masks(model, about, shots, found, segmenter, options, out, cache, progress)
    if about["scale"]["source"] == "board" and (options.height or options.length):
        progress("warning: the marker board says how long a metre is; what was given is left aside")
    metres = world.given_length(options.length, about, out)
    model = world.scaled(model, masks, options.height, about, metres)
    source = "given" if options.masks else "alpha" if shots[0].alpha else options.mask_model or "auto"
    facts = about | facts | {"masks": source}
    progress("writing")
    files = write.write_scene(model, work / "photos", masks, found, out)
    box = world.box_of(model, masks)
    if source in ("given", "alpha"):
        _warn_of_odd(world.odd_masks(model, masks, box), shots, progress)
    left_out |= _unused(shots, masks, model)
    shots = [s for s in shots if s.name in masks]
    facts |= facts_of(model, shots, left_out, files, found, box)
    (out / "capture.json").write_text(json.dumps(facts, indent=1))
    page.write_page(out, model, masks, box, facts)
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

        depends = ["edges measured", _stamp(source), options.size, options.max_views]

        def whole(result: dict) -> bool:
            files = [file for s in result["shots"] for file in (s["name"], s["alpha"]) if file]
            return all((work / "photos" / file).is_file() for file in files)

        result = cache.get(f"photos_{state}", depends, make, progress, whole)
        mine = [Shot(**s) for s in result["shots"]]
        kept, reasons = drop_blurred(mine)
        left_out |= {s.name: (s.source, reasons[s.name]) for s in mine if s.name in reasons}
        shots += kept
    return shots, left_out


def _masks(shots: list[Shot], folder: Path, options: Options) -> Optional[dict[str, np.ndarray]]:
    """Masks that are there already, or None: to be made from 3D."""
    if options.masks is not None:
        return given_masks.folder_masks(shots, options.masks, options.ignore)
    return given_masks.alpha_masks(shots, folder)


def _made_masks(
    model: Model,
    about: dict,
    shots: list[Shot],
    found: dict[int, np.ndarray],
    segmenter: Optional[Segmenter],
    options: Options,
    out: Path,
    cache: Cache,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Masks from 3D, those of the last run where nothing that they depend on has changed."""
    if options.poses is not None:
        world.check_floor(about, options.poses)
    within = world.given_box(options.box, about, out)
    corners = None if within is None else within.tolist()
    depends = [_content(model, found), corners, _about_model(options.mask_model), told(shots)]

    def make() -> dict[str, np.ndarray]:
        return auto_masks(model, cache.folder / "photos", found, progress, within, segmenter)

    return kept_masks(cache, out / "masks", shots, depends, make, progress)


def _unused(shots: list[Shot], masks: dict[str, np.ndarray], model: Model) -> dict[str, tuple[str, str]]:
    """{name: (source, reason)} of the photographs that have no mask."""
    placed = {p.name for p in model.photos.values()}
    reasons = {True: "its mask is empty", False: "could not be placed among the others"}
    return {s.name: (s.source, reasons[s.name in placed]) for s in shots if s.name not in masks}


def _warn_of_odd(odd: dict[str, float], shots: list[Shot], progress: Progress) -> None:
    """A line for each photograph whose given mask shows another thing than the others' do."""
    for shot in (s for s in shots if s.name in odd):
        share = 100 * odd[shot.name]
        progress(f"warning: {shot.source}: {share:.0f} % of its mask is what the other masks show; look at contact.jpg")


def _about_model(given: Optional[str]) -> list:
    """What says that a mask model is the same: its name, and the size and time of each file in it."""
    return [] if given is None else [given, *(_stamp(Path(p)) for p in given.split(":") if Path(p).is_file())]


def _content(model: Model, found: dict[int, np.ndarray]) -> str:
    """A digest of cameras, points and gains."""
    digest = hashlib.sha256()
    for key, photo in model.photos.items():
        lens = model.lenses[photo.lens]
        digest.update(f"{key} {photo.name} {lens.model} {lens.width} {lens.height}".encode())
        for array in (photo.viewmat, photo.point, lens.params, found.get(key, np.zeros(3))):
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(np.ascontiguousarray(model.xyz).tobytes())
    return digest.hexdigest()


def _check_arc(model: Model, state: str) -> None:
    """Raises UserError where a state's photographs are too few, or from one side alone."""
    mine = [p for p in model.photos.values() if is_end(p.name) == (state == "end")]
    few = UserError(
        f"state '{state}': only {len(mine)} photographs are placed surely, expected at least {poses.MIN_REGISTERED}; "
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
    if len(mine) < poses.MIN_REGISTERED:
        raise few
