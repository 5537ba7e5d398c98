"""A part is one body: pieces of its label that hang apart from it, amid another's surface, belong to that surface.

Two motions can carry the same patch onto some surface of the other state by chance (the side of an opened drawer,
turned with the door below it, lands on the cupboard's front). Such patches are small and lie apart from the part that
lent its motion; a few dozen Gaussians of them shift a hinge by tenths of a degree.
"""

from __future__ import annotations

from functools import partial
from typing import Callable

import numpy as np
import torch
from torch import Tensor

from p2gs.ops import se3
from p2gs.ops.knn import knn
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack

SOLID = 0.3  # opacity from which a Gaussian is surface
NEAR = 4.0  # spacings between neighbours on one surface


def pieces(points: Tensor, labels: Tensor, k: int = 8) -> Tensor:
    """Connected pieces of equal label on the graph of k nearest neighbours within ``NEAR`` spacings: a number for each
    point, [N]."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    distance, index = knn(points, None, min(k, len(points) - 1), True)
    joined = (distance < NEAR * distance[:, 0].median().clamp_min(1e-6)) & (labels[index] == labels[:, None])
    rows = torch.arange(len(points))[:, None].expand_as(index)[joined]
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows.numpy(), index[joined].numpy())), (len(points), len(points)))
    return torch.as_tensor(connected_components(graph, directed=False)[1]).long()


def find_islands(points: Tensor, labels: Tensor, share: float) -> Tensor:
    """Number [N] of the piece of those points whose piece is smaller than ``share`` of its part's largest, -1 for the
    rest.

    points [N, 3]; labels [N]. The base (label 0) may be in many pieces and has no islands.
    """
    out = torch.full((len(points),), -1)
    if len(points) < 10:
        return out
    piece = pieces(points, labels)
    size = torch.bincount(piece)
    for k in range(1, int(labels.max()) + 1):
        own = labels == k
        if own.any():
            small = own & (size[piece] < share * float(size[piece[own]].max()))
            out[small] = piece[small]
    return out


@torch.no_grad()
def settle_islands(
    states: list[GaussianTensors], labels: list[Tensor], transforms: Tensor, share: float
) -> tuple[list[Tensor], list[int]]:
    """Give islands the label of what they touch; where they touch nothing they keep theirs.

    states: Gaussians of the start and of the end; labels [N] of each; transforms [K-1, 4, 4] start -> end.  An island
    that its motion lays for the greater part on the body of the same part in the other state is no island (the inside
    of a drawer behind its front). Returns (labels, how many solid Gaussians changed) by state.
    """
    if share <= 0 or len(transforms) == 0:
        return labels, [0] * len(labels)
    solid = [(torch.sigmoid(g.opacity_logits) > SOLID).nonzero().squeeze(1) for g in states]
    if min(len(rows) for rows in solid) < 10:
        return labels, [0] * len(labels)
    points = [g.means[rows] for g, rows in zip(states, solid, strict=True)]
    old = [lab[rows] for lab, rows in zip(labels, solid, strict=True)]
    island = [find_islands(p, lab, share) for p, lab in zip(points, old, strict=True)]
    out, counts = [], []
    for s in (0, 1):
        T = se3.inverse(transforms) if s else transforms
        lands = partial(_lands, points[s], T, points[1 - s], torch.where(island[1 - s] < 0, old[1 - s], -1))
        new = _settle(points[s], old[s], island[s], lands)
        counts.append(int((new != old[s]).sum()))
        out.append(_with_faint(states[s].means, labels[s], solid[s], new))
    return out, counts


@torch.no_grad()
def settle_twin_islands(
    g: GaussianTensors,
    labels: Tensor,
    share: float,
    away: Tensor,
    stack: DepthStack,
    tau: float,
    held: Tensor | None = None,
) -> Tensor:
    """Labels [N] of a twin, posed in one state, with islands given to what they touch there.

    The twin holds what both states show of a part: a piece that hangs apart from it here has no counterpart elsewhere
    to speak for it. It stays nevertheless where the other state's cameras would see through more of it under the new
    label than under the old.
    away [K, 4, 4]: motions to the other state, slot 0 included; stack: its rendered depth; tau: tolerance along the ray
    (scene units).
    held [N] bool: known to be their part's; what holds more of these than others is no island.
    """
    rows = (torch.sigmoid(g.opacity_logits) > SOLID).nonzero().squeeze(1)
    if share <= 0 or len(rows) < 10:
        return labels
    points, old = g.means[rows], labels[rows]

    def seen_through(piece: Tensor, part: int) -> float:
        free, on, behind = stack.counts(se3.apply(away[part].to(points), points[piece]), tau)
        return float((free / (free + on + behind).clamp_min(1)).mean())

    def fits(piece: Tensor, part: int) -> bool:
        return seen_through(piece, part) <= seen_through(piece, int(old[piece[0]])) + 0.02

    island = find_islands(points, old, share)
    if held is not None:
        held = held[rows].float()
        for piece in island[island >= 0].unique():
            if float(held[island == piece].mean()) > 0.5:
                island[island == piece] = -1
    return _with_faint(g.means, labels, rows, _settle(points, old, island, fits=fits))


def _with_faint(means: Tensor, labels: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """Labels [N] where the solid Gaussians ``rows`` have ``new`` ones; the faint ones go with the surface that they are
    at."""
    old = labels[rows]
    nearest = knn(means[rows], means, 1, False)[1][:, 0]
    follows = (old[nearest] == labels) & (new[nearest] != old[nearest])
    out = torch.where(follows, new[nearest], labels)
    out[rows] = new
    return out


def _lands(
    points: Tensor, T: Tensor, other: Tensor, other_body: Tensor, rows: Tensor, part: int, spacing: Tensor
) -> bool:
    """Whether the part's motion T[part - 1] lays most of ``points[rows]`` on the body of the same part among the other
    state's points ``other`` (``other_body``: their labels, -1 for islands)."""
    distance, index = knn(other, se3.apply(T[part - 1].to(points), points[rows]), 1, False)
    return bool(((distance[:, 0] < NEAR * spacing) & (other_body[index[:, 0]] == part)).float().mean() > 0.5)


def _settle(
    points: Tensor,
    labels: Tensor,
    island: Tensor,
    lands: Callable[[Tensor, int, Tensor], bool] | None = None,
    fits: Callable[[Tensor, int], bool] | None = None,
) -> Tensor:
    """Labels with islands given away. lands: whether one (rows, part, spacing of the points) is none, by the other
    state; fits: whether one (rows) may go to a part."""
    labels = labels.clone()
    main = (island < 0).nonzero().squeeze(1)
    if len(main) < 10:
        return labels
    spacing = knn(points, None, 1, True)[0].median().clamp_min(1e-6)
    for piece in island[island >= 0].unique().tolist():
        rows = (island == piece).nonzero().squeeze(1)
        if lands is not None and lands(rows, int(labels[rows[0]]), spacing):
            continue
        distance, index = knn(points[main], points[rows], 8, False)
        touched = labels[main][index][distance < 2 * NEAR * spacing]
        if not len(touched):
            continue
        part = int(touched.mode().values)
        if fits is None or fits(rows, part):
            labels[rows] = part
    return labels
