"""Poses that somebody has already: a COLMAP model or nerfstudio's ``transforms.json``, brought to the copied
photographs.

COLMAP's files are what RealityScan, Metashape, VGGT and others export; ``transforms.json`` is what ns-process-data
makes of Polycam, Record3D, KIRI and others. No pycolmap is needed.
"""

from __future__ import annotations

import json
from collections.abc import Container
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs.data.capture.colmap_io import find_model, read_model
from p2gs.data.capture.model import ONE_FOCAL, Lens, Model, Photo
from p2gs.data.capture.photos import Shot
from p2gs.data.frames import MAX_COORDINATE, opengl_pose, pose_matrix
from p2gs.data.report import Report
from p2gs.types import UserError, short

KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "distortion_params")
MIN_SHARE = 0.9  # of a state's photographs must be placed, by poses that are brought or solved
MIN_REGISTERED = 8  # photographs of a state, likewise
NAMED = 3  # photographs without a pose that a refusal names
MAX_POINTS = 100_000  # of a cloud, drawn at random: a floor shows in far fewer, and is sought among all 600 times
GREY = 128  # of 255: points that nobody observes have no colour that anything looks at


def read_poses(path: Path) -> Model:
    """The model at a path: a ``transforms.json``, a folder that holds one, two in ``start`` and ``end``, or a COLMAP
    model."""
    if not path.exists():
        raise UserError(f"{path}: there are no poses here; expected a COLMAP model's folder or a transforms.json")
    if path.is_file():
        return read_transforms([(path, "")])
    folder = find_model(path)
    if folder is not None:
        return read_model(folder)
    if (path / "transforms.json").is_file():
        return read_transforms([(path / "transforms.json", "")])
    both = [(path / state / "transforms.json", f"{state}/") for state in ("start", "end")]
    if all(file.is_file() for file, _ in both):
        return read_transforms(both)
    raise UserError(f"{path}: holds neither cameras.bin or cameras.txt (COLMAP) nor a transforms.json (nerfstudio)")


