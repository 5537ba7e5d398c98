"""Bundle adjustment by the pictures themselves: all cameras of one state at once, and with them the surfaces.

Descent that looks at one photograph at a time puts each camera where the model is, and the model where the cameras are.
Here the pixels of all photographs (``motion.picture_steps``) are one system: cameras' twists, and shifts of patches of
surface, which are eliminated (Schur). Photometric bundle adjustment: Engel et al. 2018 (DSO),
doi:10.1109/TPAMI.2017.2658577.
"""

from __future__ import annotations

from typing import Iterable

import torch
from torch import Tensor

from p2gs.data.views import TargetImage
from p2gs.motion.picture_steps import SHIFT, TWIST, PictureSteps, picture_steps
from p2gs.types import GaussianTensors

# standard deviations of what is sought, internal units (the object is 2)
TWIST_SIGMA = 0.003  # of cameras: twice what structure from motion leaves
SHIFT_SIGMA = 0.002  # of surfaces: a quarter of a pixel of 400
CELL = 0.06  # internal units: surface within a cube of this side, eight pixels of 400, shifts as one


@torch.no_grad()
def adjust_pictures(g: GaussianTensors, shots: Iterable[TargetImage], backend: str) -> Tensor:
    """[V, 6] float64, mean zero: twists by which cameras go from V to V exp(twist).  shots: one state's photographs
    before grey, with their cameras as known by now; taken one at a time."""
    return _solved([_by_cells(picture_steps(g, shot, backend)) for shot in shots])


def _by_cells(steps: PictureSteps) -> tuple[Tensor, Tensor, Tensor]:
    """Keys [M] of the cubes that a photograph shows, ascending, and their sums of the normal matrix [M, 9, 9] and the
    right side [M, 9]."""
    at = torch.floor(steps.points / CELL).long() + 2**19
    cells, cell = torch.unique((at[:, 0] * 2**20 + at[:, 1]) * 2**20 + at[:, 2], return_inverse=True)
    return cells, *steps.totals(cell, len(cells))


def _solved(said: list[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """[V, 6] of V photographs' ``_by_cells``, mean zero."""
    count, size = len(said), 6 * len(said)
    cells = torch.unique(torch.cat([keys for keys, _, _ in said]))
    patches = torch.eye(3).double().repeat(len(cells), 1, 1) / SHIFT_SIGMA**2
    cross = torch.zeros(len(cells), 3, size + 1).double()  # patches by twists, and the patches' right side
    A, b = torch.eye(size).double() / TWIST_SIGMA**2, torch.zeros(size).double()
    for i, (keys, normal, right) in enumerate(said):
        at, mine = torch.searchsorted(cells, keys), slice(6 * i, 6 * i + 6)
        patches[at] += normal[:, SHIFT, SHIFT]
        cross[at, :, mine] = normal[:, SHIFT, TWIST]
        cross[at, :, size] += right[:, SHIFT]
        A[mine, mine] += normal[:, TWIST, TWIST].sum(0)
        b[mine] = right[:, TWIST].sum(0)
    reduced = cross[..., :size].reshape(-1, size).T @ torch.linalg.solve(patches, cross).reshape(-1, size + 1)
    mean = torch.eye(6).double().repeat(1, count) / count  # held at zero, a million times as sure as a photograph's
    found = torch.linalg.solve(A - reduced[:, :size] + 1e12 / TWIST_SIGMA**2 * mean.T @ mean, b - reduced[:, size])
    return found.reshape(count, 6) - found.reshape(count, 6).mean(0)
