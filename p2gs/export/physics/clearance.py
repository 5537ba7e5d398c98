"""Room for every joint: collision pieces of different parts are trimmed until none touches another one over the whole
range.

Reconstructed surfaces of parts that fit closely overlap by a voxel, and a convex piece stands out of the surface it
covers. A simulator takes either for a contact that stops the joint. What a part passed through between the two
photographed states was free, so a piece that reaches into that space is cut back by planes, which leaves it convex. A
sweep is covered by the hulls of a piece at two near joint values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Optional

import numpy as np

from p2gs.export.links import Hinge, Link, joint_motion
from p2gs.export.physics.convex import Piece, cut, separation

GAP = 0.003  # share of the object's diagonal that is left between parts: Bullet alone adds 1 mm around each hull
# share of the diagonal up to which an overlap is an error of the surfaces, which both parts give way to by half
SHALLOW = 0.02
ROUNDS = 4  # passes in which pieces may fall apart; the last one cuts by single planes, so that it ends
LEAST = 0.15  # share of a piece's thickness (and of its volume) below which what is left of it goes


@dataclass
class Body:
    """The pieces of a link in world axes at the start state, and its joint (None: the base)."""

    name: str
    pieces: list[Piece]
    joint: Optional[Hinge]
    before: float  # volume of the pieces when clearing began

    @property
    def hinge(self) -> Hinge:
        """The joint of a body that moves. Raises ValueError for the base."""
        if self.joint is None:
            raise ValueError(f"the body '{self.name}' has no joint")
        return self.joint


@dataclass(frozen=True)
class Cleared:
    """links: with trimmed pieces.  lost: share of each link's collision volume that went, by name.  blocking: (moving
    link, other link) pairs that run into each other in one of the other's recorded states, though not in both, as
    photographed: a door before a drawer."""

    links: list[Link]
    lost: dict[str, float]
    blocking: list[tuple[str, str]]


def clear_links(links: list[Link]) -> Cleared:
    """The links with collision pieces that are free of those of every other link: of the base over each joint's whole
    range, of each other in both recorded states and over the range while the other one is in a recorded state that
    leaves room (at least one does)."""
    bodies = [body_of(link) for link in links]
    solid = [b for b in bodies if b.pieces]
    if len(solid) < 2:
        return Cleared(links, {b.name: 0.0 for b in bodies}, [])
    points = np.concatenate([p.vertices for b in solid for p in b.pieces])
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    gap, blocking = GAP * diagonal, []
    for a in (b for b in solid if b.joint is not None):
        steps = sweep_values(a, gap)
        for b in solid:
            if b is a:
                continue
            if b.joint is None:
                _free(a, b, steps, np.eye(4), gap, diagonal)
                continue
            # both recorded states first: they hold whatever stands in the way later
            for value in (0.0, b.hinge.motion):
                own = 0.0 if value == 0.0 else a.hinge.motion
                _free(a, b, np.array([own]), joint_motion(b.hinge, value), gap, diagonal)
    for a in (b for b in solid if b.joint is not None):
        steps = sweep_values(a, gap)
        for b in (b for b in solid if b is not a and b.joint is not None):
            poses = [joint_motion(b.hinge, v) for v in (0.0, b.hinge.motion)]
            depths = [_depth(a, b, steps, pose, gap) for pose in poses]
            deep = [d > SHALLOW * diagonal for d in depths]
            if any(deep):
                blocking.append((a.name, b.name))
            for i in range(2):
                if not deep[i] or (all(deep) and i == int(np.argmin(depths))):
                    _free(a, b, steps, poses[i], gap, diagonal)
    out = [
        replace(link, collision=[_moved(p, -link.origin) for p in b.pieces])
        for link, b in zip(links, bodies, strict=True)
    ]
    lost = {b.name: 1 - sum(p.volume for p in b.pieces) / max(b.before, 1e-300) for b in bodies}
    return Cleared(out, lost, blocking)


def body_of(link: Link) -> Body:
    """The link's pieces in world axes at the start."""
    pieces = [_moved(p, link.origin) for p in link.collision]
    return Body(link.name, pieces, link.joint, sum(p.volume for p in pieces))


