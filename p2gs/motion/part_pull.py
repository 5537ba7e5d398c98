"""A loss's gradient by small motions of rigid parts, from its gradient by the Gaussians that they carry."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.native import native
from p2gs.ops.carry import Parts

Limit = tuple[Tensor, Tensor, Tensor, float]  # seen_from, rotations, eye, least cosine (``part_pulls``)


def part_pulls(means: Tensor, quats: Tensor, parts: Parts, centres: Tensor, limit: Limit | None = None) -> Tensor:
    """Gradient [K-1, 6] (by rotation about the part's centre, by translation), float64 on the CPU.

    means [N, 3] and quats [N, 4], moved, with their ``grad``.  centres [K-1, 3].  limit: (seen_from [N, 3], rotations
    [K-1, 3, 3], eye [3], least cosine): Gaussians that look at ``eye`` with a smaller cosine (``facing``) have no say.
    float32 on the CPU takes native code, anything else ``part_pulls_reference``.
    """
    assert means.grad is not None and quats.grad is not None
    maps = [means, quats, means.grad, quats.grad, *(limit[:1] if limit else ())]
    if native is None or any(t.dtype != torch.float32 or t.device.type != "cpu" for t in maps):
        return part_pulls_reference(means, quats, parts, centres, limit)
    kept = [t.detach().contiguous() for t in maps]
    if limit:
        kept += [t.float().cpu().contiguous() for t in limit[1:3]]
    centres = centres.double().contiguous()
    out = centres.new_zeros(len(centres), 6)
    addresses = [t.data_ptr() for t in kept] + [0] * (7 - len(kept))
    rows, starts = parts.rows.data_ptr(), parts.starts.data_ptr()
    native.part_pulls(
        addresses, centres.data_ptr(), rows, starts, parts.count, limit[3] if limit else -1.0, out.data_ptr()
    )
    return out


def part_pulls_reference(
    means: Tensor, quats: Tensor, parts: Parts, centres: Tensor, limit: Limit | None = None
) -> Tensor:
    """``part_pulls`` in torch, on any device."""
    rows, part = parts.rows, parts.labels[parts.rows] - 1
    assert means.grad is not None and quats.grad is not None
    at, turned = means.detach()[rows], quats.detach()[rows]
    pulls = torch.cat(
        tangent_gradient(at, turned, means.grad[rows], quats.grad[rows], centres.double().to(means.device)[part]), 1
    )
    if limit:
        seen_from, turns, eye, least = limit
        pulls = pulls * (facing(seen_from[rows], turns.to(means)[part], at, eye) >= least)[:, None]
    return pulls.new_zeros(len(centres), 6).index_add_(0, part, pulls).cpu()


def by_inverse(pulls: Tensor, transforms: Tensor) -> Tensor:
    """Gradient [K, 6] by small motions about T c that follow the motions T [K, 4, 4], of what their inverses carry:
    from ``pulls`` [K, 6], that of what T^-1 brought there about c. T^-1 turns such a motion by R^T and undoes it.
    """
    R = transforms[:, :3, :3]
    return -torch.cat([(R @ part[..., None])[..., 0] for part in pulls.split(3, 1)], 1)


def tangent_gradient(
    means: Tensor, quats: Tensor, grad_means: Tensor, grad_quats: Tensor, centre: Tensor
) -> tuple[Tensor, Tensor]:
    """Each point's share of the gradient of a loss by a small rotation about ``centre`` and a small translation of
    points already moved.

    means, grad_means [n, 3]; quats, grad_quats [n, 4]; centre [3] or [n, 3].  Returns (rotation [n, 3], translation [n,
    3]), float64: their sums are the gradient. A rotation by w turns a quaternion q into q + 0.5 (0, w) q.
    """
    grad_means, grad_quats = grad_means.double(), grad_quats.double()
    rotation = torch.linalg.cross(means.double() - centre, grad_means)
    w, v = quats[:, :1].double(), quats[:, 1:].double()
    # (0, e_j) * q = (-v_j, w e_j + e_j x v), contracted with the gradient of q
    g0, gv = grad_quats[:, :1], grad_quats[:, 1:]
    return rotation + 0.5 * (-g0 * v + w * gv + torch.linalg.cross(v, gv)), grad_means


def facing(seen_from: Tensor, rotation: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Cosine [n] between the direction from moved points ``means`` [n, 3] to ``eye`` [3] and their ``seen_from`` [n,
    3], turned by ``rotation`` [3, 3] or [n, 3, 3].

    The back of a door's front face, seen through an opened door, stands a door's thickness before the inner face in the
    photograph.
    """
    way = torch.nn.functional.normalize(eye.to(means) - means, dim=1)
    return ((rotation.to(means) @ seen_from[..., None])[..., 0] * way).sum(1)
