"""The picture of docs/data.md: what good and bad captures look like, in rooms of ``capture_room.py``.

python bench/capture_picture.py docs/capture.jpg
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from capture_room import Mosaic, Room, board_sheet, make_room

from p2gs.data.generated.raytrace import Shadow, render
from p2gs.data.generated.shapes import box
from p2gs.data.generated.synthetic import look_at
from p2gs.data.generated.textures import Texture

TILE = (300, 225)  # pixels
SEED = 3  # a door
GOOD, BAD = (60, 140, 40), (40, 40, 190)  # BGR of the frames


def shot(room: Room, end: bool, eye, target, focal: float = 250.0) -> np.ndarray:
    """[225, 300, 3] uint8 RGB."""
    primitives, parts = room.posed(end)
    K = np.array([[focal, 0, TILE[0] / 2], [0, focal, TILE[1] / 2], [0, 0, 1]])
    view = look_at(np.array(eye, float), np.array(target, float))
    return render(primitives, parts, view, K, *TILE, samples=3, shadow=Shadow(primitives)).image


def framed(image: np.ndarray, colour, text: str) -> np.ndarray:
    """The tile in BGR with a frame and a line of text under it."""
    out = cv2.copyMakeBorder(np.ascontiguousarray(image[..., ::-1]), 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=colour)
    out = cv2.copyMakeBorder(out, 0, 22, 0, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(out, text, (4, out.shape[0] - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
    return out


def furnished(rug: bool) -> Room:
    """A cupboard with a door of wood, with or without a rug and the board before it."""
    room = make_room("plain", SEED)
    front = replace(room.front, texture=Texture("wood", (0.62, 0.42, 0.25), (0.42, 0.26, 0.14), 0.25, 3))
    still = list(room.still)
    if rug:
        still.append(box((-0.7, -1.3, 0), (1.3, 1.3, 0.0005), Mosaic(7, (0.06, 0.18))))
        still.append(board_sheet(0.8, 0.6))
    return replace(room, front=front, still=still)


def picture() -> np.ndarray:
    """[H, W, 3] uint8 BGR: a row of good photographs and one of bad ones."""
    plain, rich = (furnished(rug) for rug in (False, True))
    middle = (0.1, 0.0, 0.45)
    blurred = cv2.filter2D(shot(rich, False, (2.1, 0.5, 1.0), middle), -1, np.full((1, 15), 1 / 15, np.float32))
    good = [
        (shot(rich, False, (2.3, 0.4, 1.0), middle), "shut: object, floor, wall and board"),
        (shot(rich, False, (2.1, 1.0, 1.0), middle), "a step to the side"),
        (shot(rich, True, (2.2, 0.4, 1.0), middle), "open: nothing else has moved"),
        (shot(rich, True, (1.5, 0.6, 1.7), middle), "from above, too"),
    ]
    bad = [
        (shot(rich, False, (0.95, 0.1, 0.6), (0, 0, 0.5)), "too near: nothing of the room"),
        (shot(plain, False, (2.2, 0.4, 1.0), middle), "plain floor and walls: lay a rug"),
        (blurred, "blurred"),
        (shot(rich, False, (0.3, 2.6, 1.0), middle), "from the side: no front"),
    ]
    rows = [np.hstack([framed(i, c, t) for i, t in tiles]) for tiles, c in ((good, GOOD), (bad, BAD))]
    return np.vstack(rows)


if __name__ == "__main__":
    cv2.imwrite(str(Path(sys.argv[1])), picture(), [cv2.IMWRITE_JPEG_QUALITY, 85])
