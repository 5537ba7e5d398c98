"""What the pixels of one photograph say, to first order, of how it and what it shows should move.

A drawing of the Gaussians is held against the photograph. Where the picture has a slope, a motion of the point changes
it: each pixel is a measurement (Lucas and Kanade 1981), with
Cauchy's weights, so that what moved or is shaded otherwise counts little. What moves is the camera (a twist of six) or
a surface (a shift of three).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.data.views import TargetImage
from p2gs.motion.on_grey import drawing
from p2gs.ops.robust import CAUCHY_95, MEDIAN_SIGMA, weighted_median
from p2gs.types import Camera, GaussianTensors

SHOWN = 0.3  # alpha from which a pixel shows a surface; below, its depth means little
TOLD = 0.99  # of the slopes' squares: what is left out would make a motion surer by a hundredth
LEAST_SIGMA = 1e-3  # a quarter of a photograph's grey level: no drawing is nearer
TWIST, SHIFT = slice(0, 6), slice(6, 9)


@dataclass
class PictureSteps:
    """N pixels of one photograph. points [N, 3] that they show.  moves [N, 2, 9]: pixels by which they move with TWIST
    (the camera goes from V to V exp(twist)) and SHIFT, in the Gaussians' units.  H [N, 2, 2] and pull [N, 2]: normal
    matrix and right side of each pixel's own move, both over the errors' variance."""

    points: Tensor
    moves: Tensor
    H: Tensor
    pull: Tensor

    def _weighted(self) -> Tensor:
        """H times the moves, [N, 2, 9]."""
        return self.H[..., :1] * self.moves[:, :1] + self.H[..., 1:] * self.moves[:, 1:]

    def total(self) -> tuple[Tensor, Tensor]:
        """Normal matrix [9, 9] and right side [9] of all pixels together."""
        moves = self.moves.reshape(-1, self.moves.shape[2])
        return moves.T @ self._weighted().reshape(moves.shape), self.pull.reshape(-1) @ moves

    def totals(self, group: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """The same, [count, 9, 9] and [count, 9], of the pixels of each ``group`` [N], int64."""
        weighted, size = self._weighted(), self.moves.shape[2]
        normal = self.moves[:, 0, :, None] * weighted[:, 0, None] + self.moves[:, 1, :, None] * weighted[:, 1, None]
        right = (self.pull[..., None] * self.moves).sum(1)
        zeros = self.H.new_zeros(count, size, size)
        return zeros.index_add(0, group, normal), zeros[:, 0].index_add(0, group, right)


@torch.no_grad()
def picture_steps(g: GaussianTensors, shot: TargetImage, backend: str, part: Tensor | None = None) -> PictureSteps:
    """The pixels of ``shot``, a photograph before grey, that show a surface and have a slope, of these those of
    ``part`` [H, W] (0 or 1) where it is given; float64 on the CPU."""
    out = drawing(g, shot.camera, backend)
    drawn, photo, alpha = out.colour.cpu(), shot.image.cpu(), out.alpha.cpu()
    # a picture whose content moves by d changes by -slope d; the mean of both slopes converges twice as fast
    slope = -_gradient((drawn + photo) / 2)
    squares = slope.square().sum((2, 3)) * (alpha > SHOWN)
    shown = steepest(squares if part is None else squares * part.cpu())
    slope, off = slope[shown].double(), (photo - drawn)[shown].double()
    points, moves = _moves(shot.camera, shown, (out.depth.cpu() / alpha)[shown].double())
    weighted = slope * _weights(off, slope)[..., None]
    return PictureSteps(points, moves, weighted.transpose(1, 2) @ slope, (weighted * off[..., None]).sum(1))


def steepest(squares: Tensor) -> Tensor:
    """[H, W] bool: the fewest pixels that hold ``TOLD`` of the sum of the slopes' ``squares`` [H, W]; the others say
    nothing."""
    falling = squares[squares > 0].sort(descending=True).values
    if len(falling) == 0:
        return squares > 0
    total = falling.double().cumsum(0)
    return squares >= falling[torch.searchsorted(total, TOLD * total[-1])]


def _gradient(image: Tensor) -> Tensor:
    """[H, W, C] -> [H, W, C, 2] by x and y, central differences; 0 along the border."""
    out = image.new_zeros(*image.shape, 2)
    out[:, 1:-1, :, 0] = (image[:, 2:] - image[:, :-2]) / 2
    out[1:-1, :, :, 1] = (image[2:] - image[:-2]) / 2
    return out


def _moves(camera: Camera, shown: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Points [N, 3] that the pixels ``shown`` [H, W] show at ``depth`` [N], and ``PictureSteps.moves``."""
    V, K = camera.viewmat.double().cpu(), camera.K.double().cpu()
    y, x = (shown.nonzero().double() + 0.5).unbind(1)
    local = torch.stack([(x - K[0, 2]) / K[0, 0] * depth, (y - K[1, 2]) / K[1, 1] * depth, depth], 1)
    points = (local - V[:3, 3]) @ V[:3, :3]
    project = local.new_zeros(len(local), 2, 3)
    project[:, 0, 0], project[:, 1, 1] = K[0, 0] / depth, K[1, 1] / depth
    project[:, 0, 2], project[:, 1, 2] = -K[0, 0] * local[:, 0] / depth**2, -K[1, 1] * local[:, 1] / depth**2
    by_point = project @ V[:3, :3]
    turned = torch.linalg.cross(points[:, None].expand(-1, 2, -1), by_point)  # b . (w x p) = (p x b) . w
    return points, torch.cat([turned, by_point, by_point], 2)


def _weights(off: Tensor, slope: Tensor) -> Tensor:
    """[N, 3]: Cauchy's weights over the variance, which is the median error's where there is a slope to measure by."""
    sigma = MEDIAN_SIGMA * weighted_median(off.abs(), slope.square().sum(2)) + LEAST_SIGMA
    return 1 / (1 + (off / (CAUCHY_95 * sigma)) ** 2) / sigma**2
