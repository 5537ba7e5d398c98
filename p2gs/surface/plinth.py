"""Plinths: what stands on a narrower frame has its bottom on top of that frame, not down on the floor.

A cupboard with a recess for the toes rests on walls and a kick board; its lowest board lies where the front steps out
over them.
"""

from __future__ import annotations

import numpy as np

from p2gs.ops.mesh import Mesh
from p2gs.surface.faces import Faces, quantile

UPRIGHT = 0.3  # cosine with the vertical up to which a triangle is a wall's
OUTERMOST = 0.97  # quantile of a level's walls that is its edge: no knob moves it
HEIGHT = (0.1, 0.3)  # of a plinth, in the whole height: toes fit in, a table's top is none
STEP = 0.05  # of the whole height by which the body stands out over it
STRAIGHT = 2.0  # voxels from their median within which levels below the step lie
LEAST = 8  # voxels of height
MOST = 0.5  # share of the levels below the step that must
ABOVE = 6  # levels over the step that stand out


def edges(mesh: Mesh, axis: int, outward: float, at: float, levels: int, voxel: float) -> np.ndarray:
    """How far out the walls of levels reach, [levels, 4]: towards both ends of each of the other two axes; nan where
    there are none.

    Levels are a voxel apart, from ``at`` along the axis on, against ``outward`` (1 or -1).
    """
    faces = Faces(mesh)
    level = np.floor((at - faces.middle[:, axis]) * outward / voxel).astype(int)
    wall = np.abs(faces.normal[:, axis]) < UPRIGHT
    ends = [sign * faces.middle[:, i] for i in range(3) if i != axis for sign in (-1, 1)]
    out = np.full((levels, 4), np.nan)
    for i in range(levels):
        rows = np.nonzero(wall & (level == i))[0]
        if len(rows):
            out[i] = [quantile(end[rows], faces.area[rows], OUTERMOST) for end in ends]
    return out


def plinth_height(mesh: Mesh, axis: int, outward: float, at: float, height: float, voxel: float) -> float:
    """How high the plinth is on which a mesh of ``height`` stands at ``at``, ``outward`` (1 or -1) being down along the
    axis; 0 where it stands on none."""
    lowest, highest = (int(share * height / voxel) for share in HEIGHT)
    edge = edges(mesh, axis, outward, at, highest + 1 + ABOVE, voxel)
    best, found = STEP * height, 0
    for h in range(max(lowest, LEAST), highest + 1):
        below = np.median(edge[1:h], axis=0)
        straight = (np.abs(edge[1:h] - below) < STRAIGHT * voxel).mean(0) > MOST
        outside = below + STRAIGHT * voxel
        begins = straight & (edge[h - 1] < outside) & (edge[h] >= outside)  # a level may lie half over it
        step = np.where(begins, edge[h + 1 : h + 1 + ABOVE].min(0) - below, 0.0)
        if np.nanmax(step, initial=0.0) > best:  # a level without walls is no part of a step
            best, found = np.nanmax(step), h
    return found * voxel
