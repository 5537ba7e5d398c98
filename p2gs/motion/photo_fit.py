"""One rigid motion between two states: each state's Gaussians, frozen, in the other's photographs of what did not move.

Where a state's Gaussians and the other's, drawn from one camera, lie at one depth, nothing moved; only there the
pictures are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from p2gs.data.views import TargetImage, TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.motion.on_grey import drawing, photograph
from p2gs.motion.picture_steps import TWIST, picture_steps
from p2gs.ops import se3
from p2gs.ops.least_squares import least_squares
from p2gs.ops.ssim import l1_ssim
from p2gs.types import Camera, GaussianTensors, RenderOutput

STRUCTURE, COLOUR = 0.8, 0.0  # weight of SSIM where a motion is judged, which no exposure changes, and where a gain is
ROUNDS = 10  # of Gauss and Newton; each leaves a third to a half of what is left
SETTLED = 2e-5  # internal units: a two-hundredth of a pixel of 400
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
        return drawing(self.gaussians, _at(camera, self.viewmat(camera, transform).to(camera.viewmat)), backend)


def unmoved(side: PhotoSide, camera: Camera, transform: Tensor, tolerance: float, backend: str) -> Tensor:
    """[H, W] 0 or 1: both states' surfaces lie at one depth to within ``tolerance`` there, or both are empty."""
    with torch.no_grad():
        viewmat = side.viewmat(camera, transform).to(camera.viewmat)
        drawn = [_depth(side.gaussians, _at(camera, viewmat), backend), _depth(side.other, camera, backend)]
    (a, z0), (b, z1) = drawn
    same = torch.where((a > 0.5) & (b > 0.5), (z0 - z1).abs() < tolerance, (a < 0.5) & (b < 0.5))
    return 1 - F.max_pool2d((~same).float()[None, None], 2 * EDGE + 1, 1, EDGE)[0, 0]


@torch.no_grad()
def fit_photographs(
    sides: list[PhotoSide], transform: Tensor, picks: list[list[int]], size: int, *, backend: str = "auto"
) -> Tensor:
    """The motion end -> start [4, 4] float64, refined from ``transform`` by Gauss and Newton on all pixels; coordinates
    are internal (the object is 2 in diagonal).

    picks: which photographs of each side.  size: of the pictures, one of the views' levels.  What moved is not left
    out, for which pixels did is told by the motion that is sought: its errors are large, and weigh little.
    """
    transform = transform.double().clone()
    for _ in range(ROUNDS):
        A, b = torch.zeros(6, 6).double(), torch.zeros(6).double()
        for side, mine in zip(sides, picks, strict=True):
            # the camera's twist by one of the motion: V T^-1 exp(-x) = V (exp(x) T)^-1 and V T exp(Ad(T)^-1 x)
            by_motion = -torch.eye(6).double() if side.back else se3.adjoint(se3.inverse(transform))
            for index in mine:
                shot = photograph(side.views, index, size, side.gaussians.means.device)
                seen = _at(shot.camera, side.viewmat(shot.camera, transform).to(shot.camera.viewmat))
                normal, right = picture_steps(side.gaussians, replace(shot, camera=seen), backend).total()
                A += by_motion.T @ normal[TWIST, TWIST] @ by_motion
                b += right[TWIST] @ by_motion
        step = least_squares(A, b)
        transform = se3.exp(step) @ transform
        if float(step.norm()) < SETTLED:
            break
    return transform


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
