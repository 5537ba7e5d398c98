"""Shapes of an asset's links: mesh files with their materials and textures, and the primitives of URDF and MJCF."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional, Sequence

import numpy as np

from p2gs.data.render.asset import Shape
from p2gs.types import UserError

GREY = np.array([0.6, 0.6, 0.6])
TEXTURE = 1024  # longer side of a texture in pixels: finer ones are scaled down


def mesh_shapes(path: Path, scale: Sequence[float], placed: np.ndarray, colour: Optional[np.ndarray]) -> list[Shape]:
    """What is in a mesh file (OBJ, STL, DAE, PLY, GLB), scaled [3] and placed [4, 4]. colour [3]: instead of the
    file's own where that has none. Raises UserError for a file that is missing or cannot be read."""
    import trimesh

    if not path.is_file():
        raise UserError(f"{path}: the mesh file is missing")
    try:
        scene = trimesh.load_scene(path, process=False, resolver=_resolver(path.parent))
    except Exception as err:
        raise UserError(f"{path}: cannot be read as a mesh ({err})") from err
    out, matrix = [], placed @ np.diag([*scale, 1.0])
    for node in scene.graph.nodes_geometry:
        own, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            out.append(_shape(mesh, matrix @ own, colour))
    return out


def primitive(kind: str, size: Sequence[float], placed: np.ndarray, colour: Optional[np.ndarray]) -> Shape:
    """A box (full sizes), cylinder (radius, length), capsule (radius, length of its cylinder), sphere (radius) or
    ellipsoid (half axes) around the origin, axis z, placed [4, 4]."""
    from trimesh import creation

    if kind == "box":
        mesh = creation.box(size)
    elif kind == "cylinder":
        mesh = creation.cylinder(size[0], size[1], sections=64)
    elif kind == "capsule":
        mesh = creation.capsule(size[1], size[0], count=[48, 48])
    else:
        mesh = creation.icosphere(4)
        mesh.apply_scale(size[0] if kind == "sphere" else size)
    return Shape(_moved(np.asarray(mesh.vertices), placed), np.asarray(mesh.faces), GREY if colour is None else colour)


def _shape(mesh: Any, matrix: np.ndarray, colour: Optional[np.ndarray]) -> Shape:
    vertices, faces, visual = _moved(np.asarray(mesh.vertices), matrix), np.asarray(mesh.faces), mesh.visual
    material = getattr(visual, "material", None)
    image, uv = _image(material), getattr(visual, "uv", None)
    if image is not None and uv is not None and len(uv) == len(vertices):
        return Shape(vertices, faces, GREY, image, np.asarray(uv, np.float64))
    if material is not None:
        return Shape(vertices, faces, np.asarray(material.main_color, float)[:3] / 255)
    if visual.kind in ("vertex", "face"):
        return _painted(vertices, faces, np.asarray(visual.face_colors)[:, :3])
    return Shape(vertices, faces, GREY if colour is None else colour)


def _painted(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> Shape:
    """Triangles of a colour each, colours [F, 3] uint8: a texture that has a texel for each colour."""
    palette, which = np.unique(colours, axis=0, return_inverse=True)
    if len(palette) == 1:
        return Shape(vertices, faces, palette[0] / 255)
    side = int(np.ceil(len(palette) ** 0.5))
    image = np.zeros((side * side, 3), np.uint8)
    image[: len(palette)] = palette
    row, column = np.divmod(which.reshape(-1), side)
    uv = np.stack([(column + 0.5) / side, 1 - (row + 0.5) / side], axis=1)
    corners = vertices[faces].reshape(-1, 3)
    return Shape(corners, np.arange(len(corners)).reshape(-1, 3), GREY, image.reshape(side, side, 3), uv.repeat(3, 0))


def _image(material: Any) -> Optional[np.ndarray]:
    """Pixels [H, W, 3] uint8 of a material's texture."""
    image = getattr(material, "image", None)
    if image is None:
        image = getattr(material, "baseColorTexture", None)
    if image is None:
        return None
    image = image.convert("RGB")
    factor = TEXTURE / max(image.size)
    if factor < 1:
        image = image.resize([max(1, int(side * factor)) for side in image.size])
    return np.array(image, np.uint8)


def _moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _resolver(folder: Path):
    """Opens the files that a mesh names, those in folders beside its own too (PartNet-Mobility has ../images), which
    trimesh's own refuses; never outside the asset."""
    from trimesh.resolvers import Resolver

    root = folder.resolve().parent.parent

    class Beside(Resolver):
        def __init__(self) -> None:
            pass

        def get(self, name: str) -> bytes:
            path = (folder / name.strip()).resolve()
            if not path.is_relative_to(root):
                raise ValueError(f"{path}: leads out of the asset's folder")
            return path.read_bytes()

        def keys(self):
            return [p.name for p in folder.iterdir()]

        def namespaced(self, namespace):
            return self

        def write(self, name, data):
            raise NotImplementedError

    return Beside()
