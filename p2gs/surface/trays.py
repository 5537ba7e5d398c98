"""Drawers whose rear no photograph shows are completed as trays.

A drawer is seen as far as it comes out of the body: its front, the beginnings of its sides, often not its bottom. What
slides out of an opening behind a front, with two sides and open between them, is taken for a tray that ends a little
before the body does. Its sides, bottom and rear are added where nothing of the part was seen, and what would stand in
its way is taken out of the body. Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh
from p2gs.surface.depth_view import DepthView
from p2gs.surface.faces import Faces, quantile
from p2gs.surface.unseen import NEAR, facing, grid_plane, seen_empty, sewn

FLAT = 0.8  # cosine with a direction from which a triangle faces it
FRONT = 0.5  # share of its rectangle that a front fills
BEGINNING = 0.5  # share of a side's height along which it must be seen
BESIDE = 0.5  # share of the front's extent within which a side is looked for from the front's edge
# quantile of the distances from the edge at which a side stands: what is dim is drawn towards the eye, inwards
OUTER = 0.25
REAR = 0.4  # share of the front's rectangle that a seen rear fills
LID = 0.5  # share of the mouth, as far as it comes out, that a surface fills which closes it
BOTTOM = 0.2  # and that a bottom fills where it is seen; below, that is where the sides end
NOTHING = 0.9  # share of a side that is seen to be empty from which on it is not there
LEAST = 8.0  # voxels that the body must go on behind the front
APART = 2.5  # voxels from what was seen to what is added
ON = 2.0  # voxels from a tray within which a surface is its own
CLEAR = 1.5  # voxels within its sides from which on a tray needs its way
DEPTH = 0.8  # of the way from the front to the end of the body behind it


@dataclass(frozen=True)
class Front:
    """A plate across the direction of sliding. axes [3, 3]: rows outward, along its width, along its height; lo, hi
    [2]: its rectangle in the latter two; back: where it ends inwards, along the first."""

    axes: np.ndarray
    lo: np.ndarray
    hi: np.ndarray
    back: float

    def across(self, faces: Faces) -> np.ndarray:
        """Which triangles, in its axes, lie within its rectangle, [F] bool."""
        return ((faces.middle[:, 1:] >= self.lo) & (faces.middle[:, 1:] <= self.hi)).all(1)


def find_front(mesh: Mesh, outward: np.ndarray, voxel: float) -> Optional[Front]:
    """The plate that faces ``outward`` [3] at the mesh's outer end, if there is one that fills its rectangle."""
    import cv2

    helper = np.eye(3)[np.abs(outward).argmin()]
    first = np.cross(outward, helper) / np.linalg.norm(np.cross(outward, helper))
    axes = np.stack([outward, first, np.cross(outward, first)])
    faces = Faces(mesh, axes)
    facing = faces.normal[:, 0] > FLAT
    if not facing.any():
        return None
    place = np.floor(faces.middle[:, 0] / voxel).astype(int)
    low = place.min()
    profile = np.convolve(
        np.bincount(place[facing] - low, faces.area[facing], place.max() - low + 1), np.ones(3), "same"
    )
    at = (profile.argmax() + low + 0.5) * voxel
    plate = facing & (np.abs(faces.middle[:, 0] - at) < 2.5 * voxel)
    angle = np.radians(cv2.minAreaRect(faces.middle[plate, 1:].astype(np.float32))[2])
    turn = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
    axes, faces = turn @ axes, Faces(mesh, turn @ axes)
    lo, hi = np.array([_extent(faces.middle[plate, i], faces.area[plate], voxel) for i in (1, 2)]).T
    if (hi - lo).min() < 4 * voxel or faces.area[plate].sum() < FRONT * np.prod(hi - lo):
        return None
    front = Front(axes, lo, hi, at)
    inner = (
        (faces.normal[:, 0] < -FLAT)
        & front.across(faces)
        & (faces.middle[:, 0] < at)
        & (faces.middle[:, 0] > at - 12 * voxel)
    )
    back = quantile(faces.middle[inner, 0], faces.area[inner]) if inner.any() else at - 2 * voxel
    return Front(axes, lo, hi, back)


