"""The CUDA rasterizer of gsplat (Ye et al. 2024, arXiv:2409.06765; written against 1.5.3). The only file that imports
gsplat.

gsplat blends any number of channels per Gaussian, so everything goes through one call: colour (from its spherical
harmonics, which are ours, ``ops.sh``, and want no unit directions), z, (z - depth_ref)^2 and the features. The
background is blended here, as it may be an image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.render.base import ALPHA_MIN, FAR, RASTERIZERS, RenderInputs
from p2gs.render.torch_ref import rasterize_torch
from p2gs.types import RenderOutput, UserError

try:
    from gsplat import rasterization, spherical_harmonics
except Exception as err:  # besides ImportError: gsplat compiles its kernels on import and may fail in many ways
    raise UserError(
        f"the rasterizer 'gsplat' cannot run (pip install 'p2gs[cuda]' on a machine with CUDA): {err}"
    ) from err


def _sane(a: RenderInputs) -> tuple[Tensor, list[Tensor]]:
    """[N] bool: every input of the Gaussian is finite; and the inputs with an invisible Gaussian in place of each that
    is not.

    Done before anything else, since a NaN that is masked out later still reaches the gradients as 0 * NaN.
    """
    given = [
        a.means,
        a.quats,
        a.scales,
        a.opacities,
        a.sh[:, : (a.sh_degree + 1) ** 2],
        *([] if a.features is None else [a.features]),
    ]
    # nothing times a number is nothing, times NaN or infinity NaN: three kernels instead of thirty
    ok = torch.cat([t.detach().flatten(1) if t.dim() > 1 else t.detach()[:, None] for t in given], 1).mul(0).sum(1) == 0
    ok &= (a.quats.detach().square().sum(1) > 0) & (a.opacities.detach() >= ALPHA_MIN)
    fill = (0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    return ok, [
        torch.where(ok.view(-1, *[1] * (t.dim() - 1)), t.float(), value) for t, value in zip(given, fill, strict=False)
    ]


@RASTERIZERS.register("gsplat")
def rasterize_gsplat(a: RenderInputs) -> RenderOutput:
    """See ``p2gs.render.rasterize``. Two differences: no median depth (it is None), and sums are not
    bit-reproducible."""
    if not a.means.is_cuda:
        raise UserError(f"the rasterizer 'gsplat' renders tensors on a CUDA device, these are on {a.means.device}")
    return through_gsplat(a)


def through_gsplat(a: RenderInputs) -> RenderOutput:
    """The mapping onto gsplat's arguments and back, whatever the device."""
    device, dtype = a.means.device, torch.float32
    if not len(a.means):  # gsplat 1.5.3 divides by their number
        return rasterize_torch(a)
    viewmat, K = a.viewmat.to(device, dtype), a.K.detach().to(device, dtype)
    R, t = viewmat[:3, :3], viewmat[:3, 3]

    ok, (means, quats, scales, opacities, sh, *features) = _sane(a)
    harmonics = spherical_harmonics(a.sh_degree, means + R.T @ t, sh)  # pyright: ignore[reportCallIssue]
    colour = (0.5 + harmonics).clamp_min(0)
    z = (means @ R[2] + t[2])[:, None]
    values = torch.cat([colour, z, *([(z - a.depth_ref) ** 2] if a.depth_sq else []), *features], 1)

    image, alpha, meta = rasterization(  # pyright: ignore[reportCallIssue]
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=values,
        viewmats=viewmat[None],
        Ks=K[None],
        width=a.width,
        height=a.height,
        near_plane=a.near,
        far_plane=FAR,
        eps2d=a.eps2d,
        packed=False,
        absgrad=a.absgrad,
        rasterize_mode="antialiased" if a.antialias else "classic",
    )
    image, alpha = image[0], alpha[0, ..., 0]

    abs_grad = None
    if a.absgrad:
        abs_grad = torch.zeros(means.shape[0], device=device)
        means2d = meta["means2d"]
        if means2d.requires_grad:  # gsplat sets `absgrad` on it just before autograd hands on its gradient

            def finish(_: Tensor) -> None:
                abs_grad.copy_(means2d.absgrad[0].norm(dim=-1))

            means2d.register_hook(finish)

    radii = meta["radii"][0]
    radii = radii.amax(-1) if radii.dim() == 2 else radii  # one radius an axis since 1.5
    rgb = image[..., :3]
    if a.background is not None:
        rgb = rgb + (1 - alpha)[..., None] * a.background.to(dtype)
    return RenderOutput(
        colour=rgb,
        alpha=alpha,
        depth=image[..., 3],
        depth_sq=image[..., 4] if a.depth_sq else None,
        depth_ref=a.depth_ref,
        features=image[..., 4 + a.depth_sq :] if a.features is not None else None,
        radii=torch.where(ok, radii, torch.zeros_like(radii)).to(torch.int32),
        means2d_abs_grad=abs_grad,
    )
