"""The reference rasterizer: plain differentiable torch, any device, float32 or float64. Written for reading; the oracle
of tests.

Projection follows the EWA approximation (Zwicker et al. 2001, doi:10.1109/VISUAL.2001.964490) as 3DGS and gsplat use
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Optional

import torch
from torch import Tensor
from torch.nn.functional import normalize

from p2gs.ops.sh import evaluate
from p2gs.render.base import ALPHA_MAX, ALPHA_MIN, FAR, RASTERIZERS, T_STOP, RenderInputs
from p2gs.types import RenderOutput

TILE = 16  # pixels


@dataclass
class Splats:
    """Visible Gaussians in the image plane, near ones first. M of them; ``index`` [M] into the N given.

    means2d [M, 2] pixels; conics [M, 3]: entries xx, xy, yy of the inverse covariance; opacities [M];
    values [M, C]: what is accumulated per channel; z [M]; extents [M, 2]: half size of the box where alpha >= 1/255,
    pixels.
    """

    index: Tensor
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    values: Tensor
    z: Tensor
    extents: Tensor


def rotation_of(quats: Tensor) -> Tensor:
    """wxyz [N, 4], any length -> [N, 3, 3]."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def _usable(a: RenderInputs) -> Tensor:
    """[N] bool: every input of the Gaussian is finite and its quaternion is not zero."""
    sh = a.sh[:, : (a.sh_degree + 1) ** 2].flatten(1)
    given = [a.means, a.quats, a.scales, a.opacities[:, None], sh, *([] if a.features is None else [a.features])]
    ok = torch.stack([t.detach().isfinite().all(1) for t in given]).all(0)
    return ok & (a.quats.detach().square().sum(1) > 0)


def project(a: RenderInputs, dtype: torch.dtype) -> Splats:
    """Project, cull and sort by depth; ``values`` = colour 3, z, (z - depth_ref)^2, features."""
    device = a.means.device
    viewmat, K = a.viewmat.to(device, dtype), a.K.detach().to(device, dtype)
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]

    with torch.no_grad():
        depth = a.means.to(dtype) @ W[2] + t[2]
        index = torch.nonzero(_usable(a) & (depth >= a.near) & (depth < FAR) & (a.opacities >= ALPHA_MIN)).squeeze(1)
        index = index[torch.argsort(depth[index], stable=True)]
    means, quats, scales, opacities, sh = (x[index].to(dtype) for x in (a.means, a.quats, a.scales, a.opacities, a.sh))

    p = means @ W.T + t
    z = p[:, 2]
    x, y = p[:, 0] / z, p[:, 1] / z
    means2d = torch.stack([fx * x + cx, fy * y + cy], -1)

    # The Jacobian is taken at a point at most 15 % of the image outside of it, else splats off-screen blow up.
    marginx, marginy = 0.15 * a.width / fx, 0.15 * a.height / fy
    xc = torch.minimum(torch.maximum(x, -(cx / fx + marginx)), (a.width - cx) / fx + marginx)
    yc = torch.minimum(torch.maximum(y, -(cy / fy + marginy)), (a.height - cy) / fy + marginy)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * xc / z, zero, fy / z, -fy * yc / z], -1).reshape(-1, 2, 3)
    P = J @ W @ rotation_of(quats) * scales[:, None, :]
    cov = P @ P.transpose(1, 2) + a.eps2d * torch.eye(2, device=device, dtype=dtype)
    cxx, cxy, cyy = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    det = cxx * cyy - cxy * cxy
    conics = torch.stack([cyy / det, -cxy / det, cxx / det], -1)
    if a.antialias:
        # det without eps2d; xx yy - xy^2 would cancel for needles
        area = torch.linalg.cross(P[:, 0], P[:, 1]).square().sum(1)
        opacities = opacities * (area / det).clamp_min(1e-12).sqrt()

    colour = evaluate(sh, normalize(means + W.T @ t, dim=-1), a.sh_degree).clamp_min(0)
    values = [colour, z[:, None], (z[:, None] - a.depth_ref) ** 2]
    if a.features is not None:
        values.append(a.features[index].to(dtype))
    reach = (2 * torch.log(opacities / ALPHA_MIN)).clamp_min(0).detach().sqrt()
    extents = reach[:, None] * torch.stack([cxx, cyy], -1).detach().sqrt()
    # huge but finite inputs may overflow on the way
    fine = (
        torch.cat([means2d, cov.flatten(1), conics, colour], 1).isfinite().all(1) & (det > 0) & (opacities >= ALPHA_MIN)
    )
    return Splats(*(s[fine] for s in (index, means2d, conics, opacities, torch.cat(values, 1), z, extents)))


