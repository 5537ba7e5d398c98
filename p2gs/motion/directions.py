"""Directions that an object has: what many of its surfaces face, and where such facings cross. Made things have few,
and most joints lie along one of them."""

from __future__ import annotations

import math
from itertools import combinations

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import shortest_axes
from p2gs.motion.discovery.hypotheses import shared_directions
from p2gs.motion.discovery.rigid import one_way, perpendicular
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.ops.least_squares import least_squares
from p2gs.ops.robust import MEDIAN_SIGMA

WITHIN = 15.0  # degrees within which a direction is one that is known, or an axis is meant to lie along it
KNOWN = 1.0  # degrees to which directions are known, or an axis is another's
# internal units (the object's diagonal is 2): hinge lines that carry a part this near to each other are one
LINE = 0.04
SQUARE = 3.0  # degrees: directions that are so near to a right angle are at one
FACING = 0.99  # cosine between a point's normal and the facing of the planes that it is taken for a point of: 8 degrees
FEWEST = 20  # points of a plane
ROUNDS = 3  # of planes found and fitted


def directions_of(states: list[StateGaussians], motions: PartMotions) -> Tensor:
    """[D, 3] directions (float64) that the static Gaussians of both states face, and those besides (farther than
    ``WITHIN`` from them) that what slid faces, too: it did not turn, but a shut drawer's surfaces are worse."""
    slid = torch.tensor([True, *(kind == "prismatic" for kind in motions.types)])
    still = _faced(states, [of.cpu() == 0 for of in motions.labels])
    more = _faced(states, [slid[of.cpu()] for of in motions.labels]) if slid[1:].any() else still[:0]
    apart = math.cos(math.radians(WITHIN))
    return torch.cat([still, more[((more @ still.T).abs() < apart).all(1)]])


def _faced(states: list[StateGaussians], chosen: list[Tensor]) -> Tensor:
    """[D, 3]: ``shared_directions`` of the normals of the solid Gaussians ``chosen`` [N] bool of each state, each
    fitted to the planes that face it (``common_normal``), and squared with the others (``squared``)."""
    points, normals = [], []
    for state, of in zip(states, chosen, strict=True):
        g = state.gaussians.detach()
        still = of & g.solid.cpu()
        surface = g[still.to(g.means.device)].to("cpu")
        normals.append(shortest_axes(surface))
        points.append(surface.means)
    points, normals = torch.cat(points), torch.cat(normals)
    found = shared_directions(normals).double()
    if not len(found):
        return found
    gap = 0.5 * float(knn(points, None, 1, True)[0].median())
    fits = [common_normal(points.double(), normals.double(), d, gap) for d in found]
    return squared(torch.stack([d for d, _ in fits]), torch.stack([known for _, known in fits]))


def squared(directions: Tensor, known: Tensor) -> Tensor:
    """Directions [D, 3] of which those within ``SQUARE`` of right angles to one another are at right angles: one
    rotation of a frame, fitted to all of them by what is known of each, ``known`` [D, 3, 3] (information of its tilt).
    Fronts, seen by every camera, are known ten times better than tops and undersides.
    """
    off = torch.rad2deg(torch.asin((directions @ directions.T).abs().clamp_max(1)))
    best: list[int] = []
    for i in range(len(directions)):
        group = [i]
        for j in known.diagonal(dim1=1, dim2=2).sum(1).argsort(descending=True).tolist():
            if j not in group and all(float(off[j, k]) < SQUARE for k in group):
                group.append(j)
        best = max(best, group, key=len)
    if len(best) < 2:
        return directions
    U, _, Vt = torch.linalg.svd(directions[best])
    frame = U @ Vt[: len(best)]  # the nearest with right angles
    for _ in range(ROUNDS):
        cross = torch.stack([_crossed(d) for d in frame])  # a small turn w moves a direction by cross @ w
        H = (cross.transpose(1, 2) @ known[best] @ cross).sum(0)
        g = (cross.transpose(1, 2) @ known[best] @ (directions[best] - frame)[..., None]).sum(0)
        turn = torch.linalg.pinv(H, hermitian=True) @ g
        frame = frame @ so3.rotvec_to_matrix(turn[:, 0]).T
    out = directions.clone()
    out[best] = frame
    return out


def _crossed(d: Tensor) -> Tensor:
    """[3, 3] C with w x d = C w."""
    return torch.linalg.cross(torch.eye(3, dtype=d.dtype), d.expand(3, 3)).T


def common_normal(points: Tensor, normals: Tensor, direction: Tensor, gap: float) -> tuple[Tensor, Tensor]:
    """The normal [3] that the planes share which face about ``direction`` [3]: least squares over all planes at once,
    each with an offset of its own, Geman-McClure weights for what lies off its plane; and how well it is known, the
    information [3, 3] of its tilt.

    points, normals: [N, 3].  gap: offsets farther apart than this are of two planes.  The direction itself, and 0,
    where no plane faces it.
    """
    known = torch.zeros(3, 3).double()
    points = points[(normals @ direction).abs() > FACING]
    for _ in range(ROUNDS if len(points) >= FEWEST else 0):
        e = torch.stack(list(perpendicular(direction)))
        offset = points @ direction
        order = offset.argsort()
        plane = torch.zeros(len(order), dtype=torch.int64)
        plane[1:] = (offset[order].diff() > gap).long().cumsum(0)
        A, b = torch.zeros(2, 2).double(), torch.zeros(2).double()
        for rows in order.split(torch.bincount(plane).tolist()):
            if len(rows) >= FEWEST:
                one, two = _tilt(points[rows] @ e.T, offset[rows])
                A, b = A + one, b + two
        if float(torch.linalg.matrix_rank(A)) < 2:
            break
        tilt = torch.linalg.solve(A, b)
        direction, known = torch.nn.functional.normalize(direction - tilt @ e, dim=0), e.T @ A @ e
    return direction, known


