"""Baked textures: a picture for each part's surface, finer than its vertices, for programs that show no vertex colours.

Two triangles share a square tile of the picture. A texel takes the mean of what the views saw at its place, as vertices
do; where nobody saw it, its triangle's vertices' colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from p2gs.gaussians.paint import rasterizer_of
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import read_cameras
from p2gs.ops.mesh import Mesh
from p2gs.surface.depth_view import pixel_matrix
from p2gs.surface.integrate import integrate
from p2gs.surface.mesh import mesh_cameras
from p2gs.surface.sightings import BEHIND, TRUNCATION, Sightings, sight

TILE = 8  # texels along a tile; the short edges of a triangle get TILE - 3


@dataclass(frozen=True)
class Texture:
    """uv [F, 3, 2]: of each triangle's corners, from the picture's lower left corner, in 0..1.  image [H, W, 3] uint8,
    upper row first."""

    uv: np.ndarray
    image: np.ndarray

    def save(self, path: Path) -> None:
        """PNG."""
        path.write_bytes(self.png())

    def png(self) -> bytes:
        import cv2

        return cv2.imencode(".png", np.ascontiguousarray(self.image[..., ::-1]))[1].tobytes()


def tiles(count: int) -> tuple[tuple[int, int], np.ndarray]:
    """Width and height of the picture [texels] of ``count`` triangles, and column and row of the first texel of each
    one's tile [count, 2].

    Both sides are powers of two, as older graphics hardware and some importers demand, the width once or twice the
    height.
    """
    doublings = max((count + 1) // 2 - 1, 0).bit_length()
    across = 2 ** ((doublings + 1) // 2)
    tile = np.arange(count) // 2
    return (across * TILE, 2 ** (doublings // 2) * TILE), TILE * np.stack([tile % across, tile // across], 1)


def layout(count: int) -> tuple[tuple[int, int], np.ndarray]:
    """Width and height of the picture [texels] and uv of the corners of ``count`` triangles in it, [count, 3, 2]
    (``Texture``).

    Corners lie on the centres of texels, and between the two triangles of a tile is room for both, so that no colour of
    a neighbour shows where a picture is read between texels.
    """
    size, first = tiles(count)
    lower = np.array([[0, 0], [TILE - 3, 0], [0, TILE - 3]])
    upper = np.array([[TILE - 1, TILE - 1], [2, TILE - 1], [TILE - 1, 2]])
    at = np.where((np.arange(count) % 2 == 0)[:, None, None], lower, upper)
    uv = (first[:, None] + at + 0.5) / size
    uv[..., 1] = 1 - uv[..., 1]
    return size, uv


def texels(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each texel that ``count`` triangles need: its triangle [n], barycentric coordinates there [n, 3], and column
    and row [n, 2]."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(TILE), np.arange(TILE)))
    short = TILE - 3
    own = [i + j <= TILE - 2, i + j >= TILE - 1]
    along = [np.stack([i, j], 1) / short, np.stack([TILE - 1 - i, TILE - 1 - j], 1) / short]
    _, first = tiles(count)
    triangle, weights, place = [], [], []
    for half in (0, 1):
        which = np.arange(half, count, 2)
        uv = along[half][own[half]]
        uv = uv / np.maximum(uv.sum(1, keepdims=True), 1)  # beyond the long edge: its nearest place
        here = np.stack([i, j], 1)[own[half]]
        triangle.append(np.repeat(which, len(uv)))
        weights.append(np.tile(np.c_[1 - uv.sum(1), uv], (len(which), 1)))
        place.append((first[which, None] + here).reshape(-1, 2))
    return np.concatenate(triangle), np.concatenate(weights), np.concatenate(place)


def bake(mesh: Mesh, seen: Sightings, part: int) -> Texture:
    """The texture of a part's mesh in the start state, from the views of both. part: place in the twin's parts."""
    (width, height), uv = layout(len(mesh.faces))
    triangle, weights, place = texels(len(mesh.faces))
    points = (mesh.vertices[mesh.faces[triangle]] * weights[..., None]).sum(1)
    colour = (mesh.colours[mesh.faces[triangle]] * weights[..., None]).sum(1) / 255
    matrices = [pixel_matrix(v.camera, T) for v, T in zip(seen.views, seen.poses[part], strict=True)]
    reach = (TRUNCATION * seen.voxel, BEHIND * seen.voxel)
    _, weight, tint, _ = integrate(torch.from_numpy(points).float(), seen.views, matrices, part, *reach)
    told = (weight > 0).numpy()
    colour[told] = tint.numpy()[told]
    image = np.zeros((height, width, 3), np.uint8)
    image[place[:, 1], place[:, 0]] = (colour.clip(0, 1) * 255).round()
    return Texture(uv, image)


class Baker:
    """Bakes the textures of a run's parts; a part's mesh must not change between calls."""

    def __init__(self, run_dir: Path | str):
        obj = load_twin(run_dir)
        self.place = {part.id: k for k, part in enumerate(obj.parts)}
        with rasterizer_of(run_dir):
            self.seen = sight(obj, mesh_cameras(obj, read_cameras(Path(run_dir) / "cameras.json")), fine=True)
        self.done: dict[int, Texture] = {}

    def __call__(self, part: int, mesh: Mesh) -> Texture:
        if part not in self.done:
            self.done[part] = bake(mesh, self.seen, self.place[part])
        return self.done[part]
