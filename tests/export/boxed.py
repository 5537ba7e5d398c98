"""A result folder of the toy cabinet whose meshes are boxes by trimesh: nothing is rendered or fused, so it takes no
time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from toy import toy_scene, toy_twin

from p2gs.export.run_folder import write_twin
from p2gs.gaussians.pose import part_transform
from p2gs.ops.mesh import Mesh
from p2gs.surface.mesh import write_mesh

WALL = 0.03
SHELL = [
    ((-0.5, -0.4, -0.5), (-0.5 + WALL, 0.4, 0.5)),
    ((0.5 - WALL, -0.4, -0.5), (0.5, 0.4, 0.5)),
    ((-0.5 + WALL, -0.4, -0.5), (0.5 - WALL, 0.4, -0.5 + WALL)),
    ((-0.5 + WALL, -0.4, 0.5 - WALL), (0.5 - WALL, 0.4, 0.5)),
    ((-0.5 + WALL, 0.4 - WALL, -0.5 + WALL), (0.5 - WALL, 0.4, 0.5 - WALL)),
]
DOOR = [((-0.49, -0.45, -0.49), (-0.02, -0.41, 0.49))]
DRAWER = [((0.03, -0.45, -0.2), (0.44, -0.41, 0.2)), ((0.03, -0.41, -0.2), (0.44, 0.3, -0.2 + WALL))]
COLOURS = ((191, 178, 153), (77, 115, 179), (179, 89, 77))


def boxes(bounds, colour) -> Mesh:
    """One mesh of closed boxes, with vertices at most 0.15 apart."""
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=b).subdivide_to_size(0.15) for b in bounds])
    return Mesh(
        np.array(mesh.vertices), np.array(mesh.faces), np.tile(np.array(colour, np.uint8), (len(mesh.vertices), 1))
    )


def boxed_run(folder: Path) -> Path:
    """twin.json, splats, cameras and meshes of both states."""
    twin = toy_twin()
    write_twin(twin, folder, toy_scene(n=4, size=60), media=False)
    meshes = [boxes(b, c) for b, c in zip((SHELL, DOOR, DRAWER), COLOURS, strict=True)]
    for t, state in enumerate(("start", "end")):
        (folder / "meshes" / state).mkdir(parents=True)
        moved = [m.transformed(part_transform(twin, k, float(t)).numpy()) for k, m in enumerate(meshes)]
        for k, mesh in enumerate([*moved, Mesh.join(moved)]):
            write_mesh(folder / "meshes" / state / (f"part_{k}.ply" if k < 3 else "whole.ply"), mesh)
    return folder
