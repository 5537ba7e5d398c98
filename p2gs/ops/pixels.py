"""Sums over the pixels of a training view with their gradients: one native pass each on the CPU, torch elsewhere."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops.recorded import recorded
from p2gs.ops.robust import geman_mcclure


def _fast(*tensors: Tensor) -> bool:
    return native is not None and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)


def _same_shape(name: str, *tensors: Tensor) -> None:
    if any(t.shape != tensors[0].shape for t in tensors):
        raise ValueError(f"{name} wants tensors of one shape, got {', '.join(str(tuple(t.shape)) for t in tensors)}")


def clamped_cross_entropy(pred: Tensor, target: Tensor, eps: float) -> Tensor:
    """Mean binary cross-entropy of pred, clamped to [eps, 1 - eps], against target in 0..1 of the same shape: a scalar.

    Differentiable by pred (zero where it is clamped). Raises ValueError for shapes that differ.
    """
    _same_shape("clamped_cross_entropy", pred, target)
    if not _fast(pred, target) or target.requires_grad or not 1e-6 <= eps < 0.5 or pred.numel() == 0:
        return F.binary_cross_entropy(pred.clamp(eps, 1 - eps), target)
    return _CrossEntropy.apply(pred, target, float(eps))


def depth_spread(
    alpha: Tensor, depth: Tensor, depth_sq: Tensor, target: Tensor, ref: float, knee: float | None = None
) -> Tensor:
    """Mean of v = alpha depth_sq - (depth - ref alpha)^2 over the pixels with target > 1/2, a scalar; 0 where there are
    none.

    alpha, depth, depth_sq: as accumulated by the rasterizer (``RenderOutput``), depth_sq about ``ref``; target: the
    photograph's alpha. All of one shape; differentiable by the first three. knee: in the unit of depth; where v is
    beyond its square it counts ever less (``robust.geman_mcclure``). Raises ValueError for shapes that differ.
    """
    _same_shape("depth_spread", alpha, depth, depth_sq, target)
    if _fast(alpha, depth, depth_sq, target):
        per_knee = 0.0 if knee is None else knee**-2
        return _DepthSpread.apply(alpha, depth, depth_sq, target.detach(), float(ref), per_knee)
    return recorded(_depth_spread, alpha, depth, depth_sq, target.detach(), float(ref), constants=(knee,))


def _depth_spread(
    alpha: Tensor, depth: Tensor, depth_sq: Tensor, target: Tensor, ref: float, knee: float | None
) -> Tensor:
    """``depth_spread`` written for reading: any floating dtype and device."""
    inside = (target > 0.5).to(alpha.dtype)
    first = depth - ref * alpha
    v = alpha * depth_sq - first * first
    return ((v if knee is None else geman_mcclure(v, knee**2)) * inside).sum() / inside.sum().clamp_min(1)


def greatest_around(maps: Tensor) -> Tensor:
    """The greatest of the 3 x 3 values about each of float maps [..., H, W], of the same shape."""
    return F.max_pool2d(maps.reshape(-1, 1, *maps.shape[-2:]), 3, 1, 1).reshape(maps.shape)


def depth_range(depth: Tensor) -> Tensor:
    """By how much the known depths (above 0) within the 3 x 3 pixels about each of a map [H, W] differ, [H, W]; 0 where
    none is known."""
    far, less_near = (greatest_around(torch.where(depth > 0, sign * depth, -torch.inf)) for sign in (1, -1))
    return (far + less_near).clamp_min(0)


# The gradients are made in the backward pass: their factor is known there, and no pass over the pixels is spent on it
# alone.


class _CrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pred, target, eps):
        pred, target = pred.contiguous(), target.contiguous()
        ctx.save_for_backward(pred, target)
        ctx.eps = eps
        return pred.new_tensor(
            native.cross_entropy(pred.data_ptr(), target.data_ptr(), 0, pred.numel(), eps, 1 - eps, 1.0, num_threads())
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        pred, target = ctx.saved_tensors
        out = torch.empty_like(pred)
        addresses = [t.data_ptr() for t in (pred, target, out)]
        native.cross_entropy(*addresses, pred.numel(), ctx.eps, 1 - ctx.eps, grad_output.item(), num_threads())
        return out, None, None


class _DepthSpread(torch.autograd.Function):
    @staticmethod
    def forward(ctx, alpha, depth, depth_sq, target, ref, per_knee):
        inputs = [t.contiguous() for t in (alpha, depth, depth_sq, target)]
        ctx.save_for_backward(*inputs)
        ctx.options = ref, per_knee
        addresses = [*(t.data_ptr() for t in inputs), 0, 0, 0]
        return alpha.new_tensor(native.depth_spread(addresses, alpha.numel(), *ctx.options, 1.0, num_threads()))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        inputs = ctx.saved_tensors
        out = [torch.empty_like(inputs[0]) for _ in range(3)]
        addresses = [t.data_ptr() for t in (*inputs, *out)]
        native.depth_spread(addresses, out[0].numel(), *ctx.options, grad_output.item(), num_threads())
        return *out, None, None, None


def compose(colour: Tensor, alpha8: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Premultiplied uint8 colour [H, W, 3] and alpha [H, W] over a background [3] in 0..1: float32 image [H, W, 3] and
    alpha [H, W]."""
    if (
        native is not None
        and colour.device.type == "cpu"
        and colour.is_contiguous()
        and alpha8.is_contiguous()
        and alpha8.numel()
    ):
        image, alpha = torch.empty(colour.shape), torch.empty(alpha8.shape)
        addresses = [t.data_ptr() for t in (colour, alpha8, image, alpha)]
        native.compose(*addresses, background.tolist(), alpha.numel(), num_threads())
        return image, alpha
    alpha = alpha8.float().mul_(1 / 255)
    image = colour.float().mul_(1 / 255)
    return image.addcmul_((1 - alpha).unsqueeze(-1), background), alpha
