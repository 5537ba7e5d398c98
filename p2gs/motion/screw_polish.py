"""Refine rigid part motions by rendering: frozen Gaussians of one state, moved, against the other state's photographs.

Optimising screws and Gaussians together drags the screws (wrongly labelled Gaussians follow); with Gaussians frozen the
same images give the motion to a few hundredths of a degree.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Callable, Sequence

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews, view_index
from p2gs.motion.light import FEWEST
from p2gs.motion.motion_steps import MotionSteps
from p2gs.motion.part_pull import by_inverse, part_pulls
from p2gs.ops import se3, so3
from p2gs.ops.carry import Parts, carry
from p2gs.ops.ssim import l1_ssim
from p2gs.render import rasterize
from p2gs.types import Camera, GaussianTensors


@dataclass
class PolishConfig:
    """Options of the photometric screw refinement.

    steps: per direction (0 = off).  levels, level_starts: image sizes over the steps.  rate: step size at the start in
    internal units of displacement at the part's rim; falls to a hundredth.  ssim_lambda: weight of SSIM against L1;
    high, because shading differs between states while structure does not.  min_margin: Gaussians whose label is less
    clear than this (internal units) are left out.  free_static, free_moving: tolerances (internal units) for what of
    the base and of moving parts lies on a surface of the other state; other_colour: mean difference of channels (0..1)
    by which it is another's surface. Only what both states show has a say (``motion/agreement.py``; free_static or
    free_moving 0: all has).  front: a view has no say on a surface that its own state's cameras saw from directions
    whose cosine with the view's is below this (-1: all views have).
    """

    steps: int = 200
    levels: list[int] = field(default_factory=lambda: [200, 400])
    level_starts: list[float] = field(default_factory=lambda: [0.0, 0.4])
    rate: float = 4e-3
    ssim_lambda: float = 0.8
    min_margin: float = 0.01
    min_opacity: float = 0.05
    free_static: float = 0.02
    free_moving: float = 0.05
    other_colour: float = 0.2
    front: float = 0.2

    def level(self, fraction: float) -> int:
        """Image size when this share of the steps is done."""
        return [size for size, start in zip(self.levels, self.level_starts, strict=False) if fraction >= start][-1]


class MovedGaussians:
    """Frozen, labelled Gaussians of one state, carried by one rigid motion per movable part.

    labels [N] int64: 0 static, k moved by transforms[k-1], -1 left out.
    """

    def __init__(self, gaussians: GaussianTensors, labels: Tensor, device: torch.device | str = "cpu"):
        keep = labels >= 0
        self.g = gaussians.detach()[keep].to(device)
        self.labels = labels[keep].to(device)
        self.device = self.labels.device
        self.scales = self.g.log_scales.exp()
        self.opacities = torch.sigmoid(self.g.opacity_logits)
        self.quats = so3.quat_normalize(self.g.quats)
        self.bodies = Parts(self.labels)

    def rows(self, part: int) -> Tensor:
        """Indices of a part's Gaussians among those that were not left out."""
        return (self.labels == part).nonzero().squeeze(1)

    def moved(self, transforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means [N, 3], quats [N, 4] and SH [N, B, 3] after the motions; transforms [K-1, 4, 4]."""
        return carry(self.g.means, self.quats, self.g.sh, self.bodies, transforms)

    def render(
        self, means: Tensor, quats: Tensor, sh: Tensor, camera: Camera, background: Tensor, backend: str, features=None
    ):
        """A view of what ``moved`` gives, or of the like; features [N, F] as in ``rasterize``."""
        camera, background = camera.to(self.device), background.to(self.device)
        return rasterize(
            means,
            quats,
            self.scales,
            self.opacities,
            sh,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            background=background,
            features=features,
            backend=backend,
        )


@dataclass
class Side:
    """Frozen Gaussians of one state, labels [N] (part of each, -1 leaves it out) and the other state's photographs.

    back: they are the end state's, carried to the start.  seen_from: mean direction [N, 3] to the cameras of their own
    state that see each (``DepthStack.seen_from``); None: all views count.  shown: weight [H, W] of the pixels of a
    photograph, asked with its number, size and camera (``ShownPixels``); None: all count alike.
    """

    gaussians: GaussianTensors
    labels: Tensor
    views: TrainingViews
    back: bool = False
    seen_from: Tensor | None = None
    shown: Callable[[int, int, Camera], Tensor] | None = None


def polish(
    sides: list[Side],
    transforms: Tensor,
    types: list[str],
    config: PolishConfig,
    *,
    seed: int,
    axes: Tensor | None = None,
    backend: str = "auto",
    device: torch.device | str = "cpu",
) -> tuple[Tensor, list[float]]:
    """Refine ``transforms`` [K-1, 4, 4] (start -> end) so that the moved Gaussians match the photographs of all sides
    at once.

    Steps look at the sides in turn and share one descent: where one state's surfaces are wrong its own optimum is wrong
    too, and a mean of two optima with it; the sum of both losses has its minimum near the truth. Each loss is taken
    over its own mean so far (so the sum of their logarithms falls): what a state explains half as well says half as
    much. A backward step of B = T^-1 about a point a is the forward one about T a with its vectors turned by -R.
    types: "revolute" | "prismatic" | "free" per movable part.  axes [K-1, 3]: directions that joints keep, which those
    of ``transforms`` have (NaN: free; None: all are).  ``config.steps`` are taken per side.
    Returns (transforms float64, each side's mean loss over the last tenth).
    """
    transforms = transforms.double().clone()
    if config.steps <= 0 or len(transforms) == 0:
        return transforms, [float("nan")] * len(sides)
    bodies, fronts = [], []
    for side in sides:
        solid = torch.sigmoid(side.gaussians.opacity_logits) > config.min_opacity
        labels = torch.where(solid, side.labels, -1)
        bodies.append(MovedGaussians(side.gaussians, labels, device))
        fronts.append(None if side.seen_from is None else side.seen_from[labels >= 0].to(device))
    enough = [torch.bincount(body.labels, minlength=len(types) + 1)[1:].cpu() >= FEWEST for body in bodies]
    anchors, radius = anchors_of(sides, bodies, transforms)
    steps = MotionSteps(types, radius, config.rate, axes)
    losses: list[list[float]] = [[] for _ in sides]
    total = config.steps * len(sides)
    for step in range(total):
        turn, number = step % len(sides), step // len(sides)
        side, body, fraction = sides[turn], bodies[turn], step / total
        generator = torch.Generator().manual_seed((seed + side.back) * 1_000_003 + number)
        background = torch.rand(3, generator=generator)
        index = view_index(seed + side.back + 13, number, len(side.views))
        size = side.views.levels.index(config.level(fraction))
        shot = side.views.get(index, size, background)
        means, quats, sh = body.moved(se3.inverse(transforms) if side.back else transforms)
        means.requires_grad_(True)
        quats.requires_grad_(True)
        out = body.render(means, quats, sh, shot.camera, background, backend)
        target = shot.image.to(out.colour.device)
        colour = out.colour
        if side.shown is not None:
            colour = target + side.shown(index, size, shot.camera)[..., None] * (colour - target)
        loss = l1_ssim(colour, target, config.ssim_lambda)
        losses[turn].append(float(loss.detach()))
        (loss / max(sum(losses[turn]) / len(losses[turn]), 1e-9)).backward()
        centre = se3.apply(transforms, anchors[:, None])[:, 0]
        back = transforms[:, :3, :3].transpose(1, 2) if side.back else transforms[:, :3, :3]
        limit = (
            (fronts[turn], back, shot.camera.position, config.front)
            if fronts[turn] is not None and config.front > -1
            else None
        )
        gradient = part_pulls(means, quats, body.bodies, anchors if side.back else centre, limit)
        if side.back:
            gradient = by_inverse(gradient, transforms)
        transforms = steps.take(transforms, gradient, centre, fraction, enough[turn])
    transforms = steps.ended(transforms)
    last = [of[-max(config.steps // 10, 1) :] for of in losses]
    return transforms, [sum(of) / len(of) for of in last]


def anchors_of(sides, bodies, transforms: Tensor) -> tuple[Tensor, Tensor]:
    """Each part's centre at the start [K-1, 3] and the spread of its points [K-1] (float64, CPU), means over the
    sides."""
    anchors, radius = [], []
    for k in range(len(transforms)):
        centres, spreads = [], []
        for side, body in zip(sides, bodies, strict=True):
            points = body.g.means[body.rows(k + 1)].double().cpu()
            if not len(points):
                continue
            centre = points.mean(0)
            spreads.append(float((points - centre).square().sum(1).mean().sqrt()))
            centres.append(se3.apply(se3.inverse(transforms[k]), centre[None])[0] if side.back else centre)
        anchors.append(torch.stack(centres).mean(0) if centres else torch.zeros(3, dtype=torch.float64))
        radius.append(max(sum(spreads) / max(len(spreads), 1), 1e-3))
    return torch.stack(anchors), torch.tensor(radius, dtype=torch.float64)


def losses_both_ways(
    states, labels: Sequence[Tensor], transforms: Tensor, views: dict[int, TrainingViews], **options
) -> list[float]:
    """``photometric_cost`` of the start's Gaussians in the end's photographs and of the end's in the start's. labels:
    [N] by state; transforms [K-1, 4, 4] start -> end."""
    ways = transforms, se3.inverse(transforms)
    return [photometric_cost(states[s].gaussians, labels[s], ways[s], views[1 - s], **options) for s in (0, 1)]


@torch.no_grad()
def photometric_cost(
    gaussians: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    views: TrainingViews,
    *,
    level: int,
    count: int = 16,
    ssim_lambda: float = 0.8,
    shown: Callable[[int, int, Camera], Tensor] | None = None,
    hidden: float = 0.0,
    backend: str = "auto",
    device: torch.device | str = "cpu",
) -> float:
    """Mean image loss of the moved Gaussians over ``count`` views spread over the training set: lower explains the
    images better.

    shown: weight of each pixel, as in ``Side``; what a pixel lacks of 1 costs ``hidden`` instead (None: all count
    alike).
    """
    body = MovedGaussians(gaussians, labels, device)
    means, quats, sh = body.moved(transforms)
    total, picked = 0.0, views.spread(count)
    for index in picked:
        background = torch.full((3,), 0.5)
        size = views.levels.index(level)
        shot = views.get(index, size, background)
        colour, target = (
            body.render(means, quats, sh, shot.camera, background, backend).colour,
            shot.image.to(body.device),
        )
        if shown is not None:
            weight = shown(index, size, shot.camera)
            colour = target + weight[..., None] * (colour - target)
            total += hidden * float(1 - weight.mean())
        total += float(l1_ssim(colour, target, ssim_lambda))
    return total / len(picked)
