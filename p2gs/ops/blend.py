"""Gaussians moved by softly assigned rigid motions (paper appendix, part assignment): a native kernel, and the same in
torch."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops import se3, so3


def blend_move(means: Tensor, quats: Tensor, probs: Tensor, twists: Tensor) -> tuple[Tensor, Tensor]:
    """mu' = sum_k p_k (R_k mu + t_k), and the Gaussians' rotations turned by the p-weighted mean of the parts'
    quaternions.

    means [N, 3]; quats [N, 4] wxyz of any length; probs [N, K]; twists [K-1, 6]: motion k is exp(twists[k-1]), slot 0
    stands still. Returns (means [N, 3], unit quats [N, 4]). The parts' quaternions are taken on slot 0's side (w >= 0)
    before they are averaged; a mean of no length is the identity. Differentiable by all four. float32 on the CPU takes
    the native kernel (the same bits for any number of threads), anything else ``blend_move_reference``. Raises
    ValueError for shapes that do not fit.
    """
    n, parts = probs.shape
    if means.shape != (n, 3) or quats.shape != (n, 4) or twists.shape != (parts - 1, 6):
        raise ValueError(
            f"blend_move wants means [N, 3], quats [N, 4], probs [N, K], twists [K-1, 6], got {tuple(means.shape)}, "
            f"{tuple(quats.shape)}, "
            f"{tuple(probs.shape)}, {tuple(twists.shape)}"
        )
    inputs = (means, quats, probs, twists)
    if native is None or any(t.dtype != torch.float32 or t.device.type != "cpu" for t in inputs):
        return blend_move_reference(*inputs)
    return _BlendMove.apply(*inputs)


@torch.no_grad()
def likeliest(probs: Tensor) -> Tensor:
    """``probs.argmax(1)`` of [N, K] for small K, the first of equals: torch's own takes 20 times as long where K is
    short."""
    best = probs[:, 0]
    label = torch.zeros(len(probs), dtype=torch.int64, device=probs.device)
    for k in range(1, probs.shape[1]):
        label = torch.where(probs[:, k] > best, k, label)
        best = torch.maximum(best, probs[:, k])
    return label


class _BlendMove(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, probs, twists):
        ctx.set_materialize_grads(False)
        # part by part, as the head makes them: no copy there
        inputs = (means.contiguous(), quats.contiguous(), probs.T.contiguous(), twists.contiguous())
        ctx.save_for_backward(*inputs)
        moved, turned = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        native.blend_forward([t.data_ptr() for t in (*inputs, moved, turned)], *probs.shape, num_threads())
        return moved, turned

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, moved, turned):
        inputs = ctx.saved_tensors
        incoming = [None if g is None else g.contiguous() for g in (moved, turned)]
        gradients = [torch.empty_like(t) for t in inputs]
        addresses = [0 if t is None else t.data_ptr() for t in (*inputs, *incoming, *gradients)]
        native.blend_backward(addresses, inputs[2].shape[1], inputs[2].shape[0], num_threads())
        return gradients[0], gradients[1], gradients[2].T, gradients[3]


def part_motions(twists: Tensor) -> Tensor:
    """exp of the twists [K-1, 6] of the movable parts behind the identity of slot 0: [K, 4, 4], differentiable.

    The same as ``se3.exp``, whose many small operations cost a training step a millisecond. float32 on the CPU takes
    the native code.
    """
    if native is None or twists.dtype != torch.float32 or twists.device.type != "cpu":
        return torch.cat([torch.eye(4).to(twists)[None], se3.exp(twists)])
    return _PartMotions.apply(twists)


class _PartMotions(torch.autograd.Function):
    @staticmethod
    def forward(ctx, twists):
        twists = twists.contiguous()
        ctx.save_for_backward(twists)
        out = torch.empty(len(twists) + 1, 4, 4)
        native.part_motions(twists.data_ptr(), out.data_ptr(), len(out))
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        (twists,) = ctx.saved_tensors
        grad, out = grad.contiguous(), torch.empty_like(twists)
        native.part_motions_backward(twists.data_ptr(), grad.data_ptr(), out.data_ptr(), len(grad))
        return out


def blend_move_reference(means: Tensor, quats: Tensor, probs: Tensor, twists: Tensor) -> tuple[Tensor, Tensor]:
    """``blend_move``, its shapes too, written for reading: any floating dtype and device."""
    motions = torch.cat([torch.eye(4).to(twists)[None], se3.exp(twists)])
    rows = (probs @ motions[:, :3].flatten(1)).unflatten(1, (3, 4))
    moved = (rows[:, :, :3] * means[:, None, :]).sum(-1) + rows[:, :, 3]
    turns = probs @ so3.matrix_to_quat(motions[:, :3, :3])
    return moved, so3.quat_multiply(so3.quat_normalize(turns), so3.quat_normalize(quats))
