"""splats.spz: the Gaussians at the start state in Niantic's compressed format, a fifth of the PLY's size.

Version 3 of the format after its description (github.com/nianticlabs/spz, README): gzip over a header of 16 bytes and
one block each of positions (24-bit fixed point), opacities, colours, logarithms of scales (8 bits each), rotations (the
three smaller components of the quaternion, 10 bits each, and which is left out) and the higher coefficients of the
spherical harmonics (8 bits each). Axes are those of OpenGL: x right, y up, z back.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import torch

from p2gs.export.asset import Asset
from p2gs.ops.sh import degree_of
from p2gs.types import GaussianTensors

MAGIC, VERSION = 0x5053474E, 3
FINENESS = 16  # bits for the farthest coordinate: steps of a 65,000th of the object
MAX_BITS = 23  # of a coordinate without its sign
COLOUR = 0.15  # share of a byte's range for one unit of the constant coefficient: colours below 0 and above 1 fit, too


def write_spz(asset: Asset, out: Path) -> Path:
    """OUT/splats.spz, of all parts."""
    moved = [
        link.splats.placed(link.splats.means + torch.from_numpy(link.origin).float(), link.splats.quats)
        for link in asset.links
        if link.splats is not None
    ]
    path = out / "splats.spz"
    path.write_bytes(spz_bytes(GaussianTensors.cat(moved)))
    return path


def spz_bytes(gaussians: GaussianTensors) -> bytes:
    """The file's content."""
    means, quats, log_scales, logits, sh = (
        getattr(gaussians, n).detach().cpu().double().numpy() for n in GaussianTensors.NAMES
    )
    bits = _fraction(float(np.abs(means).max(initial=0.0)))
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree_of(sh.shape[1]), bits, 0, 0)
    fixed = np.round(means * 2.0**bits).astype("<i4")
    blocks = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _byte(255 / (1 + np.exp(-logits))),
        _byte(255 * (COLOUR * sh[:, 0] + 0.5)),
        _byte(16 * (log_scales + 10)),
        _smallest_three(quats),
        _byte(128 * sh[:, 1:] + 128),
    ]
    return gzip.compress(header + b"".join(b.tobytes() for b in blocks), mtime=0)


def _fraction(farthest: float) -> int:
    """Bits behind the binary point, with which coordinates up to ``farthest`` fit."""
    whole = int(np.ceil(np.log2(farthest))) if farthest > 0 else 0
    return int(np.clip(FINENESS - whole, 0, MAX_BITS))


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] as words [N] of 32 bits: index of the largest component (of xyzw), then sign and 9 bits
    of each other."""
    q = (quats / np.linalg.norm(quats, axis=1, keepdims=True))[:, [1, 2, 3, 0]]
    rows, largest = np.arange(len(q)), np.abs(q).argmax(1)
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.stack([[c for c in range(4) if c != i] for i in range(4)])[largest]
    small = np.take_along_axis(q, others, 1)
    size = np.clip(np.round(np.abs(small) * np.sqrt(2) * 511), 0, 511).astype(np.uint32)
    fields = (small < 0).astype(np.uint32) << 9 | size
    return (largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")
