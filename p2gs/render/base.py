"""What every rasterizer gets, and the registry they are found in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Optional

import torch
from torch import Tensor

from p2gs.ops.sh import degree_of
from p2gs.registry import Registry, suggest
from p2gs.types import RenderOutput, UserError

ALPHA_MIN = 1 / 255  # a Gaussian fainter than this at a pixel is skipped there
ALPHA_MAX = 0.99  # and none is more opaque
T_STOP = 1e-4  # a pixel is finished before its transmittance would fall to this
FAR = 1e10
MAX_FEATURES = 16


@dataclass(frozen=True)
class Pixels:
    """What a pixel makes of a Gaussian (see ``p2gs.render.rasterize``)."""

    eps2d: float
    antialias: bool


# "classic": every 3DGS viewer's. "sharp": a surface seen edge-on is as thin as it is. Gaussians are for the pixels they
# were fitted with.
PIXELS = {"classic": Pixels(0.3, False), "sharp": Pixels(0.1, True)}


def split_backend(backend: str) -> tuple[str, Pixels]:
    """A backend's name and its pixels: "cpu:sharp" -> ("cpu", PIXELS["sharp"]), "cpu" -> ("cpu", PIXELS["classic"]).
    Raises UserError."""
    name, _, pixels = backend.partition(":")
    if pixels and pixels not in PIXELS:
        raise UserError(f"rasterizer '{backend}': unknown pixels '{pixels}'{suggest(pixels, PIXELS)}")
    return name, PIXELS[pixels or "classic"]


def device_of(backend: str, tensor: Tensor) -> torch.device:
    """Where a backend draws what ``tensor`` is of: gsplat on the GPU, if there is one, others where it is."""
    on_gpu = split_backend(backend)[0] == "gsplat" and torch.cuda.is_available()
    return torch.device("cuda") if on_gpu else tensor.device


def with_pixels(backend: str, pixels: str) -> str:
    """The same backend with the pixels named."""
    return f"{backend.partition(':')[0]}:{pixels}"


@dataclass
class RenderInputs:
    """Checked arguments of ``p2gs.render.rasterize`` (see there); ``sh_degree`` is a number, ``median_depth``
    decided."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    sh_degree: int
    features: Optional[Tensor]
    background: Optional[Tensor]
    depth_sq: bool
    depth_ref: float
    near: float
    eps2d: float
    antialias: bool
    absgrad: bool
    median_depth: bool
    # ``rasterize_stored``, for the backend "cpu" alone: scales are logarithms and opacities logits, ``sh`` is the
    # constant band
    stored: bool = False
    sh_rest: Optional[Tensor] = None


Rasterizer = Callable[[RenderInputs], RenderOutput]
RASTERIZERS: Registry[Rasterizer] = Registry("rasterizer")


def _expect(name: str, tensor: Tensor, *shape: Optional[int]) -> None:
    if tensor.dim() != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, tensor.shape, strict=True)
    ):
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"rasterize: {name} must have shape [{wanted}], got {list(tensor.shape)}")


def check(a: RenderInputs, sh_degree: Optional[int], median_depth: Optional[bool]) -> RenderInputs:
    """The same inputs with their shapes verified and the open choices made. Raises ValueError in one sentence."""
    _expect("means", a.means, None, 3)
    n = a.means.shape[0]
    _expect("quats", a.quats, n, 4)
    _expect("scales", a.scales, n, 3)
    _expect("opacities", a.opacities, n)
    _expect("sh", a.sh, n, None, 3)
    _expect("viewmat", a.viewmat, 4, 4)
    _expect("K", a.K, 3, 3)
    if a.width < 1 or a.height < 1:
        raise ValueError(f"rasterize: width and height must be at least 1, got {a.width} x {a.height}")
    bases = a.sh.shape[1]
    if a.sh_rest is not None:
        _expect("sh_rest", a.sh_rest, n, None, 3)
        bases += a.sh_rest.shape[1]
    available = degree_of(bases)
    wanted = a.sh_degree = available if sh_degree is None else int(sh_degree)
    if not 0 <= wanted <= available:
        raise ValueError(f"rasterize: sh_degree {wanted} needs {(wanted + 1) ** 2} coefficients, sh has {bases}")
    if a.features is not None:
        _expect("features", a.features, n, None)
        if not 1 <= a.features.shape[1] <= MAX_FEATURES:
            raise ValueError(f"rasterize: features must have 1 to {MAX_FEATURES} channels, got {a.features.shape[1]}")
    if a.background is not None and a.background.dim() == 3:
        _expect("background", a.background, a.height, a.width, 3)
    elif a.background is not None:
        _expect("background", a.background, 3)
    others = (a.quats, a.scales, a.opacities, a.sh, a.sh_rest, a.features, a.background)
    for t in others:
        if t is not None and t.device != a.means.device:
            raise ValueError(f"rasterize: all tensors must be on one device, got {a.means.device} and {t.device}")
    if median_depth is None:
        recorded = torch.is_grad_enabled() and any(
            t is not None and t.requires_grad for t in (a.means, a.viewmat, *others)
        )
        a.median_depth = not recorded
    else:
        a.median_depth = bool(median_depth)
    return a
