"""How much rendered surfaces bend where a photograph shows nothing: a native kernel with its gradient, and the same in
torch."""

from __future__ import annotations

from typing import Optional, Sequence

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops.recorded import recorded

COVERED, SOLID = 0.9, 0.5  # a pixel is inside where the photograph's alpha and the rendered one are above these
BREAK = 30.0  # contrasts that a step over the outline counts: nothing is left of the weight


def hidden_bends(
    image: Tensor,
    target_alpha: Tensor,
    depth: Tensor,
    alpha: Tensor,
    strides: Sequence[int],
    contrast: float,
    noise: float,
) -> Optional[Tensor]:
    """Weighted mean of |second difference of 1 / d| d^2 over segments of 2 x stride pixels along rows and columns; mean
    over all of these.

    image [H, W, 3] in 0..1 and target_alpha [H, W]: the photograph.  depth, alpha [H, W]: accumulated; d is their
    quotient. A segment weighs exp(-t / contrast), t the photograph's total variation along it less ``noise`` a pixel;
    nothing where it leaves the inside. Weights count as one in all at least, and the factor d^2 has no gradient. A
    scalar in the unit of depth, differentiable by depth and alpha, or None where no stride fits into the image. float32
    on the CPU takes the native kernel (the same bits for any number of threads), anything else
    ``hidden_bends_reference`` (``recorded``).  Raises ValueError for shapes that do not fit.
    """
    size = alpha.shape
    if alpha.ndim != 2 or depth.shape != size or target_alpha.shape != size or image.shape != (*size, 3):
        raise ValueError(
            f"hidden_bends wants image [H, W, 3] and target_alpha, depth, alpha [H, W], got {tuple(image.shape)}, "
            f"{tuple(target_alpha.shape)}, {tuple(depth.shape)}, {tuple(size)}"
        )
    strides = [int(s) for s in strides]
    if not any(2 * s < max(size) for s in strides):
        return None
    inputs = (image, target_alpha, depth, alpha)
    fits = native is not None and min(strides) > 0 and contrast > 0
    if (
        not fits
        or image.requires_grad
        or target_alpha.requires_grad
        or any(t.dtype != torch.float32 or t.is_cuda for t in inputs)
    ):
        return recorded(hidden_bends_reference, *inputs, constants=(tuple(strides), contrast, noise))
    return _HiddenBends.apply(*inputs, strides, float(contrast), float(noise))


class _HiddenBends(torch.autograd.Function):
    """The gradient comes with the value and waits for the factor of the backward pass."""

    @staticmethod
    def forward(ctx, image, target_alpha, depth, alpha, strides, contrast, noise):
        inputs = [t.contiguous() for t in (image, target_alpha, depth, alpha)]
        ctx.grads = torch.empty(2, *alpha.shape) if any(ctx.needs_input_grad[2:4]) else None
        grads = [0, 0] if ctx.grads is None else [g.data_ptr() for g in ctx.grads]
        workspace = torch.empty(native.planar_workspace(*alpha.shape, strides))
        addresses = [*(t.data_ptr() for t in inputs), *grads, workspace.data_ptr()]
        return alpha.new_tensor(native.planar(addresses, *alpha.shape, strides, contrast, noise, num_threads()))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        return None, None, *(ctx.grads * grad_output).unbind(0), None, None, None


def hidden_bends_reference(
    image: Tensor,
    target_alpha: Tensor,
    depth: Tensor,
    alpha: Tensor,
    strides: Sequence[int],
    contrast: float,
    noise: float,
) -> Optional[Tensor]:
    """``hidden_bends``, its shapes too, written for reading: any floating dtype and device."""
    inside = (target_alpha > COVERED) & (alpha.detach() > SOLID)
    depth = torch.where(inside, depth / alpha.clamp_min(SOLID), torch.ones_like(depth)).clamp_min(1e-3)
    total, count = depth.new_zeros(()), 0
    for picture, d, mask in ((image, depth, inside), (image.transpose(0, 1), depth.T, inside.T)):
        step = ((picture[1:] - picture[:-1]).abs().mean(-1) - noise).clamp_min(0)
        # a step over the outline counts so much that nothing is left of the weight, and no more: sums keep their
        # precision
        step = torch.where(mask[1:] & mask[:-1], step, torch.full_like(step, BREAK * contrast))
        travelled = torch.cat([step.new_zeros(1, step.shape[1]), step.cumsum(0)])
        inverse = 1 / d
        for s in strides:
            if len(d) <= 2 * s:
                continue
            bend = inverse[: -2 * s] - 2 * inverse[s:-s] + inverse[2 * s :]
            w = torch.exp((travelled[: -2 * s] - travelled[2 * s :]) / contrast)
            total = total + (w * bend.abs() * d[s:-s].detach().square()).sum() / w.sum().clamp_min(1)
            count += 1
    return total / count
