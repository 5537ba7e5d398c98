"""Image-space check of a complete explanation: every point carried to the other state must agree with that state's depth maps."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.models.discovery.labels import Labelling
from p2gs.models.discovery.problem import Problem
from p2gs.models.discovery.rigid import Motions

HIDDEN = 0.5
STAYED = 0.25
UNEXPLAINED = 1.0


def violation(problem: Problem, motions: Motions, labels: Tensor, state: int, views: int = 32) -> Tensor:
    """Cost [N] in 0..1 of the labelled surfels of ``state``: share of the other state's views that see through where a point is
    predicted, of those not blocked by something in front; 0.5 where all are blocked; 0.25 more for a point that is said to move off a
    surface seen in both states; 1 for a moved point that is called static."""
    surf, stack = problem.surfels[state], problem.stacks[1 - state]
    x = surf.points.clone()
    for k in range(len(motions)):
        mine = labels == k + 1
        x[mine] = motions[k : k + 1].apply(surf.points[mine], inverse=state == 1)[0]
    free, on, _ = stack.counts(x, problem.scale.tp, stack.spread(views))
    seen = free + on
    cost = torch.where(seen > 0, free / seen.clamp_min(1), torch.full_like(free, HIDDEN))
    cost = torch.where((labels > 0) & problem.static[state], (cost + STAYED).clamp_max(1), cost)
    return torch.where((labels == 0) & problem.moved[state], torch.full_like(cost, UNEXPLAINED), cost)


def image_score(problem: Problem, motions: Motions, labelling: Labelling) -> float:
    """Mean violation over the points that moved or are said to move, both states alike: 0 is a perfect explanation."""
    total = []
    for s in (0, 1):
        labels = labelling.labels(s)
        about = problem.moved[s] | (labels > 0)
        if about.any():
            w = torch.where(problem.moved[s], problem.trust[s], torch.full_like(problem.trust[s], 0.3))[about]
            total.append(float((violation(problem, motions, labels, s)[about] * w).sum() / w.sum()))
    return sum(total) / len(total) if total else 0.0
