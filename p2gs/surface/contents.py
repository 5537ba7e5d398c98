"""What is in a drawer goes with it: labels of the Gaussians on and in trays that stand open.

A side of an opened drawer may be labelled as a door's, for the door's motion happens to lay it on some surface of the
other state. Once the parts' surfaces are there they tell where an open drawer's tray is, and that no other part can be
there. Not in the paper.
"""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.gaussians.paint import drawing_with
from p2gs.gaussians.pose import pose
from p2gs.ops import se3
from p2gs.surface.sightings import sight
from p2gs.surface.trays import Tray
from p2gs.types import ArticulatedObject, Camera

RESOLUTION = 100  # voxels along the longest side of the object's box: trays are large
NEAR = 0.0125  # of that side: nearer than this to a side of a tray is on it


def belongs(points: np.ndarray, tray: Tray, near: float) -> np.ndarray:
    """Which points [N, 3], in a tray's axes, are in it or within ``near`` of a side of it, [N] bool.

    Not in its mouth, though: what closes that is a lid, of which nobody knows whose it is.
    """
    within = tray.within(points)
    return (within > -near).all(1) & ~in_mouth(within, tray, near)


def in_mouth(within: np.ndarray, tray: Tray, near: float) -> np.ndarray:
    """Which points, so far ``within`` [N, 6] a tray's sides, are in its mouth or before it, away from the other sides,
    [N] bool."""
    return (within[:, tray.mouth_side] < 2 * near) & (np.delete(within, tray.mouth_side, 1) > near).all(1)


def beside(points: np.ndarray, tray: Tray, near: float) -> np.ndarray:
    """Which points [N, 3], in a tray's axes, are where its front was or passed before the drawer was open, but for its
    mouth, [N] bool: no other moving part can be there."""
    front, within = tray.front, tray.within(points)
    passed = (
        ((points[:, 1:] > front.lo) & (points[:, 1:] < front.hi)).all(1)
        & (points[:, 0] < front.back)
        & out_of_body(points, tray, 0)
    )
    return passed & (within[:, tray.mouth_side] > -near) & ~in_mouth(within, tray, near)


def out_of_body(points: np.ndarray, tray: Tray, near: float) -> np.ndarray:
    """Which points [N, 3], in a tray's axes, are by more than ``near`` before what the drawer slides out of, while it
    is open, [N] bool."""
    return points[:, 0] > tray.front.back - tray.travel + near


@torch.no_grad()
def in_trays(
    obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Labels [N] of a twin's Gaussians, those in or on a tray that stands open its own (of the base's only what is out
    of the body); and which are so their drawer's now, [N] bool.

    obj and cameras ((state, camera) pairs) in one coordinate system; parts have their places as ids, the base 0.
    """
    labels, held = obj.part_ids.clone(), torch.zeros(len(obj.part_ids), dtype=torch.bool)
    sliding = [k for k, p in enumerate(obj.parts) if p.joint is not None and p.joint.type == "prismatic"]
    if not sliding:
        return labels, held
    with drawing_with(backend):
        seen = sight(obj, cameras, RESOLUTION)
    body, near = seen.surface(0), NEAR * RESOLUTION * seen.voxel
    trays = {}
    for k in sliding:
        surface = seen.surface(k)
        tray = seen.tray(k, surface, body) if len(surface.faces) and len(body.faces) else None
        if tray is not None:
            trays[k] = tray
    posed = {t: pose(obj, float(t)).means.double() for t in {tray.drawn for tray in trays.values()}}
    deepest, reach, still = {}, {}, (obj.part_ids == 0).numpy()
    for k, tray in trays.items():
        at = se3.apply(se3.inverse(seen.motions[k][tray.drawn]), posed[tray.drawn]).numpy() @ tray.front.axes.T
        deepest[k] = tray.within(at).min(1)
        on = belongs(at, tray, near)
        reach[k] = np.where(still, on & out_of_body(at, tray, near), on | beside(at, tray, near))
    for k in trays:
        mine = reach[k].copy()
        for j in trays:  # what is rather on another's
            mine &= (labels != j).numpy() | (deepest[j] <= deepest[k])
        labels[torch.from_numpy(mine)] = k
    for k in trays:
        held |= (labels == k) & torch.from_numpy(reach[k])
    return labels, held
