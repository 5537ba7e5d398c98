"""Pictures of the twin: both states, states between, part colours, joints drawn in, photographs beside; and videos."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Sequence

import numpy as np
import torch

from p2gs.gaussians.frame import object_to_input
from p2gs.gaussians.paint import draw, draw_joints, joint_text, part_coloured, to_image
from p2gs.gaussians.pose import pose
from p2gs.gaussians.views import best_camera, orbit
from p2gs.ops.palette import part_colour
from p2gs.types import ArticulatedObject, Camera, TwoStateScene, UserError

STATES = (0.0, 0.25, 0.5, 0.75, 1.0)


def chosen_camera(obj: ArticulatedObject, cameras: Sequence[Camera]) -> tuple[Camera, int]:
    """The camera for pictures and its index; without cameras one of an orbit (index -1). ``obj`` in the cameras'
    coordinates."""
    if cameras:
        index = best_camera(obj, cameras)
        return cameras[index], index
    ring = orbit(obj, 12)
    return ring[best_camera(obj, ring)], -1


def framed(
    obj: ArticulatedObject, camera: Camera, size: int, margin: float = 0.08
) -> tuple[Camera, tuple[int, int, int, int]]:
    """The camera cut to a window around the object in all states and scaled to ``size`` px on its longer side.

    Returns the camera and the window (x, y, width, height) in pixels of the given camera.
    """
    seen = torch.stack([draw(pose(obj, t), camera).alpha for t in (0.0, 0.5, 1.0)]).amax(0) > 0.1
    rows, cols = seen.any(1).nonzero()[:, 0], seen.any(0).nonzero()[:, 0]
    if not len(rows):
        return camera, (0, 0, camera.width, camera.height)
    y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1
    pad = int(math.ceil(margin * max(y1 - y0, x1 - x0)))
    x0, y0, x1, y1 = max(x0 - pad, 0), max(y0 - pad, 0), min(x1 + pad, camera.width), min(y1 + pad, camera.height)
    window = (x0, y0, x1 - x0, y1 - y0)
    zoom = size / max(window[2:])
    cut = camera.cropped(*window)
    return cut.scaled(max(2, round(cut.width * zoom / 2) * 2), max(2, round(cut.height * zoom / 2) * 2)), window


def render_plain(obj: ArticulatedObject, camera: Camera, t: float) -> np.ndarray:
    """The twin at state t over white, [H, W, 3] uint8."""
    return to_image(draw(pose(obj, t), camera).colour)


def render_parts(obj: ArticulatedObject, camera: Camera, t: float, joints: bool = True) -> np.ndarray:
    """The twin at state t in part colours over white, joints drawn in, uint8 [H, W, 3]."""
    out = draw(part_coloured(pose(obj, t), obj.part_ids), camera)
    image = to_image(out.colour)
    return draw_joints(image, obj, camera, t, out.expected_depth, out.alpha) if joints else image


def write_media(
    obj: ArticulatedObject, media_dir: Path, cameras: Sequence[Camera], photos=None, size: int = 512
) -> list[Path]:
    """All still pictures of a run. ``obj`` and ``cameras`` in the same coordinates.

    photos(state) -> (uint8 image, the camera it was taken with), or None. Writes {start,end}.png (plain),
    parts_{start,end}.png (part colours, joints), parts_t000.png ... parts_t100.png, states.png (those five in a row)
    and compare.png (photograph, render and parts for both states).
    """
    media_dir.mkdir(parents=True, exist_ok=True)
    base, _ = chosen_camera(obj, cameras)
    camera, _ = framed(obj, base, size)
    files: dict[str, np.ndarray] = {}
    for name, t in (("start", 0.0), ("end", 1.0)):
        files[f"{name}.png"] = render_plain(obj, camera, t)
        files[f"parts_{name}.png"] = render_parts(obj, camera, t)
    strip = []
    for t in STATES:
        image = render_parts(obj, camera, t, joints=False)
        files[f"parts_t{round(100 * t):03d}.png"] = image
        strip.append(captioned(image, f"t = {t:g}"))
    files["states.png"] = beside(strip)
    rows = [_compare_row(obj, state, camera, size, photos) for state in (0, 1)]
    files["compare.png"] = np.concatenate([*rows, legend(obj, rows[0].shape[1])])
    for name, image in files.items():
        save_png(media_dir / name, image)
    return [media_dir / name for name in files]


def _compare_row(obj, state: int, camera: Camera, size: int, photos) -> np.ndarray:
    """Photograph (where there is one), twin and parts of a state, all from the photograph's camera and as large as
    ``camera``."""
    t, name, cells = float(state), ("start", "end")[state], []
    shape = camera.width, camera.height + CAPTION
    if photos is not None:
        photo, taken = photos(state)
        camera, (x, y, w, h) = framed(obj, taken, size)
        cells.append(
            captioned(resize(photo[y : y + h, x : x + w], camera.width, camera.height), f"photograph ({name})")
        )
    cells.append(captioned(render_plain(obj, camera, t), f"twin ({name})"))
    cells.append(captioned(render_parts(obj, camera, t), f"parts and joints ({name})"))
    return beside([fit(c, *shape) for c in cells])


CAPTION, GAP = 26, 6


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """The image [H, W, 3] with a white line of text above it."""
    import cv2

    bar = np.full((CAPTION, image.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.concatenate([bar, image])


def beside(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images [H, W_i, 3] of one height in a row with white gaps."""
    gap = np.full((images[0].shape[0], GAP, 3), 255, np.uint8)
    cells = [images[0]]
    for image in images[1:]:
        cells += [gap, image]
    return np.concatenate(cells, axis=1)


