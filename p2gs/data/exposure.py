"""Exposure in linear light: sRGB decoded and encoded (IEC 61966-2-1), gains measured, a photograph with its gain taken
out."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB 0..1 to linear light, an array of any shape."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    """Linear light to sRGB 0..1, an array of any shape."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


def corrected(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """A photograph [H, W, 3] uint8 RGB without its gain [3], the natural logarithm of a factor on linear light per
    channel."""
    table = [
        np.rint(255 * np.clip(encoded(linear(np.arange(256) / 255) * np.exp(-g)), 0, 1)).astype(np.uint8) for g in gain
    ]
    return np.stack([t[image[..., c]] for c, t in enumerate(table)], axis=-1)


def median_gain(photo: Tensor, drawn: Tensor, inside: Tensor) -> Tensor | None:
    """Natural logarithm [3] of how much brighter, in linear light, a photograph is than its rendering; None where too
    little can be told.

    photo, drawn: [H, W, 3] sRGB 0..1.  inside: [H, W] bool, where both show the object.
    """
    dark, bright, enough = 10 / 255, 245 / 255, 200  # sRGB beyond which sensors are not linear; pixels
    ok = inside & (photo > dark).all(-1) & (photo < bright).all(-1) & (drawn > dark).all(-1) & (drawn < bright).all(-1)
    if int(ok.sum()) < enough:
        return None
    return (_light(photo[ok]).log() - _light(drawn[ok]).log()).median(0).values


def brightened(colour: Tensor, log_gain: Tensor) -> Tensor:
    """sRGB colours [..., 3] times exp(log_gain [3]) in linear light."""
    light = _light(colour.clamp(0, 1)) * log_gain.to(colour).exp()
    return torch.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    ).clamp(0, 1)


def _light(srgb: Tensor) -> Tensor:
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