def _composite(s: Splats, hit: Tensor, px: Tensor, py: Tensor, abs_sum: Optional[Tensor]):
    """Blend the splats ``hit`` [k], near ones first, at the pixels px, py [p].

    Returns accumulated values [p, C], transmittance [p], median depth [p]. abs_sum [M, 2]: the backward pass adds
    |dL/dx|, |dL/dy|.
    """
    dx = px[None] - s.means2d[hit, 0, None]
    dy = py[None] - s.means2d[hit, 1, None]
    if abs_sum is not None and dx.requires_grad:

        def record(axis: int, gradient: Tensor) -> None:
            abs_sum[:, axis].index_add_(0, hit, gradient.abs().sum(1))

        dx.register_hook(partial(record, 0))
        dy.register_hook(partial(record, 1))
    a, b, c = (s.conics[hit, i, None] for i in range(3))
    alpha = s.opacities[hit, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = alpha.clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    alpha = torch.where(torch.cumprod(1 - alpha, 0) > T_STOP, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    median = ((before > 0.5) & (after <= 0.5)).to(s.z) * s.z[hit, None]
    return (before * alpha).T @ s.values[hit], after[-1], median.detach().sum(0)


@RASTERIZERS.register("torch_ref")
def rasterize_torch(a: RenderInputs) -> RenderOutput:
    """See ``p2gs.render.rasterize``. Computes in the dtype of ``means`` (float64 stays float64)."""
    dtype, device = a.means.dtype, a.means.device
    s = project(a, dtype)
    n, channels = a.means.shape[0], s.values.shape[1]

    abs_grad = abs_sum = None
    if a.absgrad:
        abs_grad, abs_sum = (
            torch.zeros(n, device=device, dtype=dtype),
            torch.zeros(len(s.index), 2, device=device, dtype=dtype),
        )
        if s.means2d.requires_grad:  # runs when the gradients of all tiles are in

            def finish(_: Tensor) -> None:
                abs_grad[s.index] = abs_sum.norm(dim=1)
                abs_sum.zero_()

            s.means2d.register_hook(finish)

    low, high = (s.means2d - s.extents).detach(), (s.means2d + s.extents).detach()
    rows = []
    for y0 in range(0, a.height, TILE):
        y1 = min(y0 + TILE, a.height)
        in_row = torch.nonzero((high[:, 1] >= y0) & (low[:, 1] <= y1)).squeeze(1)
        row = []
        for x0 in range(0, a.width, TILE):
            x1 = min(x0 + TILE, a.width)
            hit = in_row[(high[in_row, 0] >= x0) & (low[in_row, 0] <= x1)]
            shape = (y1 - y0, x1 - x0)
            if len(hit) == 0:
                values, T = s.values.new_zeros(*shape, channels), s.values.new_ones(*shape)
                row.append(torch.cat([values, T[..., None], torch.zeros_like(T)[..., None]], -1))
                continue
            py = (torch.arange(y0, y1, device=device, dtype=dtype) + 0.5)[:, None].expand(shape)
            px = (torch.arange(x0, x1, device=device, dtype=dtype) + 0.5)[None].expand(shape)
            values, T, median = _composite(s, hit, px.reshape(-1), py.reshape(-1), abs_sum)
            row.append(torch.cat([values, T[:, None], median[:, None]], 1).reshape(*shape, channels + 2))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows, 0) + 0 * s.values.sum()  # part of the graph even where nothing is visible

    T = image[..., -2]
    colour = image[..., :3]
    if a.background is not None:
        colour = colour + T[..., None] * a.background.to(dtype)
    radii = torch.zeros(n, device=device, dtype=torch.int32)
    inside = ((high > 0) & (low < low.new_tensor([a.width, a.height]))).all(1)
    radii[s.index] = torch.where(inside, s.extents.amax(1).ceil(), 0).to(torch.int32)
    return RenderOutput(
        colour=colour,
        alpha=1 - T,
        depth=image[..., 3],
        depth_sq=image[..., 4] if a.depth_sq else None,
        depth_ref=a.depth_ref,
        median_depth=image[..., -1].detach() if a.median_depth else None,
        features=image[..., 5:-2] if a.features is not None else None,
        radii=radii,
        means2d_abs_grad=abs_grad,
    )
