"""Small errors of single photographs, found beside the Gaussians: each one's exposure and white balance, its camera,
and how wide its mask is (``mask_fit``).

A camera goes from V to V exp(xi), xi a twist in world coordinates about the origin (the middle of the object's box):
all of them moved alike would be the object moved, so the mean of xi is held at zero. So is that of the gains'
logarithms: a colour cast of all photographs is the object's colour. What is on is decided by the photographs
themselves: each is halved like a chessboard, and what is fitted to one half must explain the other half better.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Iterator, Literal, Sequence

import torch
from torch import Tensor, nn

from p2gs.data.exposure import brightened, median_gain
from p2gs.data.views import TargetImage, TrainingViews
from p2gs.gaussians.handover import ViewCorrections
from p2gs.models.picture_bundle import adjust_pictures
from p2gs.models.registered import correct_views
from p2gs.models.trial import Trial, halves, trial
from p2gs.motion.on_grey import drawing, photograph
from p2gs.motion.photo_fit import STRUCTURE
from p2gs.motion.picture_steps import TWIST, picture_steps
from p2gs.ops import se3
from p2gs.ops.ssim import l1_ssim
from p2gs.types import Camera, GaussianTensors, View

# of a camera that is looked at by itself, internal units (the object is 2): twice what structure from motion leaves
TWIST_SIGMA = 0.003
LOOKS = 3  # of Gauss and Newton at half a photograph; each leaves a third to a half of what is left


@dataclass
class ViewFitConfig:
    """What may be wrong with single photographs.

    gains, cameras, masks: "auto" (photographs decide, once) or "never".  at: share of the phase that is done when they
    decide on cameras.  measured: shares at which gains are measured; at the first, with the cameras put right, they
    decide on them.  bundled: shares at which masks are measured, the first time to decide on them, and then all cameras
    are put right at once, by all pixels (``picture_bundle``); between them each follows the model by its gradient.  All
    of it looks at pictures of the size that is trained on.  rate: of the cameras' Adam in internal units, falling to a
    hundredth.  least: share by which the other halves' errors must fall (of masks: clean scenes at most 0.8 %, masks
    off by up to two pixels 11.8 to 16.5 %); least_cameras: the same of cameras, which explain a coarse model's errors
    too: of clean scenes 3 to 4.3 %, of cameras off by a tenth of a degree 17.6 to 34 %.
    """

    gains: Literal["auto", "never"] = "never"
    cameras: Literal["auto", "never"] = "never"
    masks: Literal["auto", "never"] = "never"
    at: float = 0.12
    measured: list[float] = field(default_factory=lambda: [0.2, 0.5])
    bundled: list[float] = field(default_factory=lambda: [0.2, 0.4, 0.6, 0.8])
    rate: float = 1e-3
    least: float = 0.02
    least_cameras: float = 0.08


def turned(camera: Camera, twist: Tensor) -> Camera:
    """The camera V exp(twist [6]); differentiable by the twist."""
    return replace(camera, viewmat=(camera.viewmat.double().cpu() @ se3.exp(twist.cpu())).to(camera.viewmat))


class RowAdam:
    """Adam for a table of rows that are looked at one at a time (Kingma and Ba 2015, arXiv:1412.6980): a row's moments
    move with it alone.

    table [V, D]: changed in place.  moments [V, 2 D + 1]: both, and the steps taken.
    """

    def __init__(self, table: Tensor, moments: Tensor):
        self.table, self.moments = table, moments

    def step(self, row: int, gradient: Tensor, rate: float) -> None:
        d = len(gradient)
        m = self.moments[row]
        m[:d] = 0.9 * m[:d] + 0.1 * gradient
        m[d:-1] = 0.99 * m[d:-1] + 0.01 * gradient**2
        m[-1] += 1
        self.table[row] -= rate * (m[:d] / (1 - 0.9 ** m[-1])) / ((m[d:-1] / (1 - 0.99 ** m[-1])).sqrt() + 1e-12)


class ViewErrors(nn.Module):
    """The errors of V photographs of one state: buffers, so that a checkpoint has them.

    twists [V, 6], log_gains [V, 3] and growths [V], float64; their means are zero.  on, decided [3] bool: of gains,
    cameras and masks.
    """

    twists: Tensor
    moments: Tensor
    log_gains: Tensor
    growths: Tensor
    on: Tensor
    decided: Tensor

    def __init__(self, count: int):
        super().__init__()
        self.register_buffer("twists", torch.zeros(count, 6, dtype=torch.float64))
        self.register_buffer("moments", torch.zeros(count, 13, dtype=torch.float64))
        self.register_buffer("log_gains", torch.zeros(count, 3, dtype=torch.float64))
        self.register_buffer("growths", torch.zeros(count, dtype=torch.float64))
        self.register_buffer("on", torch.zeros(3, dtype=torch.bool))
        self.register_buffer("decided", torch.zeros(3, dtype=torch.bool))
        self._looked_at: tuple[int, Tensor] | None = None

    def camera(self, index: int, camera: Camera) -> Camera:
        """The photograph's camera, with a gradient by its twist that ``learn`` takes up; the very camera where cameras
        are off."""
        self._looked_at = None
        if not bool(self.on[1]):
            return camera
        twist = self.twists[index].clone().requires_grad_()
        self._looked_at = index, twist
        return turned(camera, twist)

    def found(self, index: int, camera: Camera) -> Camera:
        """The photograph's camera as it is known by now, without gradient."""
        return turned(camera, self.twists[index]) if bool(self.on[1]) else camera

    def shots(self, views: TrainingViews, size: int, device) -> Iterator[TargetImage]:
        """The photographs before grey, ``size`` pixels long, with the cameras known by now."""
        photos = (photograph(views, i, size, device) for i in range(len(views)))
        return (replace(shot, camera=self.found(i, shot.camera)) for i, shot in enumerate(photos))

    @torch.no_grad()
    def adjust(self, g: GaussianTensors, views: TrainingViews, size: int, backend: str) -> None:
        """All cameras at once, by bundle adjustment of the pictures of ``size`` pixels."""
        self.twists.copy_(adjust_pictures(g, self.shots(views, size, g.means.device), self.twists, backend))

    def learn(self, rate: float) -> None:
        """One step of the camera that was looked at last, after the backward pass."""
        index, twist = self._looked_at or (0, None)
        if twist is None or twist.grad is None:
            return
        RowAdam(self.twists, self.moments).step(index, twist.grad, rate)
        self.twists -= self.twists.mean(0)

    def views(self, shots: Sequence[View]) -> list[View]:
        """The photographs without their gains and with their masks put right, their cameras as they were."""
        still = torch.eye(4, dtype=torch.float64).expand(len(shots), 4, 4)
        return correct_views(shots, ViewCorrections(still, self.log_gains.cpu(), self.growths.cpu()))

    def handed_over(self) -> ViewCorrections | None:
        """What later stages need; None where all is off."""
        if not bool(self.on.any()):
            return None
        return ViewCorrections(se3.exp(self.twists.cpu()), self.log_gains.float().cpu(), self.growths.cpu())


