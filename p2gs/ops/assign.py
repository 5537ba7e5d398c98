"""Soft part assignment, softmax of a linear classifier over embeddings (paper section 4.2): a native kernel, and the
same in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.native import native, num_threads


def soft_assignment(psi: Tensor, weight: Tensor, bias: Tensor, temperature: float = 1.0) -> Tensor:
    """softmax((psi weight^T + bias) / temperature) over the parts: psi [N, D], weight [K, D], bias [K] -> [N, K].

    The result lies part by part in memory: K is small, and whoever reads it goes along the Gaussians. Differentiable by
    all three. float32 on the CPU with K <= 32 and D <= 64 takes the native kernel (the same bits for any number of
    threads), anything else ``soft_assignment_reference``. Raises ValueError for shapes that do not fit.
    """
    parts, dim = weight.shape
    if psi.ndim != 2 or psi.shape[1] != dim or bias.shape != (parts,):
        raise ValueError(
            f"soft_assignment wants psi [N, D], weight [K, D], bias [K], got {tuple(psi.shape)}, "
            f"{tuple(weight.shape)}, {tuple(bias.shape)}"
        )
    inputs = (psi, weight, bias)
    fits = native is not None and 1 <= parts <= native.assign_parts and 1 <= dim <= native.assign_dim
    if not fits or any(t.dtype != torch.float32 or t.device.type != "cpu" for t in inputs):
        return soft_assignment_reference(*inputs, temperature)
    return _SoftAssignment.apply(*inputs, float(temperature))


def soft_assignment_reference(psi: Tensor, weight: Tensor, bias: Tensor, temperature: float = 1.0) -> Tensor:
    """``soft_assignment``, its shapes too, written for reading: any floating dtype and device."""
    # parts first: a softmax over a short last dimension is several times slower
    return torch.softmax((weight @ psi.T + bias[:, None]) / temperature, dim=0).T


class _SoftAssignment(torch.autograd.Function):
    @staticmethod
    def forward(ctx, psi, weight, bias, temperature):
        psi, weight, bias = psi.contiguous(), weight.contiguous(), bias.contiguous()
        n, (parts, dim) = len(psi), weight.shape
        probs = torch.empty(parts, n)
        ctx.sizes = n, dim, parts, 1 / temperature
        native.assign_forward([t.data_ptr() for t in (psi, weight, bias, probs)], *ctx.sizes, num_threads())
        ctx.save_for_backward(psi, weight, probs)
        return probs.T

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        psi, weight, probs = ctx.saved_tensors
        grad = grad.T.contiguous()
        out = torch.empty_like(psi), torch.empty_like(weight), torch.empty(len(weight))
        native.assign_backward([t.data_ptr() for t in (psi, weight, probs, grad, *out)], *ctx.sizes, num_threads())
        return *out, None
