"""The Gaussians of a part as a ParticleField3DGaussianSplat prim (UsdVol, OpenUSD 26.03 and later), for a stage written
as text."""

from __future__ import annotations

from typing import Iterable

import numpy as np
import torch

from p2gs.ops.sh import degree_of
from p2gs.ops.so3 import quat_to_matrix
from p2gs.types import GaussianTensors

REACH = 3.0  # standard deviations: as far as renderers draw a Gaussian, for the prim's extent


def splat_prim(g: GaussianTensors, indent: str) -> list[str]:
    """Lines of the prim "splats": scales linear, opacities between 0 and 1, orientations wxyz, coefficients grouped by
    Gaussian."""
    means, scales = g.means.double().numpy(), g.log_scales.double().exp().numpy()
    quats = torch.nn.functional.normalize(g.quats.double(), dim=-1)
    R = quat_to_matrix(quats).numpy()
    half = REACH * np.sqrt(((R * scales[:, None]) ** 2).sum(-1))
    extent = [(means - half).min(0), (means + half).max(0)]
    bases = g.sh.shape[1]
    rows = [
        f"point3f[] positions = {_tuples(means, 7)}",
        f"quatf[] orientations = {_tuples(quats.numpy(), 7)}",
        f"float3[] scales = {_tuples(scales, 6)}",
        f"float[] opacities = [{', '.join(f'{v:.6g}' for v in torch.sigmoid(g.opacity_logits.double()).tolist())}]",
        f"uniform int radiance:sphericalHarmonicsDegree = {degree_of(bases)}",
        f"float3[] radiance:sphericalHarmonicsCoefficients = {_tuples(g.sh.double().numpy().reshape(-1, 3), 6)} (",
        f"    elementSize = {bases}",
        '    interpolation = "vertex"',
        ")",
        f"float3[] extent = {_tuples(extent, 9)}",
        'uniform token sortingModeHint = "cameraDistance"',
    ]
    return [
        f'{indent}def ParticleField3DGaussianSplat "splats"',
        indent + "{",
        *(f"{indent}    {r}" for r in rows),
        indent + "}",
    ]


def _tuples(rows: Iterable, digits: int) -> str:
    return "[" + ", ".join("(" + ", ".join(f"{v:.{digits}g}" for v in row) + ")" for row in rows) + "]"
