"""Losses on the rendered picture and on opacity: ``render``, ``alpha``, ``opacity``."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from p2gs.losses.base import Loss, LossInputs, register_loss
from p2gs.ops.pixels import clamped_cross_entropy
from p2gs.ops.ssim import l1_ssim


@register_loss("render")
class Render(Loss):
    """(1 - l) |I - I*|_1 + l (1 - SSIM(I, I*)), averaged over pixels and channels (paper eq. render_loss).

    ssim_lambda: l. The paper does not state it; 0.2 is 3DGS's. Refining screws wants it higher (0.8): shading differs
    between states.
    """

    needs = frozenset()
    kind = "image"
    ssim_lambda: float = 0.2

    def compute(self, inputs: LossInputs) -> Tensor | None:
        if inputs.render is None or inputs.target is None:
            return None
        return l1_ssim(
            inputs.render.colour, inputs.target.image, self.ssim_lambda, cache=inputs.cache, key=inputs.target.key
        )


@register_loss("alpha")
class Alpha(Loss):
    """Binary cross-entropy between rendered and photographed alpha, mean over pixels. Not in the paper.

    eps: rendered alpha is clamped to [eps, 1 - eps], which bounds the gradient of a pixel.
    """

    needs = frozenset()
    kind = "image"
    weight: float = 0.05
    eps: float = 1e-4

    def compute(self, inputs: LossInputs) -> Tensor | None:
        if inputs.render is None or inputs.target is None:
            return None
        return clamped_cross_entropy(inputs.render.alpha, inputs.target.alpha, self.eps)


@register_loss("opacity")
class Opacity(Loss):
    """Binary cross-entropy between each opacity and whether it is above one half: pushes Gaussians to be solid or gone.

    Mean over Gaussians. ArtGS's regulariser of the single states (weight 0.1 there); not in the paper.
    """

    needs = frozenset()
    kind = "prior"
    weight: float = 0.1

    def compute(self, inputs: LossInputs) -> Tensor:
        logits = inputs.gaussians.opacity_logits
        return F.binary_cross_entropy_with_logits(logits, (logits.detach() > 0).to(logits.dtype))
