"""Two explanations held against each other where their pictures differ, however small that place is."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.motion.joint_confidence import measuring_level
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops.ssim import gaussian_window, ssim_map
from p2gs.types import GaussianTensors

LOOKS = 16  # photographs of a state, spread over all
REACH = len(gaussian_window()) // 2  # pixels that SSIM looks around itself


@torch.no_grad()
def image_losses(
    explanations: list[tuple[GaussianTensors, Tensor, Tensor]],
    views: TrainingViews,
    ssim_lambda: float,
    shown,
    backend: str,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Image loss of a state's Gaussians in the other state's photographs (``measuring_level``) under each of two
    explanations, summed over pixels, each weighted by how far the two pictures differ there (mean of channels) and by
    ``shown`` (as in ``Side``): [2] float64.

    explanations: the state's Gaussians as the photographs' light has them, labels [N] (-1 leaves a Gaussian out) and
    motions [K, 4, 4] from this state to the photographs'.
    """
    bodies = [MovedGaussians(g, labels, device) for g, labels, _ in explanations]
    moved = [body.moved(T) for body, (_, _, T) in zip(bodies, explanations, strict=True)]
    size, background = views.levels.index(measuring_level(views)), torch.full((3,), 0.5)
    total = torch.zeros(2, dtype=torch.float64)
    for index in views.spread(LOOKS):
        shot = views.get(index, size, background)
        drawn = [
            body.render(*at, shot.camera, background, backend).colour for body, at in zip(bodies, moved, strict=True)
        ]
        weight = (drawn[0] - drawn[1]).abs().mean(-1)
        weight = weight if shown is None else weight * shown(index, size, shot.camera)
        target = shot.image.to(weight.device)
        total += torch.stack([weighted_loss(d, target, weight, ssim_lambda) for d in drawn]).cpu()
    return total


def weighted_loss(picture: Tensor, target: Tensor, weight: Tensor, ssim_lambda: float) -> Tensor:
    """Sum over pixels of ``weight`` [H, W] times what ``l1_ssim`` of two images [H, W, 3] is the mean of; float64."""
    rows, columns = (weight.amax(d).nonzero()[:, 0] for d in (1, 0))
    if not len(rows):
        return torch.zeros((), dtype=torch.float64, device=weight.device)
    window = tuple(slice(max(int(at[0]) - REACH, 0), int(at[-1]) + REACH + 1) for at in (rows, columns))
    picture, target, weight = picture[window], target[window], weight[window]
    apart = (1 - ssim_lambda) * (picture - target).abs() + ssim_lambda * (1 - ssim_map(picture, target))
    return (weight * apart.mean(-1)).double().sum()
