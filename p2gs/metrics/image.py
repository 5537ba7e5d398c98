"""PSNR and SSIM of rendered test views."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Sequence

import torch
from torch import Tensor

from p2gs.ops import ssim as ops


@dataclass(frozen=True)
class ImageReport:
    """Means over the views, and each view's own. psnr in dB, ssim in [-1, 1]."""

    psnr: float
    ssim: float
    per_view: list[dict[str, float]]

    def to_dict(self) -> dict:
        """Plain numbers, for JSON."""
        return asdict(self)


def psnr(pred: Tensor, target: Tensor) -> float:
    """-10 log10 of the mean squared error, images [..., 3] in [0, 1] (clamped); infinite for equal images.

    >>> round(psnr(torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.1)), 3)
    20.0
    """
    return float(ops.psnr(pred.clamp(0, 1), target.clamp(0, 1)))


def ssim(pred: Tensor, target: Tensor) -> float:
    """Structural similarity, 11 x 11 Gaussian window of sigma 1.5 (doi:10.1109/TIP.2003.819861), images [H, W, 3] in
    [0, 1] (clamped).

    Beyond the border is black, as in the 3DGS family's own evaluation.

    >>> round(ssim(torch.ones(16, 16, 3), torch.ones(16, 16, 3)), 6)
    1.0
    """
    return float(ops.ssim(pred.clamp(0, 1), target.clamp(0, 1)))


def evaluate_images(pred: Sequence[Tensor], target: Sequence[Tensor]) -> ImageReport:
    """Scores of rendered views against photographs over the same background. Raises ValueError when there are none or
    they do not pair.

    >>> report = evaluate_images([torch.zeros(16, 16, 3)], [torch.full((16, 16, 3), 0.1)])
    >>> round(report.psnr, 3)
    20.0
    """
    if len(pred) != len(target) or not pred:
        raise ValueError(f"{len(pred)} rendered and {len(target)} true images do not pair")
    views = [{"psnr": psnr(p, t), "ssim": ssim(p, t)} for p, t in zip(pred, target, strict=True)]
    mean = {k: float(torch.tensor([v[k] for v in views], dtype=torch.float64).mean()) for k in ("psnr", "ssim")}
    return ImageReport(mean["psnr"], mean["ssim"], views)