def _moved(piece: Piece, shift: np.ndarray) -> Piece:
    return Piece(piece.vertices + shift, piece.faces)


def sweep_values(body: Body, gap: float) -> np.ndarray:
    """Joint values [n] over the range, so near that the arc between two leaves their hull by less than a quarter of
    ``gap``."""
    h = body.hinge
    lower, upper = min(h.lower, 0.0, h.motion), max(h.upper, 0.0, h.motion)
    if h.type == "prismatic":
        return np.array([lower, upper])
    points = np.concatenate([p.vertices for p in body.pieces]) - h.origin
    rim = float(np.linalg.norm(np.cross(points, h.axis), axis=1).max())
    step = np.sqrt(2 * gap / max(rim, gap))  # sagitta: rim * step^2 / 8 = gap / 4
    return np.linspace(lower, upper, max(2, int(np.ceil((upper - lower) / step)) + 1))


def _poses(body: Body, values: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Motions [4, 4] at both ends of each step of the sweep; of the one pose where ``values`` has one."""
    at = [joint_motion(body.hinge, v) for v in values]
    return [(at[0],)] if len(at) == 1 else list(zip(at[:-1], at[1:], strict=True))


def _swept(piece: Piece, poses: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.concatenate([piece.vertices @ T[:3, :3].T + T[:3, 3] for T in poses])


def _close(a: Body, b: Body, poses: tuple[np.ndarray, ...], other: np.ndarray, gap: float) -> list[tuple[int, int]]:
    """Pairs (piece of a, piece of b) whose boxes come within ``gap`` of each other."""
    if not a.pieces or not b.pieces:
        return []
    mine, others = [_swept(p, poses) for p in a.pieces], [_swept(p, (other,)) for p in b.pieces]
    lo, hi = np.array([m.min(0) for m in mine]), np.array([m.max(0) for m in mine])
    lo2, hi2 = np.array([m.min(0) for m in others]), np.array([m.max(0) for m in others])
    near = ((lo[:, None] - gap < hi2[None]) & (lo2[None] - gap < hi[:, None])).all(-1)
    return [(int(i), int(j)) for i, j in zip(*np.nonzero(near), strict=True)]


def _depth(a: Body, b: Body, values: np.ndarray, other: np.ndarray, gap: float) -> float:
    """How deep pieces of ``a`` over its sweep reach into those of ``b`` at ``other``; 0 where they do not."""
    deepest = 0.0
    for poses in _poses(a, values):
        for i, j in _close(a, b, poses, other, 0.0):
            deepest = max(deepest, separation(_hull_of(a.pieces[i], poses), _hull_of(b.pieces[j], (other,)))[0])
    return deepest


def touches(a: Body, b: Body, values: np.ndarray, other: np.ndarray, margin: float) -> bool:
    """Whether a piece of ``a``, moved through joint values [n], comes within ``margin`` of one of ``b`` at ``other``
    [4, 4]."""
    for poses in _poses(a, values):
        for i, j in _close(a, b, poses, other, margin):
            if separation(_hull_of(a.pieces[i], poses), _hull_of(b.pieces[j], (other,)))[0] > -margin:
                return True
    return False


def _hull_of(piece: Piece, poses: tuple[np.ndarray, ...]) -> Piece:
    if len(poses) == 1:
        return Piece(_swept(piece, poses), piece.faces)
    import trimesh

    mesh = trimesh.convex.convex_hull(_swept(piece, poses))
    return Piece(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


def without(piece: Piece, sweep: Piece, gap: float) -> list[Piece]:
    """What of a piece lies outside the box of a sweep and ``gap`` beyond it, as convex pieces: the largest is cut off
    first."""
    import trimesh

    to_box, extents = trimesh.bounds.oriented_bounds(trimesh.Trimesh(sweep.vertices, sweep.faces, process=False))
    axes, half = to_box[:3, :3], extents / 2 + gap
    center = -axes.T @ to_box[:3, 3]
    planes = [(s * axes[k], s * float(axes[k] @ center) + half[k]) for k in range(3) for s in (1.0, -1.0)]
    out: list[Piece] = []
    rest: Optional[Piece] = piece
    while planes and rest is not None:
        outside = [cut(rest, -n, -d) for n, d in planes]
        k = int(np.argmax([0.0 if p is None else p.volume for p in outside]))
        n, d = planes.pop(k)
        largest = outside[k]
        if largest is not None and _thickness(largest) > gap:
            out.append(largest)
        rest = cut(rest, n, d)
    return out


def _moved_by(piece: Piece, T: np.ndarray) -> Piece:
    return Piece(piece.vertices @ T[:3, :3].T + T[:3, 3], piece.faces)


def _free(a: Body, b: Body, values: np.ndarray, other: np.ndarray, gap: float, diagonal: float) -> None:
    """Trim pieces of both until those of ``a``, moved through ``values``, keep ``gap`` from those of ``b`` at
    ``other``."""
    for poses in _poses(a, values):
        for last in (False,) * ROUNDS + (True,):  # pieces that fell apart are looked at again
            if not _trim(a, b, poses, other, gap, np.inf if last else SHALLOW * diagonal):
                break


def _trim(a: Body, b: Body, poses: tuple[np.ndarray, ...], other: np.ndarray, gap: float, shallow: float) -> bool:
    """One pass over the pairs of pieces: both give way by half where they overlap by up to ``shallow``; beyond that the
    piece of ``b`` is wrong, as the part passed there, and what of it lies in the sweep goes. True where a piece fell
    apart."""
    gone_a: set[int] = set()
    new: list[Piece] = []
    kept: list[Optional[Piece]] = list(b.pieces)
    for i, j in _close(a, b, poses, other, gap):
        mine, theirs = a.pieces[i], kept[j]
        if i in gone_a or theirs is None:
            continue
        sweep, there = _hull_of(mine, poses), _hull_of(theirs, (other,))
        depth, normal, offset_a, offset_b = separation(sweep, there)
        if depth <= -gap:
            continue
        if depth > shallow:
            kept[j] = None
            new += [_moved_by(q, np.linalg.inv(other)) for q in without(there, sweep, gap)]
            continue
        plane = (offset_a + offset_b) / 2  # a ends at offset_a, b begins at offset_b, along the normal
        trimmed: Optional[Piece] = mine
        for T in poses:
            if trimmed is not None:
                trimmed = _cut_world(trimmed, T, normal, plane - gap / 2)
        if trimmed is None:
            gone_a.add(i)
        else:
            a.pieces[i] = trimmed
        kept[j] = _cut_world(theirs, other, -normal, -(plane + gap / 2))
    a.pieces = [p for i, p in enumerate(a.pieces) if i not in gone_a]
    b.pieces = [p for p in kept if p is not None] + new
    return bool(new)


def _cut_world(piece: Piece, T: np.ndarray, normal: np.ndarray, offset: float) -> Optional[Piece]:
    """What of a piece, given at the start, lies at ``normal . x <= offset`` when it is moved by T; None where that is
    next to nothing."""
    n, d = T[:3, :3].T @ normal, offset - float(normal @ T[:3, 3])
    along = piece.vertices @ n
    if along.max() <= d:
        return piece
    rest = cut(piece, n, d)
    thin = d - along.min() < LEAST * min(np.ptp(along), _thickness(piece))
    return None if rest is None or thin or rest.volume < LEAST**2 * piece.volume else rest


def _thickness(piece: Piece) -> float:
    normals = piece.planes()[0]
    return float(np.ptp(piece.vertices @ normals.T, axis=0).min())
