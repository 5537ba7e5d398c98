"""Labelled Gaussians carried by one rigid motion a part: a native kernel, and the same in torch."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops import so3
from p2gs.ops.sh import band_tables, degree_of, rotate_sh


class Parts:
    """Which Gaussians each part has, sorted once for many calls of ``carry``.

    labels [N] int64: 0 stays where it is, k is carried by transforms[k-1].  rows [M]: the carried ones, part by part.
    starts [max(labels) + 1]: part k has rows[starts[k-1]:starts[k]].
    """

    def __init__(self, labels: Tensor):
        self.labels = labels
        self.count = int(labels.max()) if len(labels) else 0
        number = torch.bincount(labels, minlength=self.count + 1)
        self.rows = torch.argsort(labels, stable=True)[int(number[0]) if len(labels) else 0 :]
        self.starts = torch.cat([number.new_zeros(1), number[1:].cumsum(0)])


def carry(means: Tensor, quats: Tensor, sh: Tensor, parts: Parts, transforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3], quats [N, 4] (wxyz, turned) and SH [N, B, 3] (bands turned) after the motions transforms [K-1, 4,
    4]. No gradient.

    float32 on the CPU takes the native kernel (the same bits for any number of threads), anything else
    ``carry_reference``. ``sh`` itself comes back where there is nothing to turn (B = 1).  Raises IndexError for a part
    without a motion, ValueError for shapes that do not fit.
    """
    n = len(parts.labels)
    if means.shape != (n, 3) or quats.shape != (n, 4) or sh.shape[::2] != (n, 3) or transforms.shape[1:] != (4, 4):
        raise ValueError(
            f"carry wants means [N, 3], quats [N, 4], sh [N, B, 3], transforms [K-1, 4, 4] for N = {n}, got "
            f"{tuple(means.shape)}, "
            f"{tuple(quats.shape)}, {tuple(sh.shape)}, {tuple(transforms.shape)}"
        )
    if parts.count > len(transforms):
        raise IndexError(f"part {parts.count} has no motion, there are {len(transforms)}")
    if native is None or any(t.dtype != torch.float32 or t.device.type != "cpu" for t in (means, quats, sh)):
        return carry_reference(means, quats, sh, parts, transforms)
    turned = degree_of(sh.shape[1]) > 0
    old = [t.detach().contiguous() for t in (means, quats, sh)]
    new = [old[0].clone(), old[1].clone(), old[2].clone() if turned else sh]
    motions = transforms.detach().float().cpu().contiguous()
    addresses = [t.data_ptr() for t in (*old, *new)]
    tables = _tables(degree_of(sh.shape[1]))
    native.carry(
        addresses,
        sh.shape[1],
        parts.rows.data_ptr(),
        parts.starts.data_ptr(),
        motions.data_ptr(),
        tables.data_ptr(),
        parts.count,
        num_threads(),
    )
    return new[0], new[1], new[2]


@torch.no_grad()
def carry_reference(
    means: Tensor, quats: Tensor, sh: Tensor, parts: Parts, transforms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """``carry``, its shapes too, in torch, on any device."""
    transforms = torch.cat([torch.eye(4).to(means)[None], transforms.to(means)])
    T = transforms[parts.labels]
    means = torch.einsum("nij,nj->ni", T[:, :3, :3], means) + T[:, :3, 3]
    quats = so3.quat_multiply(so3.matrix_to_quat(transforms[:, :3, :3])[parts.labels], quats)
    return means, quats, rotate_sh(sh, transforms[:, :3, :3], parts.labels) if sh.shape[1] > 1 else sh


class RigidMoves:
    """Motions that stay, for Gaussians that learn: like ``carry`` without harmonics, with gradients by means and quats.

    labels [N] int64, or what ``Parts`` has sorted them into; transforms [K-1, 4, 4], part k moves by transforms[k-1].
    """

    def __init__(self, labels: Tensor | Parts, transforms: Tensor):
        parts = labels if isinstance(labels, Parts) else Parts(labels)
        self.parts, self.transforms = parts, transforms
        self.back = torch.eye(4, dtype=transforms.dtype, device=transforms.device).expand_as(transforms).clone()
        self.back[:, :3, :3] = transforms[:, :3, :3].transpose(1, 2)
        # q and -q turn alike, but a gradient by q knows which it was: of a half turn the inverse may come out as the
        # other one
        still = torch.zeros(len(parts.labels), 4).to(parts.labels.device)
        still[:, 0] = 1
        there = carry(still[:, 1:], still, still[:, None, 1:], self.parts, transforms)[1]
        again = carry(still[:, 1:], there, still[:, None, 1:], self.parts, self.back)[1]
        self.sign = torch.where(again[:, :1] < 0, -1.0, 1.0)

    def __call__(self, means: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
        """Means [N, 3] and quats [N, 4], of any length, after the motions; the latter come back normalised."""
        return _Moved.apply(means, so3.quat_normalize(quats), self)


class _Moved(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, moves):
        ctx.moves = moves
        return carry(means, quats, means[:, None], moves.parts, moves.transforms)[:2]

    @staticmethod
    def backward(ctx, grad_means, grad_quats):
        m = ctx.moves
        grad_means, grad_quats, _ = carry(grad_means, grad_quats, grad_means[:, None], m.parts, m.back)
        return grad_means, grad_quats * m.sign, None


@lru_cache(maxsize=None)
def _tables(degree: int) -> Tensor:
    """What ``rotation_matrices`` knows of the bands, one behind the other, float64."""
    return torch.cat(
        [
            torch.zeros(0, dtype=torch.float64),
            *(t.flatten() for band in range(1, degree + 1) for t in band_tables(band)),
        ]
    )
