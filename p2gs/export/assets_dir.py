"""The mesh files that URDF and MJCF point to: OUT/assets/<link>.obj (visual, vertex colours) and <link>_collision_<i>.obj."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import numpy as np

from p2gs.export.asset import Asset, Link

FOLDER = "assets"


def write_assets(asset: Asset, out: Path) -> None:
    """Geometry in link frames; files of an earlier export of the same run are replaced."""
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.obj"):
        old.unlink()
    for link in asset.links:
        write_obj(folder / visual_name(link), link.visual.vertices, link.visual.faces, link.visual.colours)
        for i, piece in enumerate(link.collision):
            write_obj(folder / collision_name(link, i), piece.vertices, piece.faces)


def visual_name(link: Link) -> str:
    return f"{link.name}.obj"


def collision_name(link: Link, index: int) -> str:
    return f"{link.name}_collision_{index}.obj"


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None = None) -> None:
    """Wavefront OBJ; vertex colours as the three extra numbers that MeshLab, Blender and trimesh read."""
    rows = vertices if colours is None else np.c_[vertices, colours / 255]
    form = "v " + " ".join(["%.7g"] * 3 + (["%.4f"] * 3 if colours is not None else []))
    with open(path, "w") as file:
        _write_rows(file, rows, form)
        _write_rows(file, faces + 1, "f %d %d %d")


def _write_rows(file: TextIO, rows: np.ndarray, form: str, chunk: int = 4096) -> None:
    """A line for each row; many are formatted at once, which takes half of ``numpy.savetxt``'s time."""
    for some in np.array_split(rows, range(chunk, len(rows), chunk)):
        file.write((form + "\n") * len(some) % tuple(some.ravel().tolist()))
