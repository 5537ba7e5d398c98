"""COLMAP's sparse models on disk, binary and text: ``cameras``, ``images``, ``points3D``. Needs numpy alone.

Format: COLMAP, doc/format.rst. The ``rigs`` and ``frames`` that COLMAP 4 writes beside them repeat the poses of single
cameras and are not needed; a rig of several cameras is read through its images as well.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from p2gs.data.capture.model import LENS_MODELS, Lens, Model, Photo
from p2gs.types import UserError

MODEL_NAMES = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
}
MODEL_IDS = {name: i for i, name in MODEL_NAMES.items()}


def find_model(folder: Path) -> Path | None:
    """The folder that holds ``cameras.bin`` or ``.txt``: the one given, its ``sparse``, ``sparse/0`` or
    ``colmap/sparse/0``."""
    for part in ("", "sparse", "sparse/0", "colmap/sparse/0", "0"):
        for suffix in (".bin", ".txt"):
            if (folder / part / f"cameras{suffix}").is_file():
                return folder / part
    return None


def read_model(folder: Path) -> Model:
    """The model in a folder. Raises UserError, naming the file, where one is missing or cannot be understood."""
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    paths = [folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    for path in paths[:2]:
        if not path.is_file():
            raise UserError(
                f"{path}: is missing; a COLMAP model has cameras, images and points3D, all .bin or all .txt"
            )
    readers = (_cameras_bin, _images_bin, _points_bin) if suffix == ".bin" else (_cameras_txt, _images_txt, _points_txt)
    parsed = []
    for path, reader in zip(paths, readers, strict=True):
        try:
            parsed.append(reader(path))
        except (struct.error, ValueError, IndexError, KeyError, TypeError, OverflowError) as err:
            raise UserError(f"{path}: is no COLMAP file of this kind, or is cut short ({err!r})") from err
    lenses, photos, (ids, xyz, rgb) = parsed
    for photo in photos.values():
        if photo.lens not in lenses:
            raise UserError(
                f"{paths[1]}: image {photo.name} has camera {photo.lens}, which {paths[0].name} does not list"
            )
        photo.point = np.where(np.isin(photo.point, ids), photo.point, -1)
    order = np.argsort(ids)
    return Model(lenses, photos, ids[order], xyz[order], rgb[order])


def _viewmat(quat_wxyz, t) -> np.ndarray:
    view = np.eye(4)
    if not (np.isfinite(quat_wxyz).all() and np.isfinite(t).all()):
        raise ValueError("a pose that is not finite")
    view[:3, :3] = Rotation.from_quat(np.roll(np.asarray(quat_wxyz, float), -1)).as_matrix()
    view[:3, 3] = t
    return view


class _Bytes:
    def __init__(self, path: Path):
        self.data, self.at = path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def array(self, dtype, count: int) -> np.ndarray:
        out = np.frombuffer(self.data, dtype, count, self.at)
        self.at += out.nbytes
        return out

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        out = self.data[self.at : end].decode()
        self.at = end + 1
        return out


def _lens(name: str, width, height, params) -> Lens:
    params = np.asarray(params, float)
    if not np.isfinite(params).all() or min(int(width), int(height)) < 1:
        raise ValueError(f"{width}x{height} pixels, parameters {params}")
    if name in LENS_MODELS and len(params) != LENS_MODELS[name]:
        raise ValueError(f"{name} has {len(params)} parameters, expected {LENS_MODELS[name]}")
    return Lens(name, int(width), int(height), params)


def _cameras_bin(path: Path) -> dict[int, Lens]:
    file, out = _Bytes(path), {}
    for _ in range(file.take("Q")[0]):
        key, model, width, height = file.take("iiQQ")
        if model not in MODEL_NAMES:
            raise UserError(f"{path}: camera {key} has COLMAP's model number {model}; known are {', '.join(MODEL_IDS)}")
        name = MODEL_NAMES[model]
        out[key] = _lens(name, width, height, file.array("<f8", LENS_MODELS[name]))
    return out


def _images_bin(path: Path) -> dict[int, Photo]:
    file, out = _Bytes(path), {}
    dtype = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    for _ in range(file.take("Q")[0]):
        key, *pose, lens = file.take("i7di")
        name = file.text()
        points = file.array(dtype, file.take("Q")[0])
        out[key] = Photo(
            name, lens, _viewmat(pose[:4], pose[4:]), points["xy"].copy(), points["point"].astype(np.int64)
        )
    return out


def _points_bin(path: Path):
    if not path.is_file():
        return _no_points()
    file, ids, xyz, rgb = _Bytes(path), [], [], []
    for _ in range(file.take("Q")[0]):
        key, x, y, z, r, g, b, _, length = file.take("Q3d3BdQ")
        file.array("<i4", 2 * length)
        ids.append(key)
        xyz.append((x, y, z))
        rgb.append((r, g, b))
    return np.array(ids, np.int64), np.array(xyz, float).reshape(-1, 3), np.array(rgb, np.uint8).reshape(-1, 3)


def _no_points():
    return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def _cameras_txt(path: Path) -> dict[int, Lens]:
    out = {}
    for line in filter(str.strip, _lines(path)):
        key, name, width, height, *params = line.split()
        out[int(key)] = _lens(name, width, height, [float(p) for p in params])
    return out


def _images_txt(path: Path) -> dict[int, Photo]:
    lines, out = _lines(path), {}
    while lines and not lines[0].strip():
        lines.pop(0)
    # an image without points has an empty second line
    for head, tail in zip(lines[::2], [*lines[1::2], ""], strict=False):
        words = head.split(maxsplit=9)
        numbers = np.array(tail.split(), float).reshape(-1, 3)
        viewmat = _viewmat([float(w) for w in words[1:5]], [float(w) for w in words[5:8]])
        out[int(words[0])] = Photo(
            words[9].strip(), int(words[8]), viewmat, numbers[:, :2].copy(), numbers[:, 2].astype(np.int64)
        )
    return out


def _points_txt(path: Path):
    if not path.is_file():
        return _no_points()
    rows = [line.split()[:7] for line in filter(str.strip, _lines(path))]
    ids = np.array([int(r[0]) for r in rows], np.int64)
    return (
        ids,
        np.array([r[1:4] for r in rows], float).reshape(-1, 3),
        np.array([r[4:7] for r in rows], np.uint8).reshape(-1, 3),
    )


def write_model(model: Model, folder: Path) -> None:
    """``cameras.bin``, ``images.bin``, ``points3D.bin``."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in ("rigs.bin", "frames.bin"):
        (folder / stale).unlink(missing_ok=True)
    out = [struct.pack("<Q", len(model.lenses))]
    for key, lens in model.lenses.items():
        out.append(
            struct.pack("<iiQQ", key, MODEL_IDS[lens.model], lens.width, lens.height)
            + lens.params.astype("<f8").tobytes()
        )
    (folder / "cameras.bin").write_bytes(b"".join(out))
    out = [struct.pack("<Q", len(model.photos))]
    for key, photo in model.photos.items():
        quat = np.roll(Rotation.from_matrix(photo.viewmat[:3, :3]).as_quat(), 1)
        out.append(struct.pack("<i7di", key, *quat, *photo.viewmat[:3, 3], photo.lens) + photo.name.encode() + b"\0")
        points = np.empty(len(photo.xy), [("xy", "<f8", 2), ("point", "<i8")])
        points["xy"], points["point"] = photo.xy, photo.point
        out.append(struct.pack("<Q", len(points)) + points.tobytes())
    (folder / "images.bin").write_bytes(b"".join(out))
    (folder / "points3D.bin").write_bytes(_packed_points(model))


def _packed_points(model: Model) -> bytes:
    rows, images, _ = model.observations()
    which = np.concatenate([np.flatnonzero(p.point >= 0) for p in model.photos.values()] or [np.zeros(0, int)])
    _, _, error = model.errors()
    order = np.argsort(rows, kind="stable")
    ends = np.searchsorted(rows[order], np.arange(len(model.ids) + 1))
    tracks = np.stack([images, which], 1).astype("<i4")[order]
    error = error[order]
    out = [struct.pack("<Q", len(model.ids))]
    for row, (key, xyz, rgb) in enumerate(zip(model.ids, model.xyz, model.rgb, strict=True)):
        mine = slice(ends[row], ends[row + 1])
        mean = float(error[mine].mean()) if ends[row + 1] > ends[row] else -1.0
        out.append(struct.pack("<Q3d3BdQ", key, *xyz, *rgb, mean, ends[row + 1] - ends[row]) + tracks[mine].tobytes())
    return b"".join(out)
