"""One rigid motion between two states: each state's Gaussians, frozen, in the other's photographs of what did not move.

Where a state's Gaussians and the other's, drawn from one camera, lie at one depth, nothing moved; only there the
pictures are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from p2gs.data.views import TargetImage, TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.ops import se3
from p2gs.ops.decay import exponential
from p2gs.ops.ssim import l1_ssim
from p2gs.types import Camera, GaussianTensors, RenderOutput

GREY = 0.5  # what stands behind the object in every picture
STRUCTURE, COLOUR = 0.8, 0.0  # weight of SSIM where a motion is judged, which no exposure changes, and where a gain is
EDGE = 2  # pixels beside what moved that are left out with it: the blur of Gaussians and of SSIM's window


@dataclass
class PhotoSide:
    """One state's Gaussians, and the other state's with its photographs.  back: the Gaussians are the start's, so that
    the end's cameras go to them by the inverse of the motion end -> start."""

    gaussians: GaussianTensors
    other: GaussianTensors
    views: TrainingViews
    back: bool

    def viewmat(self, camera: Camera, transform: Tensor) -> Tensor:
        """[4, 4] double: the photograph's camera among the Gaussians; transform [4, 4] end -> start."""
        return camera.viewmat.double().cpu() @ (se3.inverse(transform) if self.back else transform)

    def draw(self, camera: Camera, transform: Tensor, backend: str) -> RenderOutput:
        """The Gaussians as the photograph's camera sees them, before grey; differentiable by ``transform``."""
        seen = _at(camera, self.viewmat(camera, transform).to(camera.viewmat))
        return render_gaussians(
            self.gaussians, seen, torch.full((3,), GREY, device=camera.viewmat.device), backend=backend
        )


def unmoved(side: PhotoSide, camera: Camera, transform: Tensor, tolerance: float, backend: str) -> Tensor:
    """[H, W] 0 or 1: both states' surfaces lie at one depth to within ``tolerance`` there, or both are empty."""
    with torch.no_grad():
        viewmat = side.viewmat(camera, transform).to(camera.viewmat)
        drawn = [_depth(side.gaussians, _at(camera, viewmat), backend), _depth(side.other, camera, backend)]
    (a, z0), (b, z1) = drawn
    same = torch.where((a > 0.5) & (b > 0.5), (z0 - z1).abs() < tolerance, (a < 0.5) & (b < 0.5))
    return 1 - F.max_pool2d((~same).float()[None, None], 2 * EDGE + 1, 1, EDGE)[0, 0]


def fit_photographs(
    sides: list[PhotoSide],
    transform: Tensor,
    picks: list[list[int]],
    steps: int,
    size: int,
    tolerance: float,
    *,
    rate: float = 1e-3,
    backend: str = "auto",
) -> Tensor:
    """The motion end -> start [4, 4] float64, refined from ``transform``; coordinates are internal (the object is 2 in
    diagonal).

    picks: which photographs of each side.  steps: per side, with Adam on one twist about the origin, the box's centre;
    rate: of the first, in internal units, falling to a hundredth.  size: of the pictures, one of the views' levels.
    tolerance: as in ``unmoved``.
    """
    transform = transform.double().clone()
    first, second = torch.zeros(6).double(), torch.zeros(6).double()
    kept: dict[tuple[int, int], tuple[TargetImage, Tensor]] = {}
    total = steps * len(sides)
    for step in range(total):
        turn, number = step % len(sides), step // len(sides)
        side, index = sides[turn], picks[turn][number % len(picks[turn])]
        if (turn, index) not in kept:
            shot = photograph(side.views, index, size, side.gaussians.means.device)
            kept[turn, index] = shot, unmoved(side, shot.camera, transform, tolerance, backend)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        loss = compare(side, *kept[turn, index], se3.exp(twist) @ transform, backend)
        loss.backward()
        assert twist.grad is not None
        first = 0.9 * first + 0.1 * twist.grad
        second = 0.99 * second + 0.01 * twist.grad**2
        direction = first / (1 - 0.9 ** (step + 1)) / ((second / (1 - 0.99 ** (step + 1))).sqrt() + 1e-12)
        transform = se3.exp(-rate * exponential(1.0, 0.01, step / total) * direction) @ transform
    return transform


def photograph(views: TrainingViews, index: int, size: int, device) -> TargetImage:
    """A photograph before grey, on ``device``."""
    shot = views.get(index, views.levels.index(size), torch.full((3,), GREY))
    return TargetImage(shot.image.to(device), shot.alpha.to(device), None, shot.key, shot.camera.to(device))


def compare(
    side: PhotoSide, shot: TargetImage, weight: Tensor, transform: Tensor, backend: str, ssim_lambda: float = STRUCTURE
) -> Tensor:
    """Image loss where ``weight`` [H, W] is 1; a scalar, differentiable by ``transform``."""
    colour = shot.image + weight[..., None] * (side.draw(shot.camera, transform, backend).colour - shot.image)
    # per compared pixel: a photograph of which little can be compared counts as much as another
    return l1_ssim(colour, shot.image, ssim_lambda) / weight.mean().clamp_min(0.05)


def _at(camera: Camera, viewmat: Tensor) -> Camera:
    return Camera(viewmat, camera.K, camera.width, camera.height)


def _depth(g: GaussianTensors, camera: Camera, backend: str) -> tuple[Tensor, Tensor]:
    out = render_gaussians(g, camera, None, sh_degree=0, backend=backend)
    return out.alpha, out.expected_depth if out.median_depth is None else out.median_depth
