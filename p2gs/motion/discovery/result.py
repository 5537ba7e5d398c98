"""What discovery hands over."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from p2gs.types import JointType
from p2gs.visibility.surfels import Surfels


@dataclass(frozen=True)
class FoundMotion:
    """One moving part. transform [4, 4] float64 start -> end; axis [3] unit and origin [3] (on the axis; of a slide: a
    point of the part); amount: degrees (revolute) or length along the axis, signed; confidence 0..1; mass: share of the
    moved surface it explains."""

    type: JointType
    transform: Tensor
    axis: Tensor
    origin: Tensor
    amount: float
    confidence: float
    mass: float


@dataclass(frozen=True)
class Near:
    """Of N points: the surfels [N, k] nearest to each, their weights [N, k] (sum 1), the distance [N] to the
    nearest."""

    index: Tensor
    weight: Tensor
    distance: Tensor

    @classmethod
    def surfels(cls, surfels: Surfels, points: Tensor, colours: Tensor | None, count: int = 5) -> Near:
        """The ``count`` surfels nearest to points [N, 3], near ones and (colours [N, 3] or None) like ones weighing
        more."""
        d, j = surfels.nearest(points, count)
        d = d.float()
        w = 1 / (d**2 + (0.1 * surfels.spacing) ** 2 + 1e-12)
        if colours is not None:
            w = w * torch.exp(-3 * (surfels.colours[j] - colours.detach().cpu().float()[:, None]).abs().mean(2))
        return cls(j, w / w.sum(1, keepdim=True), d[:, 0])


@dataclass
class Candidate:
    """A complete explanation. score: lower is better (``explanations.total_score``).

    probability: per state [M, K + 1] over the state's surfels (column 0 static).
    """

    motions: list[FoundMotion]
    surfels: list[Surfels]
    probability: list[Tensor]
    score: float
    labels_start: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    labels_end: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))

    def label_points(
        self, points: Tensor, colours: Tensor | None, state: int, neighbours: int = 5
    ) -> tuple[Tensor, Tensor]:
        """Labels [N] int64 and margin [N] in 0..1 of any points [N, 3] of ``state`` (0 start, 1 end): the nearest
        surfels decide.

        colours [N, 3] (or None) favour surfels that look alike. The margin falls with the distance to the nearest
        surfel.
        """
        return self.label_by(Near.surfels(self.surfels[state], points, colours, neighbours), state)

    def label_by(self, near: Near, state: int) -> tuple[Tensor, Tensor]:
        """``label_points`` of points whose nearest surfels are known."""
        p = torch.einsum("nk,nkc->nc", near.weight, self.probability[state][near.index])
        label = p.argmax(1)
        if p.shape[1] == 1:
            return label, torch.ones(len(label))
        top = p.topk(2, dim=1).values
        close = torch.exp(-((near.distance / (3 * self.surfels[state].spacing)) ** 2))
        return label, (top[:, 0] - top[:, 1]) * close


@dataclass
class Discovery(Candidate):
    """The best explanation, the runners-up and what led there.

    margin_start, margin_end [N]: confidence of the labels of the input points.  evidence_start, evidence_end [N] int: 1
    moved, 0 static, -1 unknown.  candidates: complete explanations, best first, this one included.  diagnostics: each
    stage's own measure.  problem, graphs, search: what was searched and how, for ``relabel`` and ``instead_of``.
    """

    margin_start: Tensor = field(default_factory=lambda: torch.zeros(0))
    margin_end: Tensor = field(default_factory=lambda: torch.zeros(0))
    evidence_start: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    evidence_end: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    candidates: list[Candidate] = field(default_factory=list)
    diagnostics: dict = field(default_factory=dict)
    problem: Any = None
    graphs: list = field(default_factory=list)
    search: Any = None
