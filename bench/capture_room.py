"""A room with a cupboard in two states, photographed as with a phone, its cameras known exactly.

    python bench/capture_room.py OUT --kind plain | textured | board [--seed 0] [--photos 24]

Writes OUT/start and OUT/end (JPEG, EXIF focal length), OUT/masks and OUT/gt (cameras.json, trans.json, the base's
mesh), in metres, z up, as ``p2gs test RUN --truth OUT/gt`` reads them. The cupboard's front is textured and moves: a
door that turns or a drawer that comes out. In a plain room it is nearly all that can be matched, and a reconstruction
that hangs the open state on it is wrong. "board" is a plain room with the printed marker board on the floor.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs.data.capture.board import write_board
from p2gs.data.generated.raytrace import Shadow, render
from p2gs.data.generated.shapes import Primitive, box
from p2gs.data.generated.synthetic import look_at
from p2gs.data.generated.textures import Texture

KINDS = ("plain", "textured", "board")
WIDTH, HEIGHT, FOCAL = 720, 540, 600.0  # pixels
LENS = (-0.045, 0.012)  # k1, k2
SHEET = (0.297, 0.210)  # metres, the printed page
STATES = ("start", "end")


@dataclass(frozen=True)
class Mosaic:
    """Cells of random colours at several sizes (metres), which SIFT finds everywhere and takes for nothing else."""

    seed: int
    cells: tuple[float, ...] = (0.02, 0.07, 0.24)

    def at(self, p: np.ndarray) -> np.ndarray:
        """[N, 3] float32 colours at local points p [N, 3]."""
        palette = np.random.default_rng(self.seed).random((4096, 3), dtype=np.float32)
        out = np.zeros((len(p), 3), np.float32)
        for k, cell in enumerate(self.cells):
            i = np.floor(p / cell + 0.37).astype(np.int64) + 1000
            out += palette[(i[:, 0] * 73856093 ^ i[:, 1] * 19349663 ^ i[:, 2] * 83492791 ^ k * 7919) % 4096]
        return out / len(self.cells)


@dataclass(frozen=True)
class Sheet:
    """A picture [H, W, 3] float32 on the upper side of a box of ``size`` (metres), its upper edge towards +y."""

    picture: np.ndarray
    size: tuple[float, float]

    def at(self, p: np.ndarray) -> np.ndarray:
        h, w = self.picture.shape[:2]
        x = np.clip((p[:, 0] / self.size[0] + 0.5) * w, 0, w - 1).astype(int)
        y = np.clip((0.5 - p[:, 1] / self.size[1]) * h, 0, h - 1).astype(int)
        return self.picture[y, x]


@dataclass(frozen=True)
class Room:
    """still: what does not move, the cupboard's body first.  front: what moves.  motion: [4, 4] start -> end.  joint:
    the layout's entry of trans_info."""

    still: list[Primitive]
    front: Primitive
    motion: np.ndarray
    joint: dict

    def posed(self, end: bool) -> tuple[list[Primitive], list[int]]:
        """Primitives of a state and which of them are the object's (0) or not (1)."""
        front = self.front.moved(self.motion) if end else self.front
        return [self.still[0], front, *self.still[1:]], [0, 0] + [1] * (len(self.still) - 1)


def plain(colour) -> Texture:
    return Texture("noise", tuple(colour), tuple(0.985 * np.array(colour)), 0.9, 5)


def board_sheet(x: float, y: float) -> Primitive:
    """The printed board flat on the floor."""
    import cv2

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "board.png"
        write_board(path)
        picture = cv2.resize(cv2.imread(str(path)), (1188, 840), interpolation=cv2.INTER_AREA)
    texture = Sheet(picture[..., ::-1].astype(np.float32) / 255, SHEET)
    half = np.array(SHEET) / 2
    return box((x - half[0], y - half[1], 0), (x + half[0], y + half[1], 0.001), texture)