@dataclass(frozen=True)
class Side:
    """A side of a drawer as far as it was seen. at: where it stands along one axis of the front; lo, hi: its ends along
    the other; inner: how far inwards; area: of what was seen."""

    at: float
    lo: float
    hi: float
    inner: float
    area: float


def _extent(values: np.ndarray, areas: np.ndarray, voxel: float) -> tuple[float, float]:
    """From where to where a surface goes along an axis, without what juts out of it: cells that hold half of what most
    do."""
    cell = np.floor(values / voxel).astype(int)
    low = cell.min()
    held = np.bincount(cell - low, areas)
    full = np.nonzero(held > 0.5 * np.median(held[held > 0]))[0]
    return (low + full[0]) * voxel, (low + full[-1] + 1) * voxel


def find_side(faces: Faces, front: Front, axis: int, end: int, voxel: float) -> Optional[Side]:
    """The side at the lower (``end`` 0) or upper (1) edge of the front's ``axis`` (0 width, 1 height), if its beginning
    is seen."""
    edge, extent = (front.lo, front.hi)[end][axis], (front.hi - front.lo)[axis]
    behind = front.back - faces.middle[:, 0]
    from_edge = np.abs(faces.middle[:, 1 + axis] - edge)
    wall = (
        (np.abs(faces.normal[:, 1 + axis]) > FLAT)
        & (from_edge < BESIDE * extent)
        & front.across(faces)
        & (behind > voxel)
    )
    if not wall.any():
        return None
    # the outermost of the places where most of it is
    profile = np.convolve(np.bincount((from_edge[wall] / voxel).astype(int), faces.area[wall]), np.ones(3), "same")
    place = (np.argmax(profile > 0.5 * profile.max()) + 1.5) * voxel
    wall &= np.abs(from_edge - place) < 3 * voxel
    other = 1 - axis
    cells = np.floor((faces.middle[wall, 1 + other] - front.lo[other]) / voxel)
    if len(np.unique(cells)) < BEGINNING * (front.hi - front.lo)[other] / voxel:
        return None
    at = edge + (1.0, -1.0)[end] * quantile(from_edge[wall], faces.area[wall], OUTER)
    lo, hi = _extent(faces.middle[wall, 1 + other], faces.area[wall], voxel)
    return Side(at, lo, hi, float(np.quantile(faces.middle[wall, 0], 0.02)), float(faces.area[wall].sum()))


def has_rear(faces: Faces, front: Front, voxel: float) -> bool:
    """Whether a plate is seen behind the front, across the direction of sliding."""
    plate = (np.abs(faces.normal[:, 0]) > 0.7) & front.across(faces) & (front.back - faces.middle[:, 0] > 6 * voxel)
    if not plate.any():
        return False
    place = np.floor((front.back - faces.middle[plate, 0]) / voxel).astype(int)
    profile = np.convolve(np.bincount(place, faces.area[plate]), np.ones(5), "same")
    return bool(profile.max() > REAR * np.prod(front.hi - front.lo))


def end_of_body(body: Mesh, front: Front) -> Optional[float]:
    """How far inwards the body goes on behind the front, along the front's first axis; None where there is none."""
    faces = Faces(body, front.axes)
    behind = faces.middle[front.across(faces) & (faces.middle[:, 0] < front.back), 0]
    return float(np.quantile(behind, 0.02)) if len(behind) else None


