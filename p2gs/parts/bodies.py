"""A part is one body: pieces of one motion are one part only where they touch or can be joined through space that
nobody saw empty and no other part holds.

Two flaps or drawers a hand apart that travel alike look like one motion. They are two parts, each with a motion of its
own. Where a look goes between them they surely are. Where only another part's surface is between, it may have a slot
that nobody saw (a slider's knob and tip), so that there two motions must explain more than one does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3
from p2gs.ops.components import TOUCH, components
from p2gs.visibility.depth_stack import DepthStack, classify

FEWEST = 30  # points of a body in each state: a plate of 5 x 6 of them
# points, too, of one of several bodies of a small part, and least share of the points of its largest
SMALL, ALIKE = 12, 0.5
BRIDGES = 256  # lines between two pieces that are tried, from the shortest up
STOPS = 9  # points looked at on each line


@dataclass
class Surfaces:
    """Surface points [N, 3] of both states with the parts [N] that they belong to (0 static), how far apart they lie,
    and the states' rendered depth with its tolerance along the ray (internal units)."""

    points: list[Tensor]
    labels: list[Tensor]
    spacing: float
    stacks: list[DepthStack]
    tau: float


def seen_empty(points: Tensor, motion: Tensor, stacks: list[DepthStack], tau: float) -> Tensor:
    """[N] bool: did either state's cameras look through this place of a part? points [N, 3] at the start; motion [4,
    4]; tau: tolerance."""
    empty = torch.zeros(len(points), dtype=torch.bool)
    for s, stack in enumerate(stacks):
        x = se3.apply(motion, points) if s else points
        free, on, _ = stack.counts(x.float(), tau)
        empty |= classify(free, on)[0]
    return empty


def pairs_between(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Points [L, 3] of ``a`` [N, 3], at most ``BRIDGES``, and the nearest of ``b`` [M, 3] to each [L, 3]."""
    d, j = cKDTree(b.numpy()).query(a.numpy())
    order = np.argsort(d, kind="stable")
    order = order[np.unique(np.linspace(0, len(order) - 1, min(BRIDGES, len(order))).astype(int))]
    return a[order], b[j[order]]


def lines_between(start: Tensor, end: Tensor) -> Tensor:
    """[STOPS, L, 3] places on the lines between ``start`` and ``end`` [L, 3]."""
    share = torch.linspace(0, 1, STOPS + 2, dtype=torch.float64)[1:-1, None, None]
    return start + share * (end - start)


def looked_through(lines: Tensor, motion: Tensor, stacks: list[DepthStack], tau: float) -> Tensor:
    """[L] bool: was some place on each of ``lines`` [S, L, 3] (at the start) seen empty?"""
    return seen_empty(lines.reshape(-1, 3), motion, stacks, tau).reshape(lines.shape[:2]).any(0)


def bridged(
    a: Tensor, b: Tensor, motion: Tensor, stacks: list[DepthStack], tau: float, others: cKDTree | None, reach: float
) -> bool:
    """Can two pieces [N, 3], [M, 3] (at the start) be one body: is some line between them nowhere seen empty, nor near
    another part's surface (``others``, at the start, within ``reach``)?"""
    lines = lines_between(*pairs_between(a, b))
    closed = looked_through(lines, motion, stacks, tau)
    if others is not None:
        near = others.query(lines.reshape(-1, 3).numpy())[0] < reach
        closed |= torch.from_numpy(near).reshape(lines.shape[:2]).any(0)
    return not bool(closed.all())


def bodies_of(surfaces: Surfaces, part: int, motion: Tensor, held: bool) -> list[list[Tensor]]:
    """The bodies that a part consists of, the largest first, each as its rows of either state's points; none of fewer
    than ``FEWEST`` in a state, or than ``SMALL`` where the largest is not twice as large (what one state alone shows
    may be anything).  motion [4, 4] start -> end.  held: another part's surface between two pieces parts them, too, not
    a look that goes between them alone.
    """
    rows = [(of == part + 1).nonzero().squeeze(1) for of in surfaces.labels]
    if min(map(len, rows)) < 2 * SMALL:
        return [rows]
    places = [surfaces.points[s][rows[s]].double() for s in (0, 1)]
    points = torch.cat([places[0], se3.apply(se3.inverse(motion), places[1])])
    piece, split = components(points, TOUCH * surfaces.spacing), len(rows[0])
    sizes = [(int((piece[:split] == c).sum()), int((piece[split:] == c).sum())) for c in range(piece.max() + 1)]
    most = [max(n[s] for n in sizes) for s in (0, 1)]
    enough = [min(FEWEST, max(SMALL, ALIKE * n)) for n in most]
    large = [c for c, n in enumerate(sizes) if n[0] >= enough[0] and n[1] >= enough[1]]
    large.sort(key=lambda c: -sum(sizes[c]))
    if len(large) < 2:
        return [rows]
    rest = surfaces.points[0][surfaces.labels[0] != part + 1]
    others = cKDTree(rest.numpy()) if held and len(rest) else None
    group = {c: c for c in large}
    for i, c in enumerate(large):
        for other in large[:i]:
            if group[c] == group[other]:
                continue
            a, b = points[torch.from_numpy(piece == c)], points[torch.from_numpy(piece == other)]
            if bridged(a, b, motion, surfaces.stacks, surfaces.tau, others, 0.5 * surfaces.spacing):
                old, new = group[c], group[other]
                group = {k: new if v == old else v for k, v in group.items()}
    out = []
    for g in dict.fromkeys(group[c] for c in large):
        mine = torch.from_numpy(np.isin(piece, [c for c in large if group[c] == g]))
        out.append([rows[0][mine[:split]], rows[1][mine[split:]]])
    return sorted(out, key=lambda r: -sum(map(len, r)))


def one_part_a_body(
    states: list[StateGaussians], motions: PartMotions, surfaces: Surfaces, limit: int, held: bool = False
) -> tuple[PartMotions, list[dict]]:
    """Each part that consists of several bodies as that many parts, at most ``limit`` in all, with the same motion to
    begin with. held: as for ``bodies_of``.

    Every Gaussian of the part goes to the body next to it. Returns the motions and what was split.
    """
    log: list[dict] = []
    for part in range(len(motions)):
        bodies = bodies_of(surfaces, part, motions.transforms[part], held)[: limit - len(motions) + 1]
        if len(bodies) < 2:
            continue
        labels = [of.clone() for of in motions.labels]
        for s, state in enumerate(states):
            every = (motions.labels[s] == part + 1).nonzero().squeeze(1)
            means = state.gaussians.means[every].cpu().numpy()
            near = np.stack([cKDTree(surfaces.points[s][b[s]].numpy()).query(means)[0] for b in bodies])
            which = torch.from_numpy(near.argmin(0))
            labels[s][every] = torch.where(which == 0, part + 1, len(motions) + which)
        for _ in bodies[1:]:
            motions = motions.with_motion(len(motions), motions.types[part], motions.transforms[part])
            motions = replace(motions, confidence=torch.cat([motions.confidence, motions.confidence[part : part + 1]]))
        motions = replace(motions, labels=labels)
        log.append({"part": part, "bodies": [[len(rows) for rows in b] for b in bodies]})
    return motions, log