def make_room(kind: str, seed: int) -> Room:
    """The room of a seed: the same cupboard for every kind."""
    rng = np.random.default_rng(seed)
    depth, width, height = rng.uniform((0.4, 0.5, 0.7), (0.6, 0.9, 1.2))
    low, high = np.array([-depth / 2, -width / 2, 0]), np.array([depth / 2, width / 2, height])
    body = box(low, high, plain(rng.uniform(0.55, 0.85, 3)))
    front = box((high[0], low[1] + 0.01, 0.05), (high[0] + 0.02, high[1] - 0.01, height - 0.02), Mosaic(seed + 1))
    motion, joint = np.eye(4), {"rotate": {"l": 0.0, "r": 0.0}, "translate": {"l": 0.0, "r": 0.0}}
    if rng.random() < 0.5:
        turn, hinge = float(rng.uniform(30, 80)), np.array([high[0] + 0.01, low[1], 0.0])
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])  # outwards, about -z, its hinge to the right of who faces it
        motion[:3, :3], motion[:3, 3] = R, hinge - R @ hinge
        joint |= {"type": "rotate", "axis": {"o": hinge.tolist(), "d": [0.0, 0.0, -1.0]}}
        joint["rotate"]["r"] = turn
    else:
        motion[0, 3] = float(rng.uniform(0.15, 0.4))
        joint |= {"type": "translate", "axis": {"o": high.tolist(), "d": [1.0, 0.0, 0.0]}}
        joint["translate"]["r"] = motion[0, 3]
    rich = kind == "textured"
    walls = [((-2, -3, -0.05), (3.4, 3, 0)), ((-2.05, -3, 0), (-2, 3, 2.6)), ((3.4, -3, 0), (3.45, 3, 2.6)),
             ((-2, -3.05, 0), (3.4, -3, 2.6)), ((-2, 3, 0), (3.4, 3.05, 2.6))]  # fmt: skip
    colours = [(0.6, 0.5, 0.42), *[(0.82, 0.8, 0.76)] * 4]
    still = [body]
    for k, ((lo, hi), colour) in enumerate(zip(walls, colours, strict=True)):
        still.append(box(lo, hi, Mosaic(100 * seed + k) if rich else plain(colour)))
    for k in range(5 if rich else 2):
        at, size = rng.uniform((-1.7, -2.5), (-0.9, 2.5)), rng.uniform(0.2, 0.5, 3)
        texture = Mosaic(100 * seed + 50 + k) if rich else plain(rng.uniform(0.3, 0.8, 3))
        still.append(box((*at, 0), (*(at + size[:2]), size[2]), texture))
    if kind == "board":
        # on the side away from the hinge, where no open door stands over it
        still.append(board_sheet(high[0] + rng.uniform(0.2, 0.4), high[1] + rng.uniform(0.1, 0.2)))
    return Room(still, front, motion, joint)


