"""Bundle adjustment by the pictures themselves: all cameras of one state at once, and with them the surfaces.

Descent that looks at one photograph at a time puts each camera where the model is, and the model where the cameras are.
Here the pixels of all photographs (``motion.picture_steps``) are one system: cameras' twists, and shifts of patches of
surface, which are eliminated (Schur). Photometric bundle adjustment: Engel et al. 2018 (DSO),
doi:10.1109/TPAMI.2017.2658577.

A camera that stepped aside and turned back shows almost the same picture, so that pixels alone would put cameras
several times as far off as they came. A camera came with errors of its own turn and place, alike for all; and pixels'
errors are the model's, many pixels' at once, so that there is less in them than their number says. How large the
cameras' errors are and how much a pixel counts are what makes all that the pixels say most likely (empirical Bayes:
MacKay 1992, doi:10.1162/neco.1992.4.3.415).
"""

from __future__ import annotations

from typing import Iterable

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from p2gs.data.views import TargetImage
from p2gs.motion.picture_steps import SHIFT, TWIST, PictureSteps, picture_steps
from p2gs.ops import se3, so3
from p2gs.types import Camera, GaussianTensors

SHIFT_SIGMA = 0.002  # of surfaces, internal units (the object is 2): a quarter of a pixel of 400
CELL = 0.06  # internal units: surface within a cube of this side, eight pixels of 400, shifts as one


@torch.no_grad()
def adjust_pictures(g: GaussianTensors, shots: Iterable[TargetImage], known: Tensor, backend: str) -> Tensor:
    """[V, 6] float64, mean zero: twists by which cameras go from V, as they came, to V exp(twist).

    shots: one state's photographs before grey, with their cameras as known by now; taken one at a time.  known [V, 6]:
    the twists that these have.
    """
    said, ways = [], []
    for shot in shots:
        said.append(_by_cells(picture_steps(g, shot, backend)))
        ways.append(_own_errors(shot.camera))
    return _most_likely(*_system(said), known.double().cpu(), torch.stack(ways))


def _own_errors(camera: Camera) -> Tensor:
    """[6, 6]: a small twist as the camera's own turn and the way that its centre goes, both over nothing but radians:
    the way is divided by the camera's distance from the origin."""
    centre = se3.inverse(camera.viewmat.double().cpu())[:3, 3]
    out = torch.eye(6, dtype=torch.float64)
    # V exp(twist) has its centre at c - (w x c + v)
    out[3:, :3], out[3:, 3:] = so3.skew(centre), -torch.eye(3).double()
    out[3:] /= centre.norm()
    return out


def _by_cells(steps: PictureSteps) -> tuple[Tensor, Tensor, Tensor]:
    """Keys [M] of the cubes that a photograph shows, ascending, and their sums of the normal matrix [M, 9, 9] and the
    right side [M, 9]."""
    at = torch.floor(steps.points / CELL).long() + 2**19
    cells, cell = torch.unique((at[:, 0] * 2**20 + at[:, 1]) * 2**20 + at[:, 2], return_inverse=True)
    return cells, *steps.totals(cell, len(cells))


def _system(said: list[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Normal matrix [6 V, 6 V] and right side [6 V] of V photographs' twists, of their ``_by_cells``: patches
    eliminated."""
    size = 6 * len(said)
    cells = torch.unique(torch.cat([keys for keys, _, _ in said]))
    patches = torch.eye(3).double().repeat(len(cells), 1, 1) / SHIFT_SIGMA**2
    cross = torch.zeros(len(cells), 3, size + 1).double()  # patches by twists, and the patches' right side
    A, b = torch.zeros(size, size).double(), torch.zeros(size).double()
    for i, (keys, normal, right) in enumerate(said):
        at, mine = torch.searchsorted(cells, keys), slice(6 * i, 6 * i + 6)
        patches[at] += normal[:, SHIFT, SHIFT]
        cross[at, :, mine] = normal[:, SHIFT, TWIST]
        cross[at, :, size] += right[:, SHIFT]
        A[mine, mine] += normal[:, TWIST, TWIST].sum(0)
        b[mine] = right[:, TWIST].sum(0)
    reduced = cross[..., :size].reshape(-1, size).T @ torch.linalg.solve(patches, cross).reshape(-1, size + 1)
    return A - reduced[:, :size], b - reduced[:, size]


def _most_likely(A: Tensor, b: Tensor, known: Tensor, ways: Tensor) -> Tensor:
    """Total twists [V, 6], mean zero, of the system ``A`` [6 V, 6 V] and ``b`` [6 V] about the twists ``known``
    [V, 6]. ways [V, 6, 6]: ``_own_errors``.

    In the cameras' own errors u, all of one variance s^2, and along the axes in which pixels say independent things
    (eigenvectors of A, eigenvalues a), what pixels say is u_j with the variance 1 / (k a_j).
    """
    back = torch.block_diag(*torch.linalg.inv(ways))
    a, axes = torch.linalg.eigh(back.T @ A @ back)
    a = a.clamp_min(1e-12 * float(a.max()) + 1e-300)
    say = axes.T @ (ways @ known[..., None]).flatten() + (axes.T @ (back.T @ b)) / a
    s, k = _variances(say.numpy(), a.numpy())
    u = axes @ (say * s / (s + 1 / (k * a)))
    found = (back @ u).reshape(known.shape)
    return found - found.mean(0)


def _variances(say: np.ndarray, a: np.ndarray) -> tuple[float, float]:
    """Variance s of the cameras' own errors (radians^2) and the share k that a pixel counts, with which what pixels say
    (``say`` [N], of weights ``a`` [N]) is most likely: normal with the variance s + 1 / (k a)."""

    def unlikely(x: np.ndarray) -> float:
        variance = np.exp(x[0]) + np.exp(-x[1]) / a
        return float((np.log(variance) + say**2 / variance).sum())

    begin = [np.log(np.median(say**2) + np.finfo(float).tiny), 0.0]
    s, k = np.exp(minimize(unlikely, begin, method="Nelder-Mead").x)
    return float(s), float(k)
