"""Motions and the twin's Gaussians fitted together, where photographs of both states are explained better so.

Against frozen Gaussians of one state (``screw_polish``) a motion is right to a few hundredths of a degree where their
shape is; else it makes up for what is wrong with the shape, too (a plain door that photographs left a degree askew).
Here both states' photographs answer for shape and motion at once. They tell little of so small differences, and
Gaussians bend to whatever motion they are under: a motion is taken only if the image loss is lower than with the same
Gaussians fitted as long under the motions as they were.

A part's Gaussians are fitted where they are kept (``homes``), and the motion or its inverse brings them to the other
state: all of them at the start would be the same twin, but what the end alone shows would have to follow every step of
the motion, and held it back.
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
from p2gs.models.homes import Homes
from p2gs.models.tune import TuneConfig, TwinSteps
from p2gs.motion.light import TurnedLight, brighter, facing_either
from p2gs.motion.part_pull import by_inverse, part_pulls
from p2gs.motion.screw_polish import MotionSteps, MovedGaussians, PolishConfig, Side, anchors_of, photometric_cost
from p2gs.native import at_once, serial_torch
from p2gs.ops import se3
from p2gs.ops.carry import Parts, RigidMoves
from p2gs.ops.ssim import l1_ssim
from p2gs.render import draws_natively
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack


def fit_together(
    kept: GaussianTensors,
    homes: Homes,
    motions: PartMotions,
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

    kept: Gaussians, each in its own state.  views: photographs by state.  config: steps of the Gaussians (0 = off); a
    part's motion learns at the rate of their centres.  ssim_lambda: weight of SSIM against L1.
    axes [K, 3]: directions that joints keep (NaN: free; None: all are).  stacks: rendered depth of both states, by
    which Gaussians face those who see them on a surface, to within ``tau`` (None: a part's sides are lit alike).
    """
    if config.steps <= 0 or len(motions) == 0 or len(kept) == 0:
        return motions, {}
    normals = torch.zeros_like(kept.means)
    if stacks is not None:
        at_start = homes.posed(kept, motions.transforms, 0.0)
        normals = facing_either(at_start, homes.labels, motions.transforms, stacks, tau)
    options = {"axes": axes, "normals": normals, "seed": seed, "backend": backend, "device": device}
    fit = partial(_fit, kept, homes, motions, views, config, ssim_lambda, **options)
    (_, held), (fitted, free) = at_once(fit, (0.0, config.rates.means))
    return (fitted if free < held else motions), {"held": held, "free": free}


def _fit(
    kept: GaussianTensors,
    homes: Homes,
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
    """Motions and the loss of both states' photographs after ``config.steps`` steps.
    rate: of the motions (0: they are held).  normals [N, 3]: which way Gaussians face at the start (0: not known)."""
    T, some = motions.transforms.double().clone(), torch.ones(len(motions)).bool()
    moved = [of.to(device) for of in (homes.at_end, homes.at_start)]  # who is carried to the start, and who to the end
    parts = [Parts(of) for of in moved]
    at_start, labels = homes.posed(kept, T, 0.0), homes.labels
    middle, spread = anchors_of([Side(at_start, labels, views[1])], [MovedGaussians(at_start, labels, device)], T)
    splats = Splats(kept).to(device)
    by_motion = MotionSteps(motions.types, spread, rate, axes)
    turns = torch.tensor([float(kind != "prismatic") for kind in motions.types])[:, None].to(device)
    light, normals = torch.zeros(len(motions), 4, device=device, requires_grad=True), normals.to(device)
    steps = TwinSteps(splats, views, config, seed, light)

    def gains(state: int) -> Tensor:
        gain = TurnedLight(light * turns).gains(moved[state], normals)
        return gain if state else 1 / gain

    def one_step(step: int) -> None:
        nonlocal T
        state, shot, background = steps.shot(step)
        own, way = splats.tensors(), T if state else se3.inverse(T)
        means, quats = RigidMoves(parts[state], way.to(device))(own.means, own.quats)
        means.retain_grad()
        quats.retain_grad()
        posed = GaussianTensors(means, quats, own.log_scales, own.opacity_logits, own.sh)
        image, camera = shot.image.to(device), shot.camera.to(device)
        out = render_gaussians(brighter(posed, gains(state)), camera, background.to(device), backend=backend)
        steps.take(l1_ssim(out.colour, image, ssim_lambda))
        if rate > 0:
            centre = se3.apply(T, middle[:, None])[:, 0]
            pulls = part_pulls(means, quats, parts[state], centre if state else middle)
            pulls = pulls if state else by_inverse(pulls, T)
            T = by_motion.take(T, pulls, centre, step / config.steps, some)

    with serial_torch(draws_natively(splats.means, backend)):
        for step in range(config.steps):
            one_step(step)
    T = by_motion.ended(T)
    ended, losses = splats.tensors().detach().to("cpu"), []
    options = {"level": config.levels[-1], "ssim_lambda": ssim_lambda, "backend": backend, "device": device}
    still = torch.zeros_like(labels), torch.zeros(0, 4, 4).double()  # as they are
    for s, way in enumerate((se3.inverse(T), T)):
        posed = brighter(carry(ended, moved[s].cpu(), with_static(way)), gains(s).detach().cpu())
        losses.append(photometric_cost(posed, *still, views[s], count=len(views[s]), **options))
    return replace(motions, transforms=T), sum(losses)
