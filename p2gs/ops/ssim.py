"""The photometric loss of 3D Gaussian splatting, L1 plus D-SSIM, and the image measures SSIM and PSNR.

SSIM is Wang et al. 2004 (doi:10.1109/TIP.2003.819861): 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2, C2 = 0.03^2,
images in [0, 1], zero padding, mean over pixels and channels. D-SSIM is 1 - SSIM, as in 3DGS practice.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Hashable, MutableMapping, NamedTuple, Optional

import torch
import torch.nn.functional as F
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.ops.recorded import recorded

Box = tuple[int, int, int, int]


class TargetStatistics(NamedTuple):
    """Window means of a target, kept with the very tensor they are of."""

    target: Tensor
    version: int
    planes: Tensor

    def belongs_to(self, target: Tensor) -> bool:
        old = self.target  # alive, hence nobody else has its memory
        return (
            old.data_ptr() == target.data_ptr()
            and old.shape == target.shape
            and old.stride() == target.stride()
            and self.version == target._version
        )


def l1_ssim(
    pred: Tensor,
    target: Tensor,
    ssim_lambda: float = 0.2,
    *,
    cache: Optional[MutableMapping[Hashable, object]] = None,
    key: Optional[Hashable] = None,
    mask_box: Optional[Box] = None,
) -> Tensor:
    """(1 - ssim_lambda) mean|pred - target| + ssim_lambda (1 - SSIM(pred, target)), a scalar differentiable by pred.

    pred, target: [H, W, 3] in [0, 1].  mask_box: (x, y, width, height); the loss of that window alone, as if both
    images were cropped to it.  cache, key: a mapping in which the window means of the target are kept between calls,
    under ("l1_ssim", key). They are used again only for the same tensor in the same memory and unchanged, so a target
    that is composed anew each step is merely not cached.

    float32 CPU images take the native kernel (value and gradient in one pass), all others ``l1_ssim_reference``
    (``recorded``).
    Raises ValueError when the shapes do not fit.
    """
    if pred.shape != target.shape or pred.ndim != 3 or pred.shape[-1] != 3:
        raise ValueError(f"l1_ssim wants two images [H, W, 3], got {tuple(pred.shape)} and {tuple(target.shape)}")
    if mask_box is not None:
        x, y, width, height = mask_box
        if min(x, y) < 0 or min(width, height) < 1 or y + height > pred.shape[0] or x + width > pred.shape[1]:
            raise ValueError(f"mask_box {mask_box} is not inside an image of {pred.shape[1]} x {pred.shape[0]} pixels")
        pred, target = pred[y : y + height, x : x + width], target[y : y + height, x : x + width]
        key = None if key is None else (key, mask_box)
    fast = native is not None and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (pred, target))
    if not fast or target.requires_grad or pred.numel() == 0:
        return recorded(l1_ssim_reference, pred, target, constants=(float(ssim_lambda),))
    return _L1SSIM.apply(pred, target, float(ssim_lambda), cache, key)


class _L1SSIM(torch.autograd.Function):
    """The gradient comes with the value and waits in ``ctx`` for the factor of the backward pass."""

    @staticmethod
    def forward(ctx, pred, target, ssim_lambda, cache, key):
        pred, target = _rows(pred), _rows(target)
        height, width, _ = pred.shape
        known, planes = _statistics(cache, key, target)
        grad = torch.empty(height, width, 3) if ctx.needs_input_grad[0] else None
        loss = native.l1_ssim(
            pred.data_ptr(),
            pred.stride(0),
            target.data_ptr(),
            target.stride(0),
            height,
            width,
            ssim_lambda,
            planes.data_ptr(),
            known,
            0 if grad is None else grad.data_ptr(),
            3 * width,
            num_threads(),
        )
        ctx.grad = grad
        return pred.new_tensor(loss)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        return ctx.grad * grad_output, None, None, None, None


def _rows(image: Tensor) -> Tensor:
    """The image itself where pixels of a row follow each other in memory, as in a crop; otherwise a copy."""
    return image if image.stride(2) == 1 and image.stride(1) == 3 else image.contiguous()


def _statistics(cache, key, target: Tensor) -> tuple[bool, Tensor]:
    """(whether they are filled, [2, H, padded row] planes for ``native.l1_ssim``)."""
    height, width, _ = target.shape
    if cache is None or key is None:
        return False, target.new_empty(2, height, native.ssim_padded(3 * width))
    key = ("l1_ssim", key)
    entry = cache.get(key)
    if isinstance(entry, TargetStatistics) and entry.belongs_to(target):
        return True, entry.planes
    planes = target.new_empty(2, height, native.ssim_padded(3 * width))
    # A second, different target under the same key: it is composed anew for each step, keeping it would only cost
    # memory.
    cache[key] = TargetStatistics(target, target._version, planes) if key not in cache else None
    return False, planes


@lru_cache(maxsize=None)
def gaussian_window(dtype=torch.float32, device=None) -> Tensor:
    """The weights of the separable window, [11], sigma 1.5, sum 1. One tensor for all callers: not to be written to."""
    x = torch.arange(11, dtype=torch.float64) - 5
    g = torch.exp(-(x**2) / (2 * 1.5**2))
    return (g / g.sum()).to(dtype=dtype, device=device)


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of every pixel and channel, [..., H, W, 3] for images [..., H, W, 3]."""
    shape = a.shape
    a, b = (t.reshape(-1, *shape[-3:]).permute(0, 3, 1, 2) for t in (a, b))
    batch, channels = a.shape[:2]
    g = gaussian_window(a.dtype, a.device)
    kernel = (g[:, None] * g[None, :]).expand(5 * channels, 1, 11, 11)
    # one grouped 2D convolution: on a CPU torch runs it ten times faster than two one-dimensional ones
    blurred = F.conv2d(torch.cat([a, b, a * a, b * b, a * b], 1), kernel, padding=5, groups=5 * channels)
    ma, mb, aa, bb, ab = blurred.split(channels, 1)
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * ma * mb + c1) * (2 * (ab - ma * mb) + c2)
    bottom = (ma**2 + mb**2 + c1) * ((aa - ma**2) + (bb - mb**2) + c2)
    return (top / bottom).permute(0, 2, 3, 1).reshape(shape)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM of images [..., H, W, 3] in [0, 1], a scalar."""
    return ssim_map(a, b).mean()


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of images in [0, 1], a scalar; infinite where they are equal."""
    return -10 * torch.log10(F.mse_loss(a, b))


def l1_ssim_reference(pred: Tensor, target: Tensor, ssim_lambda: float = 0.2) -> Tensor:
    """``l1_ssim`` written for reading: any floating dtype and device, differentiable by both images."""
    return (1 - ssim_lambda) * (pred - target).abs().mean() + ssim_lambda * (1 - ssim(pred, target))
