"""The mesh files that URDF and MJCF point to: OUT/assets/<link>.obj (visual: vertex colours, textures) and
<link>_collision_<i>.obj."""

from __future__ import annotations

from pathlib import Path
from typing import Optional, TextIO

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.links import Link
from p2gs.surface.texture import Texture
from p2gs.surface.tsdf import vertex_normals

FOLDER = "assets"


def write_assets(asset: Asset, out: Path) -> None:
    """Geometry in link frames; files of an earlier export of the same run are replaced."""
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.obj"):
        for suffix in (".obj", ".mtl", ".png"):
            old.with_suffix(suffix).unlink(missing_ok=True)
    for link in (one for one in asset.links if not one.bare):
        write_obj(
            folder / visual_name(link), link.visual.vertices, link.visual.faces, link.visual.colours, link.texture
        )
        for i, piece in enumerate(link.collision):
            write_obj(folder / collision_name(link, i), piece.vertices, piece.faces)


def visual_name(link: Link) -> str:
    return f"{link.name}.obj"


def collision_name(link: Link, index: int) -> str:
    return f"{link.name}_collision_{index}.obj"


def texture_name(link: Link) -> str:
    return f"{link.name}.png"


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: Optional[np.ndarray] = None,
    texture: Optional[Texture] = None,
) -> None:
    """Wavefront OBJ of vertices [V, 3], faces [F, 3]; vertex colours [V, 3] as the three extra numbers that MeshLab,
    Blender and trimesh read; a texture beside it."""
    rows = vertices if colours is None else np.c_[vertices, colours / 255]
    form = "v " + " ".join(["%.7g"] * 3 + (["%.4f"] * 3 if colours is not None else []))
    with open(path, "w") as file:
        if texture is not None:
            file.write(f"mtllib {path.stem}.mtl\n")
        _write_rows(file, rows, form)
        if colours is not None:  # of what is shown; converters to USD take a mesh without normals for an error
            _write_rows(file, vertex_normals(vertices, faces), "vn %.4f %.4f %.4f")
        if texture is None:
            corners = np.repeat((faces + 1).reshape(-1, 3, 1), 1 if colours is None else 2, 2).reshape(len(faces), -1)
            _write_rows(file, corners, "f %d %d %d" if colours is None else "f %d//%d %d//%d %d//%d")
            return
        texture.save(path.with_suffix(".png"))
        path.with_suffix(".mtl").write_text(
            f"newmtl {path.stem}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {path.stem}.png\n"
        )
        _write_rows(file, texture.uv.reshape(-1, 2), "vt %.7g %.7g")
        file.write(f"usemtl {path.stem}\n")
        corner = np.arange(1, faces.size + 1).reshape(-1, 3)
        if colours is None:
            _write_rows(file, np.stack([faces + 1, corner], 2).reshape(-1, 6), "f %d/%d %d/%d %d/%d")
        else:
            _write_rows(
                file, np.stack([faces + 1, corner, faces + 1], 2).reshape(-1, 9), "f %d/%d/%d %d/%d/%d %d/%d/%d"
            )


def _write_rows(file: TextIO, rows: np.ndarray, form: str, chunk: int = 4096) -> None:
    """A line for each row; many are formatted at once, which takes half of ``numpy.savetxt``'s time."""
    for some in np.array_split(rows, range(chunk, len(rows), chunk)):
        file.write((form + "\n") * len(some) % tuple(some.ravel().tolist()))
