"""Motions and the twin's Gaussians fitted together, where photographs of both states are explained better so.

Against frozen Gaussians of one state (``screw_polish``) a motion is right to a few hundredths of a degree where their
shape is; else it makes up for what is wrong with the shape, too (a plain door that photographs left a degree askew).
Here both states' photographs answer for shape and motion at once. They tell little of so small differences, and
Gaussians bend to whatever motion they are under: a motion is taken only if the image loss is lower than with the same
Gaussians fitted as long under the motions as they were.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import PartMotions
from p2gs.gaussians.pose import carry, with_static
from p2gs.gaussians.splats import Splats
from p2gs.models.tune import TuneConfig, TwinSteps
from p2gs.motion.light import TurnedLight, brighter, facing_either
from p2gs.motion.motion_steps import MotionSteps
from p2gs.motion.part_pull import part_pulls
from p2gs.motion.screw_polish import MovedGaussians, PolishConfig, Side, anchors_of, photometric_cost
from p2gs.native import at_once, serial_torch
from p2gs.ops import se3
from p2gs.ops.carry import RigidMoves
from p2gs.ops.ssim import l1_ssim
from p2gs.render import draws_natively
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack


def fit_together(
    gaussians: GaussianTensors,
    labels: Tensor,
    motions: PartMotions,
    time: float,
    views: dict[int, TrainingViews],
    config: TuneConfig,
    ssim_lambda: float,
    *,
    axes: Tensor | None = None,
    stacks: list[DepthStack] | None = None,
    tau: float = PolishConfig.free_static,
    seed: int,
    backend: str = "auto",
    device: torch.device | str = "cpu",
) -> tuple[PartMotions, dict[str, float]]:
    """The motions as they were or as both states' photographs have them, and the image loss (sum of both states') with
    either: {"held", "free"} ({} where nothing was fitted).

    gaussians: at canonical ``time``, labels [N] (0 static).  views: photographs by state.  config: steps of the
    Gaussians (0 = off); a part's motion learns at the rate of their centres.  ssim_lambda: weight of SSIM against L1.
    axes [K, 3]: directions that joints keep (NaN: free; None: all are).  stacks: rendered depth of both states, by
    which Gaussians face those who see them on a surface, to within ``tau`` (None: a part's sides are lit alike).
    """
    if config.steps <= 0 or len(motions) == 0 or len(gaussians) == 0:
        return motions, {}
    at_start = carry(gaussians, labels, with_static(se3.screw_at(motions.transforms, -time)))
    normals = torch.zeros_like(at_start.means)
    if stacks is not None:
        normals = facing_either(at_start, labels, motions.transforms, stacks, tau)
    options = {"axes": axes, "normals": normals, "seed": seed, "backend": backend, "device": device}
    fit = partial(_fit, at_start, labels, motions, views, config, ssim_lambda, **options)
    (_, held), (fitted, free) = at_once(fit, (0.0, config.rates.means))
    return (fitted if free < held else motions), {"held": held, "free": free}


def _fit(
    g: GaussianTensors,
    labels: Tensor,
    motions: PartMotions,
    views: dict[int, TrainingViews],
    config: TuneConfig,
    ssim_lambda: float,
    rate: float,
    *,
    axes: Tensor | None,
    normals: Tensor,
    seed: int,
    backend: str,
    device: torch.device | str,
) -> tuple[PartMotions, float]:
    """Motions and the loss of both states' photographs after ``config.steps`` steps; g: at the start.
    rate: of the motions (0: they are held).  normals [N, 3]: which way Gaussians face at the start (0: not known)."""
    splats, T, some = Splats(g).to(device), motions.transforms.double().clone(), torch.ones(len(motions)).bool()
    body = MovedGaussians(g, labels, device)
    labels, parts = body.labels, body.bodies
    middle, spread = anchors_of([Side(g, labels, views[1])], [body], T)
    by_motion = MotionSteps(motions.types, spread, rate, axes)
    turns = torch.tensor([float(kind != "prismatic") for kind in motions.types])[:, None].to(device)
    light, normals = torch.zeros(len(motions), 4, device=device, requires_grad=True), normals.to(device)
    steps = TwinSteps(splats, views, config, seed, light)

    def gains() -> Tensor:
        return TurnedLight(light * turns).gains(labels, normals)

    def one_step(step: int) -> None:
        nonlocal T
        state, shot, background = steps.shot(step)
        posed = splats.tensors()
        if state:
            means, quats = RigidMoves(parts, T.to(device))(posed.means, posed.quats)
            means.retain_grad()
            quats.retain_grad()
            posed = GaussianTensors(means, quats, posed.log_scales, posed.opacity_logits, posed.sh)
            posed = brighter(posed, gains())
        image, camera = shot.image.to(device), shot.camera.to(device)
        out = render_gaussians(posed, camera, background.to(device), backend=backend)
        steps.take(l1_ssim(out.colour, image, ssim_lambda))
        if state and rate > 0:
            centre = se3.apply(T, middle[:, None])[:, 0]
            T = by_motion.take(T, part_pulls(means, quats, parts, centre), centre, step / config.steps, some)

    with serial_torch(draws_natively(splats.means, backend)):
        for step in range(config.steps):
            one_step(step)
    T = by_motion.ended(T)
    ended, gain, labels = splats.tensors().detach().to("cpu"), gains().detach().cpu(), labels.cpu()
    there = brighter(carry(ended, labels, with_static(T)), gain)
    options = {"level": config.levels[-1], "ssim_lambda": ssim_lambda, "backend": backend, "device": device}
    still = torch.zeros_like(labels), torch.zeros(0, 4, 4).double()  # as they are
    losses = [
        photometric_cost(at, *still, views[s], count=len(views[s]), **options) for s, at in enumerate((ended, there))
    ]
    return replace(motions, transforms=T), sum(losses)
