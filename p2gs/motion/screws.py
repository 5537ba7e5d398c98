"""SE(3) per part as screws xi, and how soft part assignments move Gaussians (paper appendix, part assignment)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from p2gs.ops import blend, se3, so3
from p2gs.types import GaussianTensors


class PartScrews(nn.Module):
    """xi [K-1, 6]: full start -> end screws of the movable parts; slot 0 is the static base. Stored in float32."""

    def __init__(self, transforms: Tensor):
        super().__init__()
        self.xi = nn.Parameter(se3.log(transforms.double()).float())

    def transforms(self) -> Tensor:
        """[K, 4, 4], identity in slot 0."""
        return blend.part_motions(self.xi)

    def at(self, span: Tensor) -> Tensor:
        """Motions exp(span_k xi_k) of slots 0..K-1, [K, 4, 4]; span [K] (state time minus canonical time)."""
        return blend.part_motions(self.twists(span))

    def twists(self, span: Tensor) -> Tensor:
        """span_k xi_k of the movable parts, [K-1, 6]; span [K] as in ``at``."""
        return self.xi * span[1:, None].to(self.xi)


def initial_screws(kind: str, parts: int, generator: torch.Generator) -> Tensor:
    """Start transforms [K-1, 4, 4]: "identity" (with noise of 0.01) or "random" (paper section 4.3: rotations at
    random)."""
    noise = torch.randn(parts - 1, 6, generator=generator)
    if kind == "identity":
        return se3.exp(1e-2 * noise)
    T = torch.eye(4).repeat(parts - 1, 1, 1)
    T[:, :3, :3] = so3.quat_to_matrix(so3.quat_normalize(torch.randn(parts - 1, 4, generator=generator)))
    T[:, :3, 3] = 0.1 * noise[:, 3:]
    return T


def blend_move(g: GaussianTensors, probs: Tensor, twists: Tensor) -> GaussianTensors:
    """The Gaussians where their soft assignment probs [N, K] puts them under the motions of twists [K-1, 6]; see
    ``ops.blend``."""
    means, quats = blend.blend_move(g.means, g.quats, probs, twists)
    return g.placed(means, quats)
