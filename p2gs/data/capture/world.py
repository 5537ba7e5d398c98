"""The joint model brought into the scene's world: up, the floor at 0 (where nothing shows it, the object's lowest
point), metres where something says how long they are, and the object's box."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.capture import board as marker_board
from p2gs.data.capture import frame, write
from p2gs.data.capture.joint import is_end
from p2gs.data.capture.model import Model
from p2gs.types import Camera, UserError

UNKNOWN = "unknown"  # the floor: nothing says where it is


def oriented(model: Model, corners: dict[int, int]) -> tuple[Model, dict]:
    """The model with z up, the floor at 0 (``UNKNOWN``: what the cameras look at) and, where there is a board, in
    metres; what was used for it, as capture.json has it: scale, up and floor (board, floor plane, lowest points or
    ``UNKNOWN``)."""
    floor, pose = frame.floor_of(model), marker_board.board_pose(model, corners)
    metres, source, about = 1.0, "object diagonal", {}
    if pose is not None:
        T, rms = pose
        metres, source = 1 / float(np.cbrt(np.linalg.det(T[:3, :3]))), "board"
        normal = T[:3, 2] * metres
        normal = normal * np.sign(normal @ frame.mean_up(model))
        # two measures of one floor: the larger plane is better
        if normal @ floor.normal < np.cos(np.radians(5)) or floor.source == "cameras":
            floor = frame.Floor(normal, float(normal @ T[:3, 3]), "board")
        about["board_rms_mm"] = round(1000 * rms, 2)
    about |= {"scale": {"source": source}, "up": floor.source, "floor": floor.source}
    if floor.source == "cameras":
        about["floor"] = UNKNOWN if floor.height is None else "lowest points"
    return model.moved(frame.to_world(floor, model, metres)), about


def check_floor(about: dict, poses: Path) -> None:
    """Raises UserError where masks are to come from 3D and nothing says where the floor is, which they cut the object
    off at. about: of ``oriented``.  poses: where the model is from."""
    if about["floor"] == UNKNOWN:
        raise UserError(
            f"{poses}: has no points, so nothing says where the floor is that automatic masks end at; give --masks "
            "DIR, or poses with points (a COLMAP model, or a transforms.json with ply_file_path)"
        )


def given_box(box: Optional[tuple[float, ...]], about: dict, out: Path) -> Optional[np.ndarray]:
    """[2, 3] corners of the option ``--box`` in the model's units before it is scaled. Raises UserError for a box
    without room in it, and where no earlier run says how long a unit is."""
    if box is None:
        return None
    corners = np.array(box, float).reshape(2, 3)
    if not (corners[0] < corners[1]).all():
        given = " ".join(f"{x:g}" for x in box)
        raise UserError(f"--box {given}: expected x0 y0 z0 x1 y1 z1, each first below its second")
    return corners / _unit_of("--box", box, about, out)


def given_length(length: Optional[tuple[float, ...]], about: dict, out: Path) -> Optional[float]:
    """Metres per unit of the model before it is scaled, by the option ``--length``: metres, and two places of
    capture.html that are so far apart. Raises UserError for one place given twice, and where no earlier run says how
    long a unit is."""
    if length is None:
        return None
    ends = np.array(length[1:], float).reshape(2, 3)
    apart = float(np.linalg.norm(ends[1] - ends[0]))
    if not 0 < apart < np.inf:
        raise UserError("--length: both ends are one place; expected M x0 y0 z0 x1 y1 z1, two places M metres apart")
    return length[0] * _unit_of("--length", length, about, out) / apart


def _unit_of(option: str, given: tuple[float, ...], about: dict, out: Path) -> float:
    """Units of the capture.html that the numbers of an option were read off, over those of the model: kept with the
    numbers, for with them the scene and that page get another unit, and the same command means the same again."""
    if about["scale"]["source"] == "board":
        return 1.0
    path, before = out / ".capture" / "units.json", out / "capture.json"
    try:
        kept = dict(json.loads(path.read_text()))
    except (FileNotFoundError, ValueError, TypeError):  # none was given before, or it was cut off
        kept = {}
    if option in kept and kept[option]["given"] == list(given):
        return float(kept[option]["unit"])
    if not before.is_file():
        raise UserError(
            f"{option}: without a marker board its units are those of {out / 'capture.html'}, which is not there yet; "
            f"run without {option} first"
        )
    unit = float(json.loads(before.read_text())["scale"].get("factor", 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(kept | {option: {"given": list(given), "unit": unit}}))
    return unit


def scaled(
    model: Model,
    masks: dict[str, np.ndarray],
    height: Optional[float],
    about: dict,
    metres: Optional[float] = None,
) -> Model:
    """The model with the object's height [m], or by ``metres`` per unit, or else its diagonal of 1, where no board gave
    metres, and with the object's lowest point at 0 where the floor is not known; notes it in ``about`` (of
    ``oriented``)."""
    scale, known = about["scale"], about["floor"] != UNKNOWN
    if scale["source"] != "board":
        box = box_of(model, masks, known)
        bottom = 0.0 if known else float(box[0, 2])
        factor = 1 / float(np.linalg.norm(box[1] - box[0]))
        if height is not None:
            factor, scale["source"] = height / (float(box[1, 2]) - bottom), "height"
        if metres is not None:
            factor, scale["source"] = metres, "length"
        T = np.diag([factor, factor, factor, 1.0])
        T[2, 3] = -factor * bottom
        model, scale["factor"] = model.moved(T), factor
    scale["metric"] = scale["source"] != "object diagonal"
    return model


def box_of(model: Model, masks: dict[str, np.ndarray], floor: bool = True) -> np.ndarray:
    """[2, 3] corners of the object by its masks, in the model's coordinates. floor: nothing lies below z = 0.

    Raises UserError where the object lies below the floor, or the masks show no common object.
    """
    import torch

    from p2gs.data.box import object_box
    from p2gs.types import View

    views = [
        View(name, int(is_end(name)), "train", camera, torch.empty(0), torch.from_numpy(alpha))
        for name, (camera, alpha) in undistorted(model, masks).items()
    ]
    box = object_box(views).double().numpy()
    if not floor:
        return box
    if box[1, 2] <= 0:
        raise UserError(
            "the masks show the object below the floor that the points show; expected masks of what stands on it, and "
            "poses of these photographs"
        )
    box[0, 2] = max(box[0, 2], 0.0)  # the hull of photographs from above goes on below the floor
    return box


def undistorted(model: Model, masks: dict[str, np.ndarray]) -> dict[str, tuple[Camera, np.ndarray]]:
    """Each mask [H, W] uint8 as a pinhole camera would have it, and that camera, by photograph's name."""
    import cv2
    import torch

    out, pinholes = {}, {key: write.pinhole_of(lens) for key, lens in model.lenses.items()}
    for photo in (p for p in model.photos.values() if p.name in masks):
        lens, pinhole = model.lenses[photo.lens], pinholes[photo.lens]
        alpha = cv2.remap(masks[photo.name], pinhole.maps[0], pinhole.maps[1], cv2.INTER_NEAREST)
        viewmat, K = torch.tensor(photo.viewmat).float(), torch.tensor(pinhole.K).float()
        out[photo.name] = Camera(viewmat, K, lens.width, lens.height), alpha
    return out


def odd_masks(model: Model, masks: dict[str, np.ndarray], box: np.ndarray) -> dict[str, float]:
    """Photographs whose mask shows another thing than the others of their state do, and the share that it has in common
    with what those show (``hull.agreement``).  box: [2, 3], the object's."""
    import cv2

    from p2gs.data.capture.auto_masks import ALIKE, COARSE
    from p2gs.data.capture.hull import agreement

    outlines, odd = {}, {}
    for name, (camera, alpha) in undistorted(model, masks).items():
        factor = min(1.0, COARSE / max(camera.width, camera.height))
        size = (round(camera.width * factor), round(camera.height * factor))
        outlines[name] = camera.scaled(*size), cv2.resize(alpha, size, interpolation=cv2.INTER_AREA) > 127
    for end in (False, True):
        mine = {name: outline for name, outline in outlines.items() if is_end(name) == end}
        shares = agreement(list(mine.values()), box)
        odd |= {name: share for name, share in zip(mine, shares, strict=True) if share < ALIKE}
    return odd
