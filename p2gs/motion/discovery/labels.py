"""Which surfel belongs to which motion: landing costs of every point under every label, made to agree among
neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions, same_place
from p2gs.native import native, num_threads

# cost of staying, of what has another colour than was there before: less than hiding (0.35), as it may have been behind
REVEALED = 0.3
# cost of meeting a surfel that came from elsewhere; what lands for more than this met none
ELSEWHERE = 0.25


class Graph:
    """k nearest neighbours as a sparse matrix [N, N], rows summing to 1; weights fall across creases, steps in colour
    and distance."""

    def __init__(self, points: Tensor, normals: Tensor, colours: Tensor, k: int = 10):
        n, k = len(points), min(k, len(points) - 1)
        d, j = cKDTree(points.numpy()).query(points.numpy(), k=k + 1)
        d, j = torch.from_numpy(d[:, 1:].astype(np.float32)), torch.from_numpy(j[:, 1:])
        facing = (normals[j] * normals[:, None]).sum(2).clamp(-1, 1)
        colour = (colours[j] - colours[:, None]).abs().mean(2)
        w = (
            torch.exp(-((d / (1.5 * d[:, -1:].median())) ** 2))
            * torch.exp(-1.5 * (1 - facing))
            * torch.exp(-4 * colour)
            + 1e-4
        )
        # [N, k] each
        self.weights, self.neighbours = ((w / w.sum(1, keepdim=True)).contiguous(), j.to(torch.int32).contiguous())
        self.matrix = csr_matrix(
            (self.weights.numpy().reshape(-1), j.numpy().reshape(-1), np.arange(0, n * k + 1, k)), (n, n)
        )

    def average(self, values: Tensor) -> Tensor:
        """values [N, K] -> weighted mean over neighbours [N, K]."""
        if native is None or values.dtype != torch.float32:
            return torch.from_numpy(self.matrix @ values.numpy())
        values, out = values.contiguous(), torch.empty(values.shape)
        native.graph_average(*self.tables(), values.data_ptr(), values.shape[1], out.data_ptr(), num_threads())
        return out

    def tables(self) -> tuple[int, int, int, int]:
        """The graph as the kernels take it."""
        return self.neighbours.data_ptr(), self.weights.data_ptr(), *self.neighbours.shape


def softmax(x: Tensor) -> Tensor:
    """Over the columns of [N, K]; many times faster than torch's for a handful of columns."""
    return torch.softmax(x.T.contiguous(), 0).T.contiguous()


def arrivals(problem: Problem, motions: Motions, state: int) -> tuple[Tensor, Tensor]:
    """Landing cost [K, N] of every surfel of ``state`` under each motion, and the surfel [K, N] of the other state that
    it meets."""
    return problem.cost(motions, state, torch.arange(len(problem.surfels[state])))


def unary(
    problem: Problem, motions: Motions, state: int, revealed: bool = False, landed: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Cost [N, K + 1] of every surfel of ``state`` under static (column 0) and each motion.

    A surfel that a motion lays on a surface known to have moved is wanted there: that surface must come from somewhere.
    revealed: what has another colour than was there before may have stayed, behind it (for known motions; while they
    are searched it must be accounted for).
    landed: ``arrivals`` where they are known already.
    """
    n = len(problem.surfels[state])
    moved, static = problem.moved[state], problem.static[state]
    rest = torch.full((n,), 0.22)
    rest[static] = 0.02
    rest[moved] = 1.0
    if revealed:
        rest[problem.replaced[state]] = REVEALED
    columns = [rest]
    wanted = torch.zeros(n, dtype=torch.bool)
    for c, j in zip(*(landed or arrivals(problem, motions, state)), strict=True):
        columns.append(c + torch.where(moved, 0.0, 0.06))
        wanted |= (c < 0.2) & problem.moved[1 - state][j]
    columns[0] = torch.where(wanted & ~moved, torch.where(static, 0.2, 0.45), columns[0])
    return torch.stack(columns, 1)


def smooth_labels(
    cost: Tensor, graph: Graph, diffuse: int = 8, rounds: int = 15, pull: float = 2.5, sharp: float = 12.0
) -> Tensor:
    """Probabilities [N, K + 1]: costs diffused along the surface, then a mean-field Potts model.

    pull: weight of the neighbours' labels.  sharp: probabilities are softmax of -sharp * cost.
    """
    if native is None or cost.dtype != torch.float32 or not 0 < cost.shape[1] <= native.graph_columns:
        return smooth_labels_reference(cost, graph, diffuse, rounds, pull, sharp)
    cost, out = cost.contiguous(), torch.empty(cost.shape)
    native.graph_labels(
        *graph.tables(), cost.data_ptr(), cost.shape[1], diffuse, rounds, pull, sharp, out.data_ptr(), num_threads()
    )  # fmt: skip
    return out


def smooth_labels_reference(cost: Tensor, graph: Graph, diffuse: int, rounds: int, pull: float, sharp: float) -> Tensor:
    """``smooth_labels`` in torch."""
    smooth = cost
    for _ in range(diffuse):
        smooth = 0.5 * cost + 0.5 * graph.average(smooth)
    p = softmax(-sharp * smooth)
    for _ in range(rounds):
        p = softmax(-sharp * smooth + pull * graph.average(p))
    return p


@dataclass
class Labelling:
    """Per state: probabilities [N, K + 1] and unary costs [N, K + 1]."""

    probability: list[Tensor]
    cost: list[Tensor]

    def labels(self, state: int) -> Tensor:
        return self.probability[state].argmax(1)

    def margin(self, state: int) -> Tensor:
        """Best less second-best probability [N]."""
        p = self.probability[state]
        if p.shape[1] == 1:
            return torch.ones(len(p))
        top = p.topk(2, dim=1).values
        return top[:, 0] - top[:, 1]


def label(problem: Problem, motions: Motions, graphs: list[Graph], agree: int = 2, revealed: bool = False) -> Labelling:
    """Label both states; after a first pass, points pay for landing on a surface that came from elsewhere by the other
    state's labels (``unlike``)."""
    landed = [arrivals(problem, motions, s) for s in (0, 1)]
    costs = [unary(problem, motions, s, revealed, landed[s]) for s in (0, 1)]
    p = [smooth_labels(costs[s], graphs[s]) for s in (0, 1)]
    places = [motions.places(problem.surfels[s].points, s == 1) for s in (0, 1)]
    same = [[same_place(of, at, problem.scale.apart) for at in of[1:]] for of in places]
    for _ in range(agree):
        extra = [unlike(landed[s], same[s], p[1 - s]) for s in (0, 1)]
        p = [smooth_labels(costs[s] + extra[s], graphs[s]) for s in (0, 1)]
    return Labelling(p, costs)


def unlike(landed: tuple[Tensor, Tensor], same: list[Tensor], theirs: Tensor) -> Tensor:
    """Cost [N, K + 1] of a state's labels by probabilities ``theirs`` [M, K + 1] of the other's: under a motion by
    which a point meets a surfel there it pays as far as that surfel came from elsewhere.

    landed: ``arrivals``.  same: of each motion, [N, K + 1] bool, which labels bring a point where it does.
    """
    out = torch.zeros(landed[0].shape[1], theirs.shape[1])
    for k, (cost, met) in enumerate(zip(*landed, strict=True)):
        came = (theirs[met] * same[k]).sum(1)
        out[:, k + 1] = torch.where(cost < ELSEWHERE, ELSEWHERE * (1 - came), 0.0)
    return out
