"""Drawers side by side that go alike: one motion explains both, and their fronts abut. Behind the fronts are two trays,
with a gap between them that is narrower than either and that most looks go through: a tray of which two pieces are
seen, its walls or what the drawer above leaves to see, has a wider one or one that nobody saw."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Callable

import numpy as np
import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.directions import axis_of
from p2gs.motion.discovery.rows import FACING, planes
from p2gs.ops import se3
from p2gs.ops.components import TOUCH, components
from p2gs.parts.bodies import FEWEST, lines_between, pairs_between
from p2gs.parts.fronts import Surface, across, in_two, surfels_of
from p2gs.visibility.surfels import Surfels

Look = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Gap:
    """A gap between two pieces of a part, [N, 3] and [M, 3] at the start: the plane in its middle, normal [3] and
    offset along it; how wide it is, and they are (internal units)."""

    pieces: tuple[Tensor, Tensor]
    normal: Tensor
    offset: float
    size: float
    widths: tuple[float, float]

    def lines(self) -> Tensor:
        """[S, L, 3] places in the gap on lines from points of one piece to the nearest of the other."""
        a, b = pairs_between(*self.pieces)
        at, way = (a @ self.normal)[:, None], b - a
        rate = (way @ self.normal)[:, None]
        one, two = (a + (self.offset + half - at) / rate * way for half in (-self.size / 2, self.size / 2))
        return lines_between(one, two)


def part_side_by_side(
    states: list[StateGaussians],
    surfels: list[Surfels],
    motions: PartMotions,
    directions: Tensor,
    apart: float,
    limit: int,
    look: Look,
) -> tuple[PartMotions, list[dict]]:
    """Each slide of which what is behind the front is two trays (``gap_behind``) as two parts with the same motion, up
    to ``limit`` parts. Whether their fronts are two is for both states' photographs to say (``join_seamless``).

    directions [D, 3]: of the object; apart: what surfaces tell apart (internal units); look: which of lines [S, L, 3]
    at the start, carried by a motion [4, 4], were looked through, [L] bool (``bodies.looked_through``). Returns the
    motions and what was split: both parts, the gap's width and those of the pieces beside it.
    """
    log: list[dict] = []
    if "prismatic" not in motions.types:
        return motions, log
    surfaces, spacing = surfels_of(surfels, states, motions), max(s.spacing for s in surfels)
    part = 0
    while part < len(motions) < limit:
        gap = None
        if motions.types[part] == "prismatic":
            gap = gap_behind(surfaces, motions.transforms[part], part, directions, spacing, apart, look)
        if gap is None:
            part += 1
            continue
        log.append({"parts": [part, len(motions)], "gap": gap.size, "widths": list(gap.widths)})
        motions = in_two(states, motions, part, gap.normal, gap.offset)
        surfaces = surfels_of(surfels, states, motions)
    return motions, log


def gap_behind(
    surfaces: list[Surface], T: Tensor, part: int, directions: Tensor, spacing: float, apart: float, look: Look
) -> Gap | None:
    """The narrowest gap, along one of ``directions`` [D, 3] across the way of a slide T [4, 4], between two pieces of
    what is behind the part's front, in both states' surfaces together: wider than what points of one piece leave
    between them, narrower than both pieces, looked through along most lines between them, and with some of the front
    on either side in both states. None without one."""
    T = T.double().cpu()
    way, own = axis_of("prismatic", T), [of.labels == part + 1 for of in surfaces]
    at = [of.points[k] for of, k in zip(surfaces, own, strict=True)]
    points = torch.cat([at[0], se3.apply(se3.inverse(T), at[1])])
    facing = (torch.cat([of.normals[k] for of, k in zip(surfaces, own, strict=True)]) @ way).abs() > FACING
    if int(facing.sum()) < FEWEST:
        return None
    rows = facing.nonzero().squeeze(1)
    rows = rows[max(planes(points[rows], way, spacing, apart), key=len)]
    fronts = [points[rows[rows < len(at[0])]], points[rows[rows >= len(at[0])]]]
    along, reach = points @ way - (points[rows] @ way).median(), TOUCH * spacing
    behind = points[max(along < -reach, along > reach, key=lambda side: int(side.sum()))]
    pieces = _pieces(behind, reach)
    gaps = [_gap(a, b, normal) for normal in across(directions, way) for a, b in combinations(pieces, 2)]
    gaps = [g for g in gaps if reach < g.size < min(g.widths) and all(_on_both_sides(f, g) for f in fronts)]
    gaps = [g for g in gaps if float(look(g.lines(), T).float().mean()) > 0.5]
    return min(gaps, key=lambda g: g.size, default=None)


def _on_both_sides(front: Tensor, gap: Gap) -> bool:
    """Whether enough points of a front [N, 3] lie on either side of a gap."""
    behind = int((front @ gap.normal > gap.offset).sum())
    return min(behind, len(front) - behind) >= FEWEST


def _pieces(points: Tensor, reach: float) -> list[Tensor]:
    """Connected pieces of points [N, 3], those of enough points."""
    if len(points) < FEWEST:
        return []
    piece = components(points, reach)
    return [points[torch.from_numpy(piece == k)] for k in np.flatnonzero(np.bincount(piece) >= FEWEST)]


def _gap(a: Tensor, b: Tensor, normal: Tensor) -> Gap:
    """Between two pieces [N, 3], [M, 3] along a direction [3]; of negative size where they overlap."""
    (a_least, a_most), (b_least, b_most) = ((float(u.min()), float(u.max())) for u in (a @ normal, b @ normal))
    below, above = (a_most, b_least) if a_least < b_least else (b_most, a_least)
    return Gap((a, b), normal, (below + above) / 2, above - below, (a_most - a_least, b_most - b_least))