def path_of(count: int, height: float, rng: np.random.Generator) -> list[np.ndarray]:
    """World to camera [4, 4] of a hand-held walk over the front 130 degrees, at three heights: farther round, a plain
    room shows nothing to place a photograph by."""
    out = []
    for i in range(count):
        angle = np.radians(np.linspace(-65, 65, -(-count // 3))[i // 3] + rng.normal(0, 3))
        away = rng.uniform(1.7, 2.3)
        eye = np.array([away * np.cos(angle), away * np.sin(angle), (0.5, 1.0, 1.6)[i % 3] + rng.normal(0, 0.06)])
        view = look_at(eye, np.array([0.1, 0, height / 2]) + rng.normal(0, 0.06, 3))
        roll = np.radians(rng.normal(0, 2.5))
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        out.append(turn @ view)
    return out


def lens_maps(wide: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(K of the photographs, K of the pinhole rendering ``wide`` times as large, and where each photograph's pixel lies
    in that: two maps [H, W] for cv2.remap)."""
    import cv2

    K = np.array([[FOCAL, 0, WIDTH / 2 + 2], [0, FOCAL, HEIGHT / 2 - 1.5], [0, 0, 1]])
    P = K.copy()
    P[:2, 2] = [wide * WIDTH / 2, wide * HEIGHT / 2]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], 1)[:, None]
    rays = cv2.undistortPoints(pixels, K, np.array([*LENS, 0, 0]))[:, 0].reshape(HEIGHT, WIDTH, 2)
    maps = [(rays[..., i] * FOCAL + P[i, 2] - 0.5).astype(np.float32) for i in (0, 1)]
    return K, P, maps[0], maps[1]


def photographed(room: Room, end: bool, views: list[np.ndarray], rng: np.random.Generator):
    """(image [H, W, 3] uint8, mask [H, W] uint8) of each view: lens, exposure, white balance and noise."""
    import cv2

    wide = 1.12
    _, P, mx, my = lens_maps(wide)
    primitives, parts = room.posed(end)
    shadow, size = Shadow(primitives), (round(wide * WIDTH), round(wide * HEIGHT))
    for view in views:
        shot = render(primitives, parts, view, P, *size, samples=2, shadow=shadow)
        image = cv2.remap(shot.image, mx, my, cv2.INTER_CUBIC).astype(np.float32)
        mask = cv2.remap(np.where(shot.parts == 0, 255, 0).astype(np.uint8), mx, my, cv2.INTER_LINEAR)
        gain = np.exp(rng.normal(0, 0.05) + rng.normal(0, 0.015, 3)) * (0.9 if end else 1.0)
        noise = rng.normal(0, 1.5, image.shape)
        yield np.clip(image * gain + noise, 0, 255).astype(np.uint8), np.where(mask > 127, 255, 0).astype(np.uint8)


def write_room(out: Path, kind: str, seed: int, photos: int = 24) -> None:
    """Write the room's two captures and the truth into ``out``."""
    from PIL import Image

    room, rng = make_room(kind, seed), np.random.default_rng(1000 + seed)
    cameras, flip = {}, np.diag([1.0, -1, -1, 1])
    for end, state in enumerate(STATES):
        for folder in (out / state, out / "masks" / state):
            folder.mkdir(parents=True, exist_ok=True)
        views = path_of(photos, float(room.still[0].corners[:, 2].max()), rng)
        for i, (view, (image, mask)) in enumerate(zip(views, photographed(room, bool(end), views, rng), strict=True)):
            exif = Image.Exif()
            exif[0x0110] = "p2gs room"
            exif.get_ifd(0x8769)[0xA405] = round(FOCAL * 43.27 / np.hypot(WIDTH, HEIGHT))
            name = f"IMG_{100 * end + i:04d}"
            Image.fromarray(image).save(out / state / f"{name}.jpg", quality=92, exif=exif)
            Image.fromarray(mask).save(out / "masks" / state / f"{name}.png")
            cameras[f"{state}/{name}"] = (np.linalg.inv(view) @ flip).tolist()
    truth = out / "gt"
    (truth / "start").mkdir(parents=True, exist_ok=True)
    K = lens_maps(1.0)[0]
    facts = {"K": K.tolist(), "k1": LENS[0], "k2": LENS[1], "width": WIDTH, "height": HEIGHT, "c2w": cameras}
    (truth / "cameras.json").write_text(json.dumps(facts))
    (truth / "trans.json").write_text(json.dumps({"trans_info": [room.joint]}))
    write_body(room.still[0], truth / "start" / "start_static_rotate.ply")


def write_body(body: Primitive, path: Path) -> None:
    import trimesh

    hull = trimesh.convex.convex_hull(body.corners)
    trimesh.Trimesh(hull.vertices, hull.faces).export(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=KINDS, default="textured")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--photos", type=int, default=24)
    args = parser.parse_args()
    write_room(args.out, args.kind, args.seed, args.photos)


if __name__ == "__main__":
    main()