def _frame_lens(meta: dict, frame: dict, where: str) -> Lens:
    both = {**{k: meta[k] for k in KEYS if k in meta}, **frame}
    missing = [k for k in ("fl_x", "cx", "cy", "w", "h") if k not in both]
    if missing:
        raise UserError(
            f"{where}: has no {', '.join(missing)}; expected fl_x, fl_y, cx, cy, w, h of the file or of each frame"
        )
    kind = meta.get("camera_model", "OPENCV")
    focal = [float(both["fl_x"]), float(both.get("fl_y", both["fl_x"])), float(both["cx"]), float(both["cy"])]
    k = {name: float(both.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
    if "distortion_params" in both:
        k.update(zip(("k1", "k2", "k3", "k4", "p1", "p2"), map(float, both["distortion_params"]), strict=False))
    size = (int(both["w"]), int(both["h"]))
    if min(*size, focal[0], focal[1]) <= 0 or not np.isfinite([*focal, *k.values()]).all():
        raise ValueError(f"w, h {size}, focal lengths and centre {focal}")
    if kind == "OPENCV_FISHEYE":
        return Lens(kind, *size, np.array([*focal, k["k1"], k["k2"], k["k3"], k["k4"]]))
    if kind in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        if k["k3"] or k["k4"]:
            return Lens(
                "FULL_OPENCV", *size, np.array([*focal, k["k1"], k["k2"], k["p1"], k["p2"], k["k3"], k["k4"], 0, 0])
            )
        return Lens("OPENCV", *size, np.array([*focal, k["k1"], k["k2"], k["p1"], k["p2"]]))
    raise UserError(f"{where}: camera_model {kind} is not known; known: OPENCV, PINHOLE, OPENCV_FISHEYE")


def _unapplied(meta: dict, where: str) -> np.ndarray:
    """[4, 4] that takes the file's coordinates back to those of its reconstruction (undoes ``applied_transform``)."""
    T = np.eye(4)
    given = meta.get("applied_transform", T)
    try:
        T[:3] = pose_matrix(given)[:3]
    except ValueError:
        T[:3] = 0
    if not (np.abs(T) < MAX_COORDINATE).all() or abs(np.linalg.det(T[:3, :3])) < 1e-9:
        raise UserError(f"{where}: applied_transform is not a 3x4 matrix that can be undone")
    return np.linalg.inv(T)


def c2w_of(given, where: str) -> np.ndarray:
    """[4, 4] of a frame's transform_matrix. Raises UserError for what is no pose."""
    try:
        c2w = pose_matrix(given)
    except ValueError as err:
        raise UserError(f"{where}: camera pose is not a 4x4 matrix of numbers") from err
    if not (np.abs(c2w) < MAX_COORDINATE).all() or abs(np.linalg.det(c2w[:3, :3])) < 1e-9:
        raise UserError(f"{where}: camera pose has no rotation, or values that are not finite")
    return c2w


def read_transforms(files: list[tuple[Path, str]]) -> Model:
    """Model of nerfstudio files, each with a prefix for its photographs' names. All must share one frame. Its points
    are those of ``ply_file_path``, which no photograph observes; without such a file it has none.

    Raises UserError where a file lacks something, naming it.
    """
    lenses: dict[int, Lens] = {}
    photos: dict[int, Photo] = {}
    known: dict[tuple, int] = {}
    clouds = [np.zeros((0, 3))]
    for path, prefix in files:
        meta = _meta(path)
        undo = _unapplied(meta, str(path))
        for i, frame in enumerate(meta["frames"]):
            where = f"{path}: frame {i}"
            if (
                not isinstance(frame, dict)
                or not isinstance(frame.get("file_path"), str)
                or "transform_matrix" not in frame
            ):
                raise UserError(f"{where} needs 'file_path' and 'transform_matrix'")
            try:
                lens = _frame_lens(meta, frame, where)
            except (TypeError, ValueError, OverflowError) as err:
                raise UserError(
                    f"{where}: its lens cannot be read ({err}); expected numbers fl_x, fl_y, cx, cy, w, h"
                ) from err
            key = known.setdefault((lens.model, lens.width, lens.height, lens.params.tobytes()), len(known) + 1)
            lenses[key] = lens
            report = Report()
            viewmat = opengl_pose(_rigid(undo @ c2w_of(frame["transform_matrix"], where)), where, report)
            if viewmat is None:
                raise UserError(report.findings[0].message)
            photos[len(photos) + 1] = Photo(prefix + frame["file_path"], key, viewmat)
        if meta.get("ply_file_path") is not None:
            clouds.append(_cloud(path, meta["ply_file_path"]) @ undo[:3, :3].T + undo[:3, 3])
    xyz = np.concatenate(clouds)
    return Model(lenses, photos, np.arange(1, len(xyz) + 1), xyz, np.full((len(xyz), 3), GREY, np.uint8))


def _meta(path: Path) -> dict:
    """What a transforms.json holds. Raises UserError for one without frames."""
    try:
        meta = json.loads(path.read_text())
    except (ValueError, RecursionError, OSError) as err:
        raise UserError(f"{path}: is not valid JSON ({err})") from err
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise UserError(f"{path}: has no list 'frames'")
    return meta


def _cloud(transforms: Path, name) -> np.ndarray:
    """[N, 3] points of the PLY file that a transforms.json names, in that file's frame; at most ``MAX_POINTS``."""
    import trimesh

    path = transforms.parent / name if isinstance(name, str) else transforms
    if path == transforms or not path.is_file():
        raise UserError(
            f"{transforms}: its ply_file_path {short(name)} is no file beside it; put the points there, or take the "
            "entry out"
        )
    try:
        xyz = np.asarray(getattr(trimesh.load(path, file_type="ply", process=False), "vertices", []), float)
    except Exception as err:  # trimesh has no error of its own for a bad file
        raise UserError(f"{path}: cannot be read as PLY ({err})") from err
    xyz = xyz.reshape(-1, 3)
    xyz = xyz[(np.abs(xyz) < MAX_COORDINATE).all(1)]
    if len(xyz) > MAX_POINTS:
        xyz = xyz[np.random.default_rng(0).choice(len(xyz), MAX_POINTS, replace=False)]
    return xyz


def _rigid(c2w: np.ndarray) -> np.ndarray:
    """The pose with the scale of an applied transform taken out of its rotation."""
    out = c2w.copy()
    out[:3, :3] /= np.cbrt(abs(np.linalg.det(c2w[:3, :3])))
    return out


def state_of(name: str, start: Path, end: Path, in_start: bool, in_end: bool) -> str | None:
    """'start' or 'end' for a photograph's name, by the folder that has such a file, else by the folders in its name;
    None for neither."""
    if in_start != in_end:
        return "start" if in_start else "end"
    if not in_start:
        return None
    folders = PurePosixPath(name).parts[:-1]
    for state, folder in (("start", start), ("end", end)):
        if state in folders or folder.name in folders:
            return state
    raise UserError(
        f"poses: {name} may belong to either state; put the photographs into folders start/ and end/ before solving "
        "the poses"
    )


def onto_copies(model: Model, shots: list[Shot], start: Path, end: Path) -> Model:
    """The model of the photographs that were copied: its images named, its lenses scaled to the copies' size. Points
    that only other photographs observe are left out; those that none does stay, for they show the floor.

    Raises UserError for a video, where too few photographs of a state have a pose, one has two, or sizes do not belong
    together.
    """
    for source in (start, end):
        if source.is_file():
            raise UserError(
                f"{source}: is a video, whose frames poses cannot name; expected a folder of the frames that the poses "
                "were solved for"
            )
    by_file = {(s.name.split("/")[0], Path(s.source).name): s for s in shots}
    photos: dict[int, Photo] = {}
    lenses: dict[int, Lens] = {}
    known: dict[tuple, int] = {}
    placed: dict[str, str] = {}
    for key, photo in model.photos.items():
        file = PurePosixPath(photo.name).name
        # the folders and not the copies: a blurred photograph's pose is not that of its namesake
        state = state_of(photo.name, start, end, (start / file).is_file(), (end / file).is_file())
        if state is None or (state, file) not in by_file:
            continue
        shot, lens = by_file[state, file], model.lenses[photo.lens]
        if shot.name in placed:
            raise UserError(
                f"poses: {placed[shot.name]} and {photo.name} both name {shot.source}; expected one pose of each "
                "photograph"
            )
        # copies of one lens may have several sizes
        number = known.setdefault((photo.lens, state, shot.width, shot.height), len(known) + 1)
        lenses[number] = _scaled(lens, shot)
        xy = photo.xy * (shot.width / lens.width)
        photos[key] = replace(photo, name=shot.name, lens=number, xy=xy)
        placed[shot.name] = photo.name
    for state, folder in (("start", start), ("end", end)):
        _check_share([s for s in shots if s.name.split("/")[0] == state], placed, folder)
    observed, used = _observed(model.photos), _observed(photos)
    keep = np.isin(model.ids, used) | ~np.isin(model.ids, observed)
    return Model(lenses, photos, model.ids[keep], model.xyz[keep], model.rgb[keep])


def _scaled(lens: Lens, shot: Shot) -> Lens:
    """The lens of a photograph's copy. Raises UserError where the pose was solved for a picture of another shape."""
    factor = shot.width / lens.width
    if abs(lens.height * factor - shot.height) > 2:
        raise UserError(
            f"{shot.source}: is {shot.width}x{shot.height} upright, its pose is for {lens.width}x{lens.height} pixels; "
            "solve the poses with upright photographs"
        )
    params = lens.params.copy()
    params[: 3 if lens.model in ONE_FOCAL else 4] *= factor
    return Lens(lens.model, shot.width, shot.height, params)


def _observed(photos: dict[int, Photo]) -> np.ndarray:
    """Ids of the points that photographs observe."""
    return np.unique(np.concatenate([p.point[p.point >= 0] for p in photos.values()]))


def some_of(names: list[str]) -> str:
    """The first few of photographs' names, for a sentence."""
    return ", ".join(names[:NAMED]) + (" and others" if len(names) > NAMED else "")


def _check_share(shots: list[Shot], placed: Container[str], folder: Path) -> None:
    """Raises UserError where too few of a state's photographs have a pose, as for poses that are solved here."""
    missing = [Path(s.source).name for s in shots if s.name not in placed]
    count = len(shots) - len(missing)
    if count < 2:
        raise UserError(f"{folder}: the poses name none or only one of its photographs; expected the same file names")
    if count < MIN_SHARE * len(shots):
        raise UserError(
            f"{folder}: the poses name only {count} of its {len(shots)} photographs, not {some_of(missing)}; "
            f"expected at least {100 * MIN_SHARE:.0f} %: take those without a pose out of the folder, or solve the "
            "poses with all of them"
        )
    if count < MIN_REGISTERED:
        raise UserError(
            f"{folder}: the poses name {count} of its photographs, expected at least {MIN_REGISTERED}; take more, and "
            "solve the poses with them"
        )