@torch.no_grad()
def measure_gains(g: GaussianTensors, views: TrainingViews, errors: ViewErrors, size: int, backend: str) -> Tensor:
    """Natural logarithm [V, 3], float64, of how much brighter each photograph is than its rendering, mean zero; 0 where
    none can tell.  errors: what is known of the cameras."""
    found = torch.zeros_like(errors.log_gains)
    for index, shot in enumerate(errors.shots(views, size, g.means.device)):
        out = drawing(g, shot.camera, backend)
        gain = median_gain(shot.image, out.colour, (shot.alpha > 0.99) & (out.alpha > 0.99))
        found[index] = 0 if gain is None else gain.double()
    return found - found.mean(0)


@torch.no_grad()
def try_gains(g: GaussianTensors, views: TrainingViews, errors: ViewErrors, size: int, backend: str) -> Trial:
    """Errors of half photographs without and with the gain that their other half tells, as it differs from the
    photographs' mean.  errors: what is known of the cameras."""
    drawn = []
    for shot in errors.shots(views, size, g.means.device):
        out = drawing(g, shot.camera, backend)
        inside = (shot.alpha > 0.99) & (out.alpha > 0.99)
        both = [half.to(g.means) for half in halves(*inside.shape)]
        gains = [median_gain(shot.image, out.colour, inside & (half > 0)) for half in both]
        if all(gain is not None for gain in gains):
            drawn.append((shot.image, out.colour, inside, both, gains))
    if len(drawn) < 2:
        return trial(torch.ones(1), torch.ones(1))
    mean = torch.stack([torch.stack(d[-1]).mean(0) for d in drawn]).mean(0)
    off = torch.zeros(2, len(drawn))
    for k, (photo, colour, inside, both, gains) in enumerate(drawn):
        for half, gain in zip(both, gains[::-1], strict=True):
            seen = inside & (half > 0)
            off[0, k] += (photo[seen] - colour[seen]).abs().mean().cpu()
            off[1, k] += (photo[seen] - brightened(colour[seen], gain - mean)).abs().mean().cpu()
    return trial(*off)


@torch.no_grad()
def try_cameras(g: GaussianTensors, views: TrainingViews, size: int, backend: str) -> Trial:
    """Errors of half photographs without and with the camera that fits their other half."""
    errors = torch.zeros(2, len(views))
    for index in range(len(views)):
        shot = photograph(views, index, size, g.means.device)
        both = [half.to(g.means) for half in halves(*shot.alpha.shape)]
        for fitted, judged in zip(both, both[::-1], strict=True):
            for k, camera in enumerate((shot.camera, fit_camera(g, shot, fitted, backend))):
                errors[k, index] += half_error(g, replace(shot, camera=camera), judged, backend).cpu()
    return trial(*errors)


def fit_camera(g: GaussianTensors, shot: TargetImage, half: Tensor, backend: str) -> Camera:
    """The camera with which a photograph explains ``half`` [H, W] of it best; the Gaussians stay."""
    for _ in range(LOOKS):
        normal, right = picture_steps(g, shot, backend, half).total()
        known = normal[TWIST, TWIST] + torch.eye(6).double() / TWIST_SIGMA**2
        shot = replace(shot, camera=turned(shot.camera, torch.linalg.solve(known, right[TWIST])))
    return shot.camera


def half_error(g: GaussianTensors, shot: TargetImage, half: Tensor, backend: str) -> Tensor:
    """Image loss, a scalar, over the pixels of ``half`` [H, W]."""
    out = drawing(g, shot.camera, backend)
    return l1_ssim(shot.image + half[..., None] * (out.colour - shot.image), shot.image, STRUCTURE)