def mouth_of(front: Front, sides: Sequence[Sequence[Optional[Side]]], eyes: Tensor) -> Optional[tuple[int, int]]:
    """(axis, end) of the side that most cameras face, of those between two seen ones: a tray is looked into. None
    without two such.

    sides: by axis and end.  eyes [V, 3]: the cameras, in the mesh's coordinates.
    """
    middle = np.array([front.back, *(front.lo + front.hi) / 2])

    def faced(side: tuple[int, int]) -> float:
        axis, end = side
        at = middle.copy()
        at[1 + axis] = (front.lo, front.hi)[end][axis]
        outward = (-1.0, 1.0)[end] * front.axes[1 + axis]
        return facing(torch.as_tensor(at @ front.axes)[None], torch.as_tensor(outward), eyes)

    return max(((axis, end) for axis in (0, 1) if all(sides[1 - axis]) for end in (0, 1)), key=faced, default=None)


@dataclass(frozen=True)
class Tray:
    """An open box behind a front. lo, hi [3]: its corners in the front's axes; mouth: (axis, end) of its open side,
    across the first.

    travel: how far it slides out.  drawn: the state in which it is out, 0 or 1.  shut [4, 4]: brings what it slides
    into from its place in the start state to where, as seen from the drawer in its own, it is when the drawer is shut.
    """

    front: Front
    lo: np.ndarray
    hi: np.ndarray
    mouth: tuple[int, int]
    travel: float
    drawn: int
    shut: np.ndarray

    def within(self, points: np.ndarray) -> np.ndarray:
        """How far within each of its six sides points [N, 3], in the front's axes, are; negative outside, [N, 6]: first
        those at ``lo``."""
        return np.concatenate([points - self.lo, self.hi - points], 1)

    @property
    def mouth_side(self) -> int:
        """Which of the six sides is the mouth."""
        axis, end = self.mouth
        return 3 * end + 1 + axis


def find_tray(mesh: Mesh, body: Mesh, slide: np.ndarray, eyes: Tensor, voxel: float) -> Optional[Tray]:
    """The tray of which ``mesh`` is what was seen; None where it is none, or was seen to its rear.

    body: what it slides into.  slide [4, 4]: its motion from the start state, in which both meshes stand, to the end.
    eyes [V, 3]: the cameras, in the sliding part's coordinates.
    """
    travel, drawn, shut = float(np.linalg.norm(slide[:3, 3])), 1, np.eye(4)
    if travel < voxel:
        return None
    outward = slide[:3, 3] / travel
    if (_centre(mesh) - _centre(body)) @ outward < 0:  # it slides in, and is shut at the end
        outward, drawn, shut = -outward, 0, np.linalg.inv(slide)
        body = body.transformed(shut)
    front = find_front(mesh, outward, voxel)
    end = None if front is None else end_of_body(body, front)
    if end is None or front.back - end < LEAST * voxel:
        return None
    faces = Faces(mesh, front.axes)
    if has_rear(faces, front, voxel):
        return None
    sides = [[find_side(faces, front, axis, e, voxel) for e in (0, 1)] for axis in (0, 1)]
    mouth = mouth_of(front, sides, eyes)
    if mouth is None:
        return None
    across, beside = mouth[0], 1 - mouth[0]
    pair, lid, bottom = sides[beside], sides[across][mouth[1]], sides[across][1 - mouth[1]]
    lo, hi = np.empty(3), np.empty(3)
    lo[0], hi[0] = min(front.back - DEPTH * (front.back - end), *(x.inner for x in pair)), front.back
    lo[1 + beside], hi[1 + beside] = pair[0].at, pair[1].at
    lo[1 + across], hi[1 + across] = min(x.lo for x in pair), max(x.hi for x in pair)
    out = min(travel, front.back - end) * (hi - lo)[1 + beside]  # area of the mouth as far as it comes out
    if lid is not None and lid.area > LID * out:
        return None
    if bottom is not None and bottom.area > BOTTOM * out:
        (lo, hi)[1 - mouth[1]][1 + across] = bottom.at
    return Tray(front, lo, hi, mouth, travel, drawn, shut)


