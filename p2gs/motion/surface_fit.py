"""One small rigid motion that brings two states' surfaces to agree wherever nothing moved.

What moved between the states does not agree under the base's motion, so the fit must not listen to it: iterated closest
points, point to plane (Chen and Medioni 1992, doi:10.1016/0262-8856(92)90066-C), from the identity, with Geman and
McClure's weights, whose scale falls from the reach of the search to the noise of the surfaces (Zhou et al. 2016,
doi:10.1007/978-3-319-46475-6_47). Surfels are spread evenly over the surfaces, so what it ends at is the motion with
the widest support near the identity, not the one with the most texture.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.ops import se3
from p2gs.ops.knn import search_tree
from p2gs.visibility.surfels import Surfels

SAME_SIDE = 0.7  # cosine between normals of one surface, 45 degrees
ALONG = 3.0  # spacings of the surfels: a point farther along the surface from its nearest surfel has none there
WITHIN = 3.0  # standard deviations of the surfels' noise: an agreeing point's distance from the other surface


@dataclass(frozen=True)
class SurfaceFit:
    """transform [4, 4] float64.  share: of the moved surfels that agree with the other surface.  spread: least standard
    deviation of those points over all directions.  rms: of their distances from it.  Lengths are the surfels'."""

    transform: Tensor
    share: float
    spread: float
    rms: float


def fit_surfaces(source: Surfels, target: Surfels, reach: float, rounds: int = 40, most: int = 8000) -> SurfaceFit:
    """The motion that carries ``source`` onto ``target`` where both show the same surface.

    reach: scale of the weights in the first round, the distance up to which surfaces are looked for (scene units).
    most: so many of the source's surfels, evenly picked, are looked at.
    """
    pick = torch.linspace(0, len(source) - 1, min(len(source), most)).round().long()
    points, normals = source.points[pick].double(), source.normals[pick].double()
    onto, facing = target.points.double(), target.normals.double()
    tree = search_tree(onto.numpy())
    noise = (source.noise**2 + target.noise**2) ** 0.5
    spacing = max(source.spacing, target.spacing)
    T = torch.eye(4, dtype=torch.float64)
    for i in range(rounds):
        # a third of the rounds at the noise
        scale = max(reach * (noise / reach) ** min(1.5 * i / max(rounds - 1, 1), 1.0), noise)
        p, j, r, ok = _pairs(T, points, normals, tree, onto, facing, max(ALONG * spacing, scale))
        if int(ok.sum()) < 6:
            break
        p, n, r = p[ok], facing[j][ok], r[ok]
        w = (1 + (r / scale) ** 2) ** -2
        J = torch.cat([torch.linalg.cross(p, n), n], 1)
        H = J.T @ (w[:, None] * J)
        step = -torch.linalg.solve(H + 1e-9 * H.diagonal().mean() * torch.eye(6, dtype=H.dtype), J.T @ (w * r))
        T = se3.exp(step) @ T
    p, _, r, ok = _pairs(T, points, normals, tree, onto, facing, ALONG * spacing)
    agree = ok & (r.abs() < WITHIN * noise)
    if int(agree.sum()) < 6:
        return SurfaceFit(T, 0.0, 0.0, float("inf"))
    spread = float(torch.linalg.eigvalsh(torch.cov(p[agree].T))[0].clamp_min(0).sqrt())
    return SurfaceFit(T, float(agree.double().mean()), spread, float(r[agree].square().mean().sqrt()))


def _pairs(T: Tensor, points: Tensor, normals: Tensor, tree, onto: Tensor, facing: Tensor, along: float):
    """Moved points [N, 3], the surfel nearest to each [N], the distance from its plane [N], and whether both are of one
    surface [N]."""
    p, n = se3.apply(T, points), normals @ T[:3, :3].T
    j = torch.from_numpy(tree.query(p.numpy())[1])
    d = p - onto[j]
    r = (d * facing[j]).sum(1)
    ok = ((n * facing[j]).sum(1) > SAME_SIDE) & ((d - r[:, None] * facing[j]).norm(dim=1) < along)
    return p, j, r, ok
