"""Random Gaussians in front of a camera, and the means to compare two rasterizers on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import torch
from torch import Tensor

from p2gs.render import rasterize
from p2gs.types import RenderOutput

OUTPUTS = ("colour", "alpha", "depth", "depth_sq", "features")
INPUTS = ("means", "quats", "scales", "opacities", "sh", "features", "background")


@dataclass
class World:
    """Arguments of ``rasterize``: float64 tensors whose values are float32 numbers, so that both precisions see the
    same scene."""

    tensors: dict[str, Optional[Tensor]]
    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    def render(
        self, backend: str, dtype: torch.dtype, grad: bool = True, **options
    ) -> tuple[RenderOutput, dict[str, Tensor]]:
        leaves = {k: t.to(dtype).clone().requires_grad_(grad) for k, t in self.tensors.items() if t is not None}
        out = rasterize(
            viewmat=self.viewmat, K=self.K, width=self.width, height=self.height, backend=backend, **leaves, **options
        )
        return out, leaves


def world(
    n: int = 300,
    width: int = 70,
    height: int = 50,
    *,
    bases: int = 16,
    features: int = 0,
    background: str = "none",
    opacity: tuple[float, float] = (0.0, 1.0),
    scale: tuple[float, float] = (0.01, 0.13),
    spread: float = 0.6,
    seed: int = 0,
) -> World:
    """background: none, constant or image. fx != fy and the principal point is off centre, as in a crop."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64).float().double()

    def uniform(lo, hi, *shape):
        return (lo + (hi - lo) * torch.rand(*shape, generator=g, dtype=torch.float64)).float().double()

    tensors = {
        "means": (normal(n, 3) * spread).float().double(),
        "quats": normal(n, 4),
        "scales": uniform(*scale, n, 3),
        "opacities": uniform(*opacity, n),
        "sh": (normal(n, bases, 3) * 0.3).float().double(),
        "features": normal(n, features) if features else None,
        "background": {"none": None, "constant": uniform(0, 1, 3), "image": uniform(0, 1, height, width, 3)}[
            background
        ],
    }
    viewmat = torch.eye(4)
    axis = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0]
    viewmat[:3, :3] = (axis * torch.linalg.det(axis)).float()
    viewmat[2, 3] = 3.0
    K = torch.tensor([[1.1 * width, 0, 0.45 * width], [0, 1.2 * width, 0.53 * height], [0, 0, 1]])
    return World(tensors, viewmat, K, width, height)


def backward(
    out: RenderOutput, leaves: dict[str, Tensor], seed: int = 1, outputs: tuple[str, ...] = OUTPUTS
) -> dict[str, Tensor]:
    """Gradients of a random linear function of the named outputs."""
    g = torch.Generator().manual_seed(seed)
    loss = 0.0
    for name in outputs:
        image = getattr(out, name)
        if image is not None:
            loss = loss + (image * torch.randn(image.shape, generator=g, dtype=torch.float64).to(image)).sum()
    loss.backward()
    return {k: torch.zeros_like(t) if t.grad is None else t.grad for k, t in leaves.items()}


def relative_error(got: Tensor, want: Tensor) -> float:
    """|got - want| / |want|, L2 over the whole tensor."""
    got, want = got.detach().double(), want.detach().double()
    return float((got - want).norm() / want.norm().clamp_min(1e-12))


def assert_same_as_reference(w: World, tolerance: float = 1e-5, outputs: tuple[str, ...] = OUTPUTS, **options) -> None:
    """Images and gradients of the native rasterizer within ``tolerance`` (L2, relative) of the reference in float64."""
    want, want_leaves = w.render("torch_ref", torch.float64, **options)
    got, got_leaves = w.render("cpu", torch.float32, **options)
    for name in OUTPUTS:
        image = getattr(want, name)
        assert (image is None) == (getattr(got, name) is None), name
        if image is not None:
            assert image.shape == getattr(got, name).shape
            assert relative_error(getattr(got, name), image) < tolerance, name
    want_grads, got_grads = (backward(o, x, outputs=outputs) for o, x in ((want, want_leaves), (got, got_leaves)))
    for name, gradient in want_grads.items():
        assert gradient.norm() > 0, f"{name}: the test compares nothing"
        assert relative_error(got_grads[name], gradient) < tolerance, name
    if options.get("absgrad"):
        assert want.means2d_abs_grad.norm() > 0
        assert relative_error(got.means2d_abs_grad, want.means2d_abs_grad) < tolerance