def complete_tray(
    mesh: Mesh, tray: Tray, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float, clearance: float
) -> Mesh:
    """The mesh of what was seen of a sliding part, with the sides, bottom and rear of its tray where nothing was seen,
    and without what is not the tray's.

    views, poses, voxel, clearance: as in ``close_unseen_sides``, of the sliding part.
    """
    mesh = _without_strays(mesh, tray, NEAR * voxel)
    seen, colours = search_tree(mesh.vertices), mesh.colours
    for axis, e in ((1, 0), (1, 1), (2, 0), (2, 1), (0, 0)):
        if (axis - 1, e) == tray.mouth:
            continue
        a, b = tray.lo.copy(), tray.hi.copy()
        a[axis] = b[axis] = (tray.lo, tray.hi)[e][axis]
        points, shape = _lattice(a, b, voxel)
        points = points @ tray.front.axes
        if seen_empty(torch.as_tensor(points), views, poses, clearance).double().mean() > NOTHING:
            continue
        distance, nearest = seen.query(points)
        plate = grid_plane(points, (distance > APART * voxel).reshape(shape), colours[nearest], 1.0)
        if len(plate.faces):
            mesh = sewn(mesh, plate, NEAR * voxel)
    return mesh


def clear_way(body: Mesh, tray: Tray, voxel: float) -> Mesh:
    """What a tray slides into (in the start state) without what stands in its way, as dim insides of drawers are drawn
    as lids, which may be taken for the body's; and without what lies on its bottom and faces its mouth where it stands
    while it is open: it would hide a board of the body's there."""
    faces = Faces(body.transformed(tray.shut), tray.front.axes)
    within, into = tray.within(faces.middle), faces.normal[:, 1 + tray.mouth[0]] * (2 * tray.mouth[1] - 1) > FLAT
    within[:, 3] += tray.travel  # towards the front
    inside = within > CLEAR * voxel
    bottom = (tray.mouth_side + 3) % 6
    covered = (within[:, 0] > tray.travel + CLEAR * voxel) & np.delete(inside, bottom, 1).all(1)
    on_bottom = covered & into & (within[:, bottom] > -ON * voxel)
    return _without(body, inside.all(1) | on_bottom)


def not_the_trays(other: Mesh, tray: Tray, place: np.ndarray, voxel: float) -> Mesh:
    """Another moving part's mesh (in its start state) without what lies in or on the tray while that is open: sides of
    the tray that were labelled as the other's.

    place [4, 4]: from the other part's start state to where, as seen from the drawer in its own, it is while the drawer
    is open.
    """
    middle = Faces(other.transformed(place), tray.front.axes).middle
    return _without(other, (tray.within(middle) > -ON * voxel).all(1))


def _without_strays(mesh: Mesh, tray: Tray, reach: float) -> Mesh:
    """The mesh without what lies behind the front and farther than ``reach`` outside the tray, but before its mouth:
    another part's."""
    middle = Faces(mesh, tray.front.axes).middle
    outside = np.stack([tray.lo[1:] - middle[:, 1:], middle[:, 1:] - tray.hi[1:]], 2) > reach
    outside[:, tray.mouth[0], tray.mouth[1]] = False
    return _without(mesh, (middle[:, 0] < tray.front.back - reach) & outside.any((1, 2)))


def _without(mesh: Mesh, gone: np.ndarray) -> Mesh:
    """The mesh without the triangles ``gone`` [F] bool; itself where there are none."""
    return mesh.only(~gone) if gone.any() else mesh


def _centre(mesh: Mesh) -> np.ndarray:
    return (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2


def _lattice(lo: np.ndarray, hi: np.ndarray, step: float) -> tuple[np.ndarray, list[int]]:
    """Points [n, 3] about ``step`` apart between two corners [3], and how many along each of the axes that are not
    flat."""
    axes = [
        np.linspace(a, b, max(2, round((b - a) / step) + 1)) if b > a else np.array([a])
        for a, b in zip(lo, hi, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), [len(x) for x in axes if len(x) > 1]
