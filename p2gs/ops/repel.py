"""The force field of repel points (paper eq. repel, and its clamped form eq. repel_clamped)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops.knn import search_tree

Reduce = Literal["sum", "mean", "local", "within"]
EVERYWHERE = 1e6  # a radius (units of the points) that takes in every repel point; its square fits a float32


def repel_force(
    points: Tensor,
    repel_points: Tensor,
    *,
    k_r: float = 5e-4,
    exponent: float = 3.0,
    eps: float = 1e-5,
    reduce: Reduce = "sum",
    tau_max: float | None = None,
    radius: float | None = None,
    chunk: int = 2_000_000,
) -> Tensor:
    """F_i = k_r sum_j (r_j - x_i) / max(|r_j - x_i|, eps)^exponent, clipped to length tau_max: [N, 3].

    points: [N, 3].  repel_points: [R, 3].  radius, eps, tau_max: in the units of the points.
    reduce: "sum" is the paper to the letter (it doubles with twice the repel points, and reaches across the whole
    object); "mean" divides by R; "local" is the mean over the repel points nearer than ``radius``, and zero where there
    are none; "within" is the sum over those. The direction is the paper's: *towards* the repel points. In the residual
    x + F - target of the articulation loss the optimum x = target - F then lies away from them. Differentiable in both
    sets of points. Memory: ``chunk`` pairs at a time in the forward pass (autograd keeps them all). On the CPU "local"
    and "within" visit only the pairs within the radius; in float32 and without a gradient to the repel points a native
    kernel does all four, which keeps nothing by pair. Raises ValueError when "local" or "within" has no radius.
    """
    if reduce in ("local", "within") and (radius is None or radius <= 0):
        raise ValueError(f"repel_force(reduce='{reduce}') needs a positive radius")
    if points.shape[0] == 0 or repel_points.shape[0] == 0:
        return torch.zeros_like(points)
    near, within = reduce in ("local", "within"), float(radius or 0.0)
    if _native_applies(points, repel_points):
        reach, mean = within if near else EVERYWHERE, reduce in ("mean", "local")
        force = _Native.apply(points, repel_points, float(exponent), float(eps), reach, mean)
    elif near and points.device.type == "cpu":
        force = _sparse(points, repel_points, exponent, eps, within, reduce)
    else:
        rows = max(1, chunk // repel_points.shape[0])
        force = torch.cat([_dense(p, repel_points, exponent, eps, reduce, within) for p in points.split(rows)])
    force = k_r * force
    if tau_max is None:
        return force
    length_sq = force.square().sum(-1, keepdim=True)
    over = length_sq > tau_max * tau_max
    return torch.where(over, force * tau_max * torch.where(over, length_sq, torch.ones_like(length_sq)).rsqrt(), force)


def _pull(offset: Tensor, exponent: float, eps: float) -> tuple[Tensor, Tensor]:
    """offset / max(|offset|, eps)^exponent, and |offset|^2; the floor comes before the root, so offset 0 has a finite
    gradient."""
    sq = offset.square().sum(-1, keepdim=True)
    return offset * sq.clamp_min(eps * eps).pow(-0.5 * exponent), sq


def _dense(points: Tensor, repel_points: Tensor, exponent: float, eps: float, reduce: Reduce, radius: float) -> Tensor:
    pull, sq = _pull(repel_points[None] - points[:, None], exponent, eps)
    if reduce in ("sum", "mean"):
        return pull.sum(1) if reduce == "sum" else pull.mean(1)
    near = (sq < radius * radius).to(pull.dtype)
    total = (pull * near).sum(1)
    return total if reduce == "within" else total / near.sum(1).clamp_min(1)


def _native_applies(points: Tensor, repel_points: Tensor) -> bool:
    both = (points, repel_points)
    return (
        native is not None
        and not repel_points.requires_grad
        and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in both)
    )


class _Native(torch.autograd.Function):
    """Mean or summed pull of the repel points within ``radius``. Its slope by the point comes with it and waits for the
    backward pass."""

    @staticmethod
    def forward(ctx, points, repel_points, exponent, eps, radius, mean):
        points, repel_points = points.contiguous(), repel_points.contiguous()
        pull, slope = torch.empty_like(points), torch.empty(len(points), 6)
        native.repel_local(
            points.data_ptr(), len(points), repel_points.data_ptr(), len(repel_points), radius, eps, exponent, mean,
            pull.data_ptr(), slope.data_ptr(), num_threads(),
        )  # fmt: skip
        ctx.save_for_backward(slope)
        return pull

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        xx, yy, zz, xy, xz, yz = ctx.saved_tensors[0].unbind(1)
        x, y, z = grad.unbind(1)
        back = torch.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], 1)
        return back, None, None, None, None, None


def _sparse(points: Tensor, repel_points: Tensor, exponent: float, eps: float, radius: float, reduce: Reduce) -> Tensor:
    tree, repel_tree = (search_tree(x.detach().numpy()) for x in (points, repel_points))
    pairs = tree.sparse_distance_matrix(repel_tree, radius, output_type="ndarray")
    i, j = (torch.from_numpy(pairs[n].astype("int64")) for n in ("i", "j"))
    pull, _ = _pull(repel_points[j] - points[i], exponent, eps)
    total = torch.zeros_like(points).index_add(0, i, pull)
    if reduce == "within":
        return total
    return total / torch.bincount(i, minlength=len(points)).clamp_min(1).to(points.dtype)[:, None]