def fit(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """An image [h, w, 3] shrunk or grown to fit, centred on white: [height, width, 3]."""
    scale = min(width / image.shape[1], height / image.shape[0])
    small = resize(image, max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    out = np.full((height, width, 3), 255, np.uint8)
    y, x = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    out[y : y + small.shape[0], x : x + small.shape[1]] = small
    return out


def legend(obj: ArticulatedObject, width: int) -> np.ndarray:
    """Part colours and joints as text, [h, width, 3]."""
    import cv2

    items = [(0, "static")] + [(p.id, joint_text(p.joint)) for p in obj.parts if p.joint is not None]
    per_row = max(1, width // 250)
    rows = math.ceil(len(items) / per_row)
    out = np.full((28 * rows + 8, width, 3), 255, np.uint8)
    for i, (k, text) in enumerate(items):
        x, y = 10 + (i % per_row) * 250, 8 + 28 * (i // per_row)
        cv2.rectangle(out, (x, y), (x + 16, y + 16), tuple(int(255 * c) for c in part_colour(k)), -1)
        cv2.putText(out, f"{k}  {text}", (x + 24, y + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA)
    return out


def resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """An image [h, w, 3] as [height, width, 3]."""
    import cv2

    shrink = width < image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_CUBIC)


def save_png(path: Path, image: np.ndarray) -> None:
    """[H, W, 3] uint8 RGB."""
    import cv2

    if not cv2.imwrite(str(path), np.ascontiguousarray(image[..., ::-1])):
        raise UserError(f"cannot write {path}")


def scene_photos(scene: TwoStateScene, obj: ArticulatedObject):
    """For ``write_media``: a function that gives the best-chosen photograph of a state with its camera, in input
    coordinates."""
    from p2gs.gaussians.views import scene_cameras

    obj = object_to_input(obj)
    named = scene_cameras(scene)

    def of(state: int):
        mine = [i for i, c in enumerate(named) if c.state == state]
        index = mine[best_camera(obj, [named[i].camera for i in mine])]
        view = scene.views[index]
        a = view.alpha.float().div(255)[..., None]
        return (view.image.float() * a + 255 * (1 - a)).round().to(torch.uint8).numpy(), named[index].camera

    return of
