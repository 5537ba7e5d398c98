"""The native CPU rasterizer (p2gs/native/raster*) behind torch.autograd. Computes in float32 on
``torch.get_num_threads()`` threads."""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

from p2gs.native import native, num_threads, why_missing
from p2gs.render.base import RASTERIZERS, RenderInputs
from p2gs.types import RenderOutput, UserError

if native is None:
    raise UserError(f"the rasterizer 'cpu' cannot run: {why_missing}")


def _plain(t: Optional[Tensor]) -> Optional[Tensor]:
    """The tensor as the kernels read it: float32, contiguous, on the CPU. The same object where it is that already."""
    return None if t is None else t.to(dtype=torch.float32, device="cpu").contiguous()


def _address(t: Optional[Tensor]) -> int:
    return 0 if t is None else t.data_ptr()


def _forward(a: RenderInputs, keep: bool, means, quats, scales, opacities, sh, features, background, sh_rest):
    """Renders; returns the native view (needed for backward) and (colour, alpha, depth, depth_sq, features, median,
    radii)."""
    h, w, n = a.height, a.width, means.shape[0]
    colour, alpha, depth = torch.empty(h, w, 3), torch.empty(h, w), torch.empty(h, w)
    depth_sq = torch.empty(h, w) if a.depth_sq else None
    median = torch.empty(h, w) if a.median_depth else None
    channels = 0 if features is None else features.shape[1]
    features_out = torch.empty(h, w, channels) if channels else None
    radii = torch.empty(n, dtype=torch.int32)
    (fx, _, cx), (_, fy, cy), _ = a.K.tolist()
    view = native.RasterView()
    inputs = (means, quats, scales, opacities, sh, features, background)
    outputs = (colour, alpha, depth, depth_sq, median, features_out, radii)
    bases = sh.shape[1] + (0 if sh_rest is None else sh_rest.shape[1])
    image = background is not None and background.dim() == 3
    view.forward(
        [_address(t) for t in (*inputs, *outputs, sh_rest)],
        n,
        bases,
        a.sh_degree,
        channels,
        a.viewmat.reshape(-1).tolist(),
        [fx, fy, cx, cy],
        w,
        h,
        a.near,
        a.eps2d,
        a.depth_ref,
        a.antialias,
        image,
        a.stored,
        keep,
        num_threads(),
    )
    return view, (colour, alpha, depth, depth_sq, features_out, median, radii)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, a: RenderInputs, abs_grad, viewmat, means, quats, scales, opacities, sh, features, background, sh_rest
    ):
        ctx.set_materialize_grads(False)
        view, out = _forward(a, True, means, quats, scales, opacities, sh, features, background, sh_rest)
        ctx.view, ctx.abs_grad, ctx.of_camera = view, abs_grad, viewmat.dtype
        # the kernels read these again: saving them lets autograd notice when somebody has written into one
        ctx.save_for_backward(means, quats, scales, opacities, sh, features, background, sh_rest, *out[:5])
        ctx.mark_non_differentiable(*(t for t in out[5:] if t is not None))
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, colour, alpha, depth, depth_sq, features_out, *_):
        means, quats, scales, opacities, sh, features, background, sh_rest, _, out_alpha, *_ = ctx.saved_tensors
        incoming = [_plain(g) for g in (colour, alpha, depth, depth_sq, features_out)]
        gradients = [torch.empty_like(t) for t in (means, quats, scales, opacities, sh)]
        # without a gradient by the rendered features, theirs is zero and the kernels take the path without them
        v_features = None
        if features is not None and ctx.needs_input_grad[8]:
            v_features = torch.empty_like(features) if features_out is not None else torch.zeros_like(features)
        native_features = v_features if features_out is not None else None
        if features_out is not None and v_features is None:
            native_features = torch.empty_like(features)  # pyright: ignore[reportArgumentType]
        v_rest = None if sh_rest is None else torch.empty_like(sh_rest)
        v_view = torch.zeros(4, 4) if ctx.needs_input_grad[2] else None  # its last row is (0, 0, 0, 1) and stays
        ctx.view.backward(
            [_address(t) for t in (*incoming, *gradients, native_features, ctx.abs_grad, v_rest, v_view)], num_threads()
        )
        v_background = None
        if background is not None and ctx.needs_input_grad[9] and colour is not None:
            v_background = (1 - out_alpha)[..., None] * incoming[0]
            if background.dim() == 1:  # in double: the same float for any number of threads
                v_background = v_background.double().sum((0, 1)).float()
        v_view = None if v_view is None else v_view.to(ctx.of_camera)
        return None, None, v_view, *gradients, v_features, v_background, v_rest


@RASTERIZERS.register("cpu")
def rasterize_cpu(a: RenderInputs) -> RenderOutput:
    """See ``p2gs.render.rasterize``. Inputs that are not contiguous float32 are converted; outputs are float32."""
    if a.means.device.type != "cpu":
        raise UserError(f"the rasterizer 'cpu' renders tensors on the CPU, these are on {a.means.device}")
    tensors = [_plain(t) for t in (a.means, a.quats, a.scales, a.opacities, a.sh, a.features, a.background, a.sh_rest)]
    abs_grad = torch.zeros(a.means.shape[0]) if a.absgrad else None
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (a.viewmat, *tensors)):
        out = _Rasterize.apply(a, abs_grad, a.viewmat, *tensors)
    else:
        out = _forward(a, False, *tensors)[1]
    colour, alpha, depth, depth_sq, features, median, radii = out
    return RenderOutput(colour, alpha, depth, depth_sq, a.depth_ref, median, features, radii, abs_grad)
