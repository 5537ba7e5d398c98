"""Which Gaussians of both states move with a part, by one least cut.

The nodes are the solid Gaussians of both states that the part has or might take. Edges join neighbours of a state, and,
across the states, a Gaussian to what is where the part's motion takes it and to what is where it was: what moves
arrives as moving surface, what stays is still there. An edge costs less to cut the less alike its ends are in colour.
The part keeps what it has, and cannot have what its motion takes into space that is seen free or onto another surface;
of all labels between those two the cut finds the shortest border (Boykov, Veksler and Zabih 2001, DOI
10.1109/34.969114: an expansion move; Greig et al. 1989, DOI 10.1111/j.2517-6161.1989.tb01764.x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.refine_motions import Judge
from p2gs.ops import se3
from p2gs.ops.graph_cut import cut_of_edges
from p2gs.ops.knn import knn
from p2gs.ops.sh import dc_to_rgb

NEIGHBOURS = 8  # of a Gaussian in its own state: a surface's, as a pixel's
EDGE = 256  # capacity of an edge between Gaussians of one colour


@dataclass
class Nodes:
    """Of one state the Gaussians [N] that are asked: their rows, places [N, 3], colours [N, 3] in the end's light;
    which the part has, and which it cannot have, [N] bool."""

    rows: Tensor
    points: Tensor
    colours: Tensor
    has: Tensor
    cannot: Tensor


def with_all_static(motions: PartMotions, k: int) -> PartMotions:
    """The motions with all static surface part ``k``'s."""
    return replace(motions, labels=[torch.where(own == 0, k + 1, own) for own in motions.labels])


def spread(judge: Judge, motions: PartMotions, k: int) -> PartMotions:
    """The motions with part ``k`` (0 is the first that moves) spread over the static surface, as far as the least cut
    has it; faint Gaussians go with the nearest solid one."""
    seen, nodes = judge.seen(with_all_static(motions, k)), []
    for state, own, of in zip(judge.states, motions.labels, seen, strict=True):
        g = state.gaussians
        rows = (g.solid & ((own == 0) | (own == k + 1))).nonzero().squeeze(1)
        colours = dc_to_rgb((of.lit if state.state == 0 else g).sh[:, 0]).clamp(0, 1)
        has = own[rows] == k + 1
        nodes.append(Nodes(rows, g.means[rows], colours[rows], has, ~has & ~of.kept[rows]))
    if any(len(of.rows) <= NEIGHBOURS for of in nodes):
        return motions
    mine = least_border(nodes, motions.transforms[k], judge.config.other_colour, judge.config.free_static)
    labels = []
    for state, own, of, part in zip(judge.states, motions.labels, nodes, mine, strict=True):
        out = own.clone()
        asked = ((own == 0) | (own == k + 1)).nonzero().squeeze(1)
        nearest = knn(of.points, state.gaussians.means[asked], 1)[1].squeeze(1)
        out[asked] = torch.where(part[nearest], k + 1, 0)
        labels.append(out)
    return replace(motions, labels=labels)


def least_border(nodes: list[Nodes], T: Tensor, unlike: float, reach: float) -> list[Tensor]:
    """Of each state's nodes which the part has after the least cut, [N] bool; of several the one that has least.

    T [4, 4]: the part's motion, start -> end.  unlike: difference in colour, mean of channels, at which an edge costs
    nothing.  reach: distance within which something is where a motion leads, internal units.
    """
    first, count = len(nodes[0].rows), sum(len(of.rows) for of in nodes)
    edges = []  # of a state's nodes with those of a state, by their numbers there
    for s, of in enumerate(nodes):
        edges.append((s, s, *_edges(of, None, of, NEIGHBOURS, unlike, float("inf"))))
        for there in (of.points, se3.apply(se3.inverse(T) if s else T, of.points.double()).float()):
            edges.append((s, 1 - s, *_edges(of, there, nodes[1 - s], 1, unlike, reach)))
    tail = np.concatenate([own + first * s for s, _, own, _, _ in edges])
    head = np.concatenate([other + first * s for _, s, _, other, _ in edges])
    worth = np.concatenate([of for *_, of in edges])
    has, cannot = (torch.cat([getattr(of, name) for of in nodes]).numpy() for name in ("has", "cannot"))
    sure = np.bincount(np.r_[tail, head], np.r_[worth, worth], count).astype(np.int64) + 1  # more than all its edges
    pull = np.where(has, sure, np.where(cannot, -sure, 0))
    both = (np.r_[tail, head], np.r_[head, tail], np.r_[worth, worth])
    side = torch.as_tensor(cut_of_edges(*both, pull)[1] == 1)
    return [side[:first], side[first:]]


def _edges(
    of: Nodes, there: Tensor | None, other: Nodes, k: int, unlike: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From nodes, carried to ``there`` [N, 3] (None: they are the others themselves), to the k nearest of others no
    farther than ``reach``: both ends [N k] and capacities."""
    distance, index = knn(other.points, there, k, there is None)
    alike = 1 - (of.colours[:, None] - other.colours[index]).abs().mean(2) / unlike
    worth = torch.where(distance <= reach, alike.clamp_min(0) * EDGE, 0.0).round().long()
    tail = torch.arange(len(of.rows))[:, None].expand_as(index)
    kept = worth > 0
    return tail[kept].numpy(), index[kept].numpy(), worth[kept].numpy()
