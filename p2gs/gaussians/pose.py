"""Gaussians moved by the motions of their parts: by given transforms, and the twin at any state along its screws."""

from __future__ import annotations

from typing import Sequence

import torch
from torch import Tensor

from p2gs.ops.carry import Parts
from p2gs.ops.carry import carry as carry_all
from p2gs.ops.se3 import screw_at
from p2gs.ops.so3 import matrix_to_quat, quat_multiply, quat_normalize, quat_to_matrix
from p2gs.types import ArticulatedObject, GaussianTensors


def with_static(transforms: Tensor) -> Tensor:
    """[K-1, 4, 4] -> [K, 4, 4] with the identity in slot 0."""
    return torch.cat([torch.eye(4, dtype=transforms.dtype)[None], transforms])


def shortest_axes(g: GaussianTensors) -> Tensor:
    """[N, 3] the axis along which each Gaussian is thinnest: a surface's normal, of either sign."""
    R = quat_to_matrix(quat_normalize(g.quats))
    return R.gather(2, g.log_scales.argmin(1)[:, None, None].expand(-1, 3, 1))[..., 0]


def carry(g: GaussianTensors, labels: Tensor, transforms: Tensor) -> GaussianTensors:
    """Centres and orientations moved by the rigid motion of their part, colours left as they are.

    labels [N] int64; transforms [K, 4, 4], slot 0 included.
    """
    T = transforms.to(g.means)
    R = T[:, :3, :3]
    means = (R[labels] * g.means[:, None, :]).sum(-1) + T[labels, :3, 3]
    return g.placed(means, quat_multiply(matrix_to_quat(R)[labels], quat_normalize(g.quats)))


def part_transform(obj: ArticulatedObject, part: int, t: float) -> Tensor:
    """Canonical time -> state t for the ``part``-th part, [4, 4] float64: exp((t - t_c) log T). Identity for the
    base."""
    joint = obj.parts[part].joint
    if joint is None:
        return torch.eye(4, dtype=torch.float64)
    return screw_at(joint.transform.double(), t - obj.canonical_time)


def pose(obj: ArticulatedObject, t: float | Sequence[float]) -> GaussianTensors:
    """The Gaussians at state t, in the object's own coordinates.

    t: one state time for all parts, or one per part (the base's is ignored); values outside [0, 1] go on along the
    screw. Means, orientations and the SH colours turn with the part.
    """
    times = [float(t)] * len(obj.parts) if isinstance(t, (int, float)) else [float(x) for x in t]
    if len(times) != len(obj.parts):
        raise ValueError(f"{len(times)} state times for {len(obj.parts)} parts")
    g, device = obj.gaussians.clone(), obj.gaussians.means.device
    labels, motions = torch.zeros_like(obj.part_ids, dtype=torch.int64), []
    for k, part in enumerate(obj.parts):
        if part.joint is not None:
            motions.append(part_transform(obj, k, times[k]))
            labels[obj.part_ids == part.id] = len(motions)
    if not motions:
        return g
    means, quats, sh = carry_all(
        g.means, g.quats, g.sh.contiguous(), Parts(labels.to(device)), torch.stack(motions).to(g.means)
    )
    return GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh)