def _tilt(across: Tensor, offset: Tensor, rounds: int = 5) -> tuple[Tensor, Tensor]:
    """Normal equations (A [2, 2], b [2]) of a plane's tilt: offset [M] against place ``across`` [M, 2], in units of the
    residuals' spread."""
    x, y = across - across.mean(0), offset - offset.mean()
    weight = torch.ones_like(y)
    A = b = torch.zeros(0)
    for _ in range(rounds):
        A, b = (x * weight[:, None]).T @ x, (x * weight[:, None]).T @ y
        residual = y - x @ least_squares(A, b)
        spread = MEDIAN_SIGMA * float(residual.abs().median()) + 1e-9
        weight = 1 / (1 + (residual / (2 * spread)).square()).square()
        A, b = A / spread**2, b / spread**2
    return A, b


def axis_of(kind: str, T: Tensor) -> Tensor:
    """Direction [3] of a joint's axis, of its motion [4, 4]."""
    return torch.nn.functional.normalize(T[:3, 3], dim=0) if kind == "prismatic" else se3.screw_parameters(T).axis


def shared_axes(transforms: Tensor, types: list[str]) -> Tensor:
    """[K, 3] the direction that a slide has from the slides along the very same one (a row of drawers), NaN for all
    other joints. transforms [K, 4, 4] of types."""
    out = torch.full((len(types), 3), torch.nan, dtype=torch.float64)
    slides = [k for k, kind in enumerate(types) if kind == "prismatic"]
    ways = out.clone()
    for k in slides:
        ways[k] = axis_of("prismatic", transforms[k].double().cpu())
    for k in slides:
        if int(one_way(ways, ways[k]).sum()) > 1:
            out[k] = ways[k]
    return out


def hinged_directions(motions: PartMotions, faced: Tensor | None = None) -> Tensor:
    """[D, 3] (float64) what two hinges' axes agree on to ``KNOWN`` degrees, the mean of each such pair, and the axis of
    each hinge that lies so near to a direction ``faced`` [F, 3] of surfaces: measured by motion, where few points tell
    which way a top or a front faces. Hinges on one line are one that was found twice, unless they turn by other angles
    (to ``WITHIN``)."""
    found = [se3.screw_parameters(T.double()) for T, kind in zip(motions.transforms, motions.types, strict=True)
             if kind == "revolute"]  # fmt: skip
    least = math.cos(math.radians(KNOWN))
    out = []
    for a, b in combinations(found, 2):
        alike, between = a.axis @ b.axis, b.origin - a.origin
        apart = float((between - a.axis * (a.axis @ between)).norm())
        twice = apart <= LINE and abs(float(a.angle - torch.sign(alike) * b.angle)) <= math.radians(WITHIN)
        if abs(float(alike)) > least and not twice:
            out.append(torch.nn.functional.normalize(a.axis + torch.sign(alike) * b.axis, dim=0))
    if faced is not None and len(faced):
        out += [a.axis for a in found if float((faced @ a.axis).abs().max()) > least]
    return torch.stack(out) if out else torch.zeros(0, 3).double()


def has_own_axis(states: list[StateGaussians], motions: PartMotions, part: int, coarse: bool = False) -> bool:
    """Whether no other joint of its type has the axis of joint ``part``, to ``KNOWN`` degrees; a turn's must be
    another's line, too: as large a turn about that takes the part's points to within ``LINE`` of their place.

    coarse: motions are not final yet, hinge lines known to ``WITHIN`` degrees.
    """
    kind, T = motions.types[part], motions.transforms.double()
    axis, others = axis_of(kind, T[part]), [k for k, t in enumerate(motions.types) if t == kind and k != part]
    least = math.cos(math.radians(WITHIN if coarse and kind == "revolute" else KNOWN))
    others = [k for k in others if abs(float(axis_of(kind, T[k]) @ axis)) > least]
    points = states[0].gaussians.means[motions.labels[0] == part + 1].double()
    if kind == "prismatic" or not len(points):
        return not others
    angle = se3.screw_parameters(T[part]).angle
    for line in map(se3.screw_parameters, T[others]):
        about = se3.from_screw(line.axis * torch.sign(line.axis @ axis), line.origin, angle)
        if float(se3.mean_gap(about, T[part], points)) < LINE:
            return False
    return True


def turned_onto(kind: str, T: Tensor, direction: Tensor, middle: Tensor) -> Tensor:
    """The motion [4, 4] with its axis along ``direction`` [3]: a slide's part along it; of the turns about it the one
    that differs by the least angle, at a place where ``middle`` [3], the part's at the start, goes as far across it as
    it did (no turn about it at all is none)."""
    d = direction * torch.sign(direction @ axis_of(kind, T))
    out = torch.eye(4, dtype=T.dtype)
    if kind == "prismatic":
        out[:3, 3] = d * (T[:3, 3] @ d)
        return out
    q = so3.matrix_to_quat(T[:3, :3])
    angle = 2 * torch.atan2(q[1:] @ d, q[0])  # the twist about d
    if float(angle) == 0:
        return out
    across = se3.apply(T, middle[None])[0] - middle
    R = so3.rotvec_to_matrix(d * angle)
    return se3.make(R, middle + across - d * (across @ d) - R @ middle)
