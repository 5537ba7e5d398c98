"""Differentiable rasterization of Gaussians: one function, several backends.

Backends live in their own files and register in ``RASTERIZERS``: ``cpu`` (native kernels), ``gsplat`` (CUDA),
``torch_ref`` (readable reference in torch, any device and dtype). A backend of your own:
``@RASTERIZERS.register("name")`` on a function from ``RenderInputs`` to ``RenderOutput``.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Optional

import torch
from torch import Tensor

from p2gs.native import native, warn_missing_once
from p2gs.registry import suggest
from p2gs.render.base import RASTERIZERS, Rasterizer, RenderInputs, check, split_backend, with_pixels
from p2gs.types import RenderOutput, UserError

__all__ = [
    "RASTERIZERS",
    "RenderInputs",
    "draws_natively",
    "find_rasterizer",
    "rasterize",
    "rasterize_stored",
    "with_pixels",
]

_BUILT_IN = ("cpu", "gsplat", "torch_ref")
_warned: set[str] = set()


def find_rasterizer(name: str) -> Rasterizer:
    """The backend registered under ``name``. Raises UserError when it is unknown or cannot run here."""
    if name not in RASTERIZERS:
        if name not in _BUILT_IN:
            raise UserError(f"unknown rasterizer '{name}'{suggest(name, {*RASTERIZERS, *_BUILT_IN})}")
        importlib.import_module(f"p2gs.render.{name}")
    return RASTERIZERS[name]


def draws_natively(means: Tensor, backend: str) -> bool:
    """Whether the native kernels draw these: torch is better left with one thread beside them."""
    return means.device.type == "cpu" and split_backend(backend)[0] in ("auto", "cpu")


def _auto(means: Tensor) -> str:
    if means.is_cuda:
        try:
            find_rasterizer("gsplat")
            return "gsplat"
        except UserError as err:
            if "gsplat" not in _warned:
                _warned.add("gsplat")
                warnings.warn(f"{err}: using the slow reference rasterizer in torch", stacklevel=3)
            return "torch_ref"
    if means.device.type == "cpu" and native is not None:
        return "cpu"
    if means.device.type == "cpu":
        warn_missing_once()
    elif means.device.type not in _warned:
        _warned.add(means.device.type)
        warnings.warn(
            f"no fast rasterizer for device '{means.device.type}': using the slow reference rasterizer in torch",
            stacklevel=3,
        )
    return "torch_ref"


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: Optional[int] = None,
    features: Optional[Tensor] = None,
    background: Optional[Tensor] = None,
    depth_sq: bool = False,
    depth_ref: float = 0.0,
    near: float = 0.01,
    eps2d: Optional[float] = None,
    antialias: Optional[bool] = None,
    absgrad: bool = False,
    median_depth: Optional[bool] = None,
    backend: str = "auto",
) -> RenderOutput:
    """Splat N Gaussians into one view of ``height`` x ``width`` pixels (Kerbl et al. 2023, doi:10.1145/3592433).

    means [N, 3] world; quats [N, 4] wxyz of any length but zero; scales [N, 3] standard deviations; opacities [N] in
    0..1; sh [N, B, 3] with B = 1, 4, 9 or 16; viewmat [4, 4] world -> camera, K [3, 3] in pixels (see ``types``).
    sh_degree: use only the bands up to it.  features [N, F], F <= 16: composited like colour, over nothing.
    background [3] or [H, W, 3] (default black).  depth_sq: also accumulate (z - depth_ref)^2.
    near: Gaussians nearer than this (scene units) are culled.  eps2d: variance in pixels^2 added to every projected
    Gaussian, the pixel's own extent.  antialias: its opacity falls by as much as its area grows by that (Yu et al.
    2024, Mip-Splatting, arXiv:2311.16493), so that a surface seen edge-on is as thin as it is. Both None: as
    ``backend`` has it.
    absgrad: the backward pass fills ``means2d_abs_grad`` [N] = length of (sum |dL/dx|, sum |dL/dy|) over pixels, pixel
    units (Ye et al. 2024, arXiv:2404.10484).  median_depth: also give the depth where transmittance passes one half; by
    default only when no gradient is recorded.  backend: a name in ``RASTERIZERS`` or "auto" (cpu or gsplat by device,
    else torch_ref), and its pixels: "NAME" or "NAME:classic" is 3DGS (eps2d 0.3), "NAME:sharp" eps2d 0.1 and antialias.

    A Gaussian contributes alpha = min(0.99, opacity exp(-d^T C^-1 d / 2)) where that is at least 1/255; a pixel is
    finished before its transmittance would fall to 1e-4; colour is max(0, 0.5 + SH(view direction)). A Gaussian with a
    NaN or infinity in any input is culled and gets zero gradient. Differentiable by means, quats, scales, opacities,
    sh, features, background and by the first three rows of viewmat, each of their twelve numbers for itself.

    Raises ValueError for shapes that do not fit, UserError for a backend that is unknown or cannot run here.
    """
    name, pixels = split_backend(backend)
    eps2d, antialias = pixels.eps2d if eps2d is None else eps2d, pixels.antialias if antialias is None else antialias
    inputs = RenderInputs(
        means, quats, scales, opacities, sh, viewmat, K, int(width), int(height), -1, features, background,
        bool(depth_sq), float(depth_ref), float(near), float(eps2d), bool(antialias), bool(absgrad), False,
    )  # fmt: skip
    check(inputs, sh_degree, median_depth)
    return find_rasterizer(_auto(means) if name == "auto" else name)(inputs)


def rasterize_stored(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    sh: Tensor,
    sh_rest: Optional[Tensor],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: Optional[int] = None,
    background: Optional[Tensor] = None,
    features: Optional[Tensor] = None,
    backend: str = "auto",
    **options,
) -> RenderOutput:
    """``rasterize`` of parameters as they are stored: with exp(log_scales) [N, 3], sigmoid(opacity_logits) [N] and
    joined harmonics.

    sh_rest: None, or [N, B-1, 3] where ``sh`` [N, 1, 3] is the constant band alone. All else as in ``rasterize``,
    gradients are by what is given. The backend "cpu" reads the parameters themselves; for the others torch makes what
    they want.
    """
    if sh_rest is not None and sh_rest.shape[1] == 0:
        sh_rest = None
    name, pixels = split_backend(backend)
    name = _auto(means) if name == "auto" else name
    options = {
        "depth_sq": False,
        "depth_ref": 0.0,
        "near": 0.01,
        "eps2d": pixels.eps2d,
        "antialias": pixels.antialias,
        "absgrad": False,
        "median_depth": None,
        **options,
    }
    if name != "cpu":
        sh = sh if sh_rest is None else torch.cat([sh, sh_rest], 1)
        activated = (means, quats, log_scales.exp(), torch.sigmoid(opacity_logits), sh)
        options |= {"sh_degree": sh_degree, "background": background, "features": features, "backend": name}
        return rasterize(*activated, viewmat, K, width, height, **options)
    median = options.pop("median_depth")
    inputs = RenderInputs(
        means, quats, log_scales, opacity_logits, sh, viewmat, K, int(width), int(height), -1, features, background,
        median_depth=False, stored=True, sh_rest=sh_rest, **options,
    )  # fmt: skip
    check(inputs, sh_degree, median)
    return find_rasterizer(name)(inputs)
