"""The twin at any state: every part moved along its own screw."""

from __future__ import annotations

from typing import Sequence

import torch
from torch import Tensor

from p2gs.ops.se3 import screw_at
from p2gs.ops.sh import rotate_sh
from p2gs.ops.so3 import matrix_to_quat, quat_multiply
from p2gs.types import ArticulatedObject, GaussianTensors


def part_transform(obj: ArticulatedObject, part: int, t: float) -> Tensor:
    """Canonical time -> state t for the ``part``-th part, [4, 4] float64: exp((t - t_c) log T). Identity for the base."""
    joint = obj.parts[part].joint
    if joint is None:
        return torch.eye(4, dtype=torch.float64)
    return screw_at(joint.transform.double(), t - obj.canonical_time)


def pose(obj: ArticulatedObject, t: float | Sequence[float]) -> GaussianTensors:
    """The Gaussians at state t, in the object's own coordinates.

    t: one state time for all parts, or one per part (the base's is ignored); values outside [0, 1] go on along the screw.
    Means, orientations and the SH colours turn with the part.
    """
    times = [float(t)] * len(obj.parts) if isinstance(t, (int, float)) else [float(x) for x in t]
    if len(times) != len(obj.parts):
        raise ValueError(f"{len(times)} state times for {len(obj.parts)} parts")
    out = obj.gaussians.clone()
    for k, part in enumerate(obj.parts):
        chosen = (obj.part_ids == part.id).nonzero()[:, 0]
        if part.joint is None or not len(chosen):
            continue
        T = part_transform(obj, k, times[k])
        out = _move(out, chosen, T.to(out.means))
    return out


def _move(g: GaussianTensors, index: Tensor, T: Tensor) -> GaussianTensors:
    """Rigidly move the Gaussians ``index`` of ``g`` in place."""
    R = T[:3, :3]
    g.means[index] = g.means[index] @ R.T + T[:3, 3]
    g.quats[index] = quat_multiply(matrix_to_quat(R).expand(len(index), 4), g.quats[index])
    if g.sh.shape[1] > 1:
        g.sh[index] = rotate_sh(g.sh[index], R)
    return g
