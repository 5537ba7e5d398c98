"""How much of the moving parts is inside the base. The paper reports a "Penetration" without defining it; this is ours.

The base occupies a point x where its Gaussians together are more opaque than not: 1 - prod_i (1 - a_i(x)) > 1/2, with
a_i(x) = opacity_i exp(-mahalanobis^2 / 2), cut off at three standard deviations. Penetration is the fraction of the
moving parts' solid Gaussians (opacity > 1/2) whose centres are in occupied space, averaged over poses. It is zero for
parts that only touch; a hinge's seam, where part and base are one surface, contributes a small constant, so compare
runs of one object.
"""

from __future__ import annotations

from typing import Sequence

import torch
from torch import Tensor

from p2gs.ops import se3, so3
from p2gs.ops.knn import search_tree
from p2gs.types import ArticulatedObject, GaussianTensors

CUTOFF = 3.0


@torch.no_grad()
def occupancy(static: GaussianTensors, points: Tensor) -> Tensor:
    """1 - prod_i (1 - a_i(x)) at points [N, 3] -> [N] float64 in [0, 1]."""
    x = points.detach().cpu().double()
    transparency = torch.zeros(len(x), dtype=torch.float64)
    if len(x) == 0 or len(static) == 0:
        return transparency
    means, scales = static.means.detach().cpu().double(), static.log_scales.detach().cpu().double().exp()
    near = search_tree(x.numpy()).query_ball_point(means.numpy(), (CUTOFF * scales.amax(1)).numpy())
    i = torch.repeat_interleave(torch.tensor([len(n) for n in near]))
    if len(i) == 0:
        return transparency
    n = torch.cat([torch.tensor(list(j), dtype=torch.int64) for j in near])
    R = so3.quat_to_matrix(static.quats.detach().cpu().double())
    local = ((x[n] - means[i])[:, None] @ R[i])[:, 0] / scales[i]
    sq = local.square().sum(-1)
    alpha = torch.sigmoid(static.opacity_logits.detach().cpu().double())[i] * torch.exp(-0.5 * sq) * (sq < CUTOFF**2)
    return 1 - transparency.index_add(0, n, torch.log1p(-alpha.clamp_max(1 - 1e-12))).exp()


def penetration(static: GaussianTensors, movable_means: Tensor) -> float:
    """Fraction of ``movable_means`` [N, 3] in space that the base occupies; 0 where there are none.

    >>> turn, solid = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1,), 9.0)
    >>> ball = GaussianTensors(torch.zeros(1, 3), turn, torch.zeros(1, 3), solid, torch.zeros(1, 1, 3))
    >>> penetration(ball, torch.tensor([[0.5, 0, 0], [2.0, 0, 0]]))
    0.5
    """
    return float((occupancy(static, movable_means) > 0.5).double().mean()) if len(movable_means) else 0.0


@torch.no_grad()
def evaluate_penetration(
    twin: ArticulatedObject, times: Sequence[float] = (0.0, 0.25, 0.5, 0.75, 1.0)
) -> dict[str, float]:
    """{"mean": over the poses, "max": of the worst pose}; all moving parts are at the same time."""
    solid = twin.gaussians.opacity_logits > 0
    static = twin.gaussians[twin.part_ids == 0]
    values = []
    for t in times:
        posed = []
        for part in twin.parts:
            if part.joint is not None:
                T = se3.screw_at(part.joint.transform.double(), t - twin.canonical_time)
                posed.append(se3.apply(T, twin.gaussians.means[solid & (twin.part_ids == part.id)].double()))
        values.append(penetration(static, torch.cat(posed) if posed else twin.gaussians.means[:0]))
    return {"mean": sum(values) / len(values), "max": max(values)}
