"""Motions and the twin's Gaussians fitted together, where photographs of both states are explained better so.

Against frozen Gaussians of one state (``screw_polish``) a motion is right to a few hundredths of a degree where their
shape is; else it makes up for what is wrong with the shape, too (a plain door that photographs left a degree askew).
Here both states' photographs answer for shape and motion at once.

A part's Gaussians are fitted where they are kept (``homes``), and the motion or its inverse brings them to the other
state: all of them at the start would be the same twin, but what the end alone shows would have to follow every step of
the motion, and held it back.
"""

from __future__ import annotations

from dataclasses import replace

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
from p2gs.native import serial_torch
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
    """The motions as both states' photographs have them, and the image loss (sum of both states') before and after the
    fit: {"before", "after"} ({} where nothing was fitted).

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
    fit = _Fit(kept, homes, motions, normals, views, config, seed, device)
    options = {"level": config.levels[-1], "ssim_lambda": ssim_lambda, "backend": backend, "device": device}
    before = fit.loss(views, options)
    by_motion = MotionSteps(motions.types, fit.spread, config.rates.means, axes)
    with serial_torch(draws_natively(fit.splats.means, backend)):
        for step in range(config.steps):
            fit.one_step(step, by_motion, ssim_lambda, backend)
    fit.T = by_motion.ended(fit.T)
    return replace(motions, transforms=fit.T), {"before": before, "after": fit.loss(views, options)}


class _Fit:
    """What learns: the Gaussians, each in its own state, the motions ``T``, and how light changes as parts turn.

    normals [N, 3]: which way Gaussians face at the start (0: not known).  spread [K]: of each part's points.
    """

    def __init__(self, kept, homes: Homes, motions: PartMotions, normals: Tensor, views, config, seed: int, device):
        self.device, self.T = device, motions.transforms.double().clone()
        self.moved = [of.to(device) for of in (homes.at_end, homes.at_start)]  # carried to the start, and to the end
        self.parts = [Parts(of) for of in self.moved]
        at_start, labels = homes.posed(kept, self.T, 0.0), homes.labels
        body = MovedGaussians(at_start, labels, device)
        self.middle, self.spread = anchors_of([Side(at_start, labels, views[1])], [body], self.T)
        self.splats, self.normals = Splats(kept).to(device), normals.to(device)
        self.turns = torch.tensor([float(kind != "prismatic") for kind in motions.types])[:, None].to(device)
        self.light = torch.zeros(len(motions), 4, device=device, requires_grad=True)
        self.steps = TwinSteps(self.splats, views, config, seed, self.light)

    def gains(self, state: int) -> Tensor:
        """[N] how much brighter Gaussians are in ``state`` than in their own."""
        gain = TurnedLight(self.light * self.turns).gains(self.moved[state], self.normals)
        return gain if state else 1 / gain

    def way(self, state: int) -> Tensor:
        """[K, 4, 4] what brings Gaussians that are kept in the other state to ``state``."""
        return self.T if state else se3.inverse(self.T)

    def one_step(self, step: int, by_motion: MotionSteps, ssim_lambda: float, backend: str) -> None:
        """One photograph: a step of Gaussians, light and motions."""
        state, shot, background = self.steps.shot(step)
        own = self.splats.tensors()
        means, quats = RigidMoves(self.parts[state], self.way(state).to(self.device))(own.means, own.quats)
        means.retain_grad()
        quats.retain_grad()
        posed = GaussianTensors(means, quats, own.log_scales, own.opacity_logits, own.sh)
        posed, camera = brighter(posed, self.gains(state)), shot.camera.to(self.device)
        out = render_gaussians(posed, camera, background.to(self.device), backend=backend)
        self.steps.take(l1_ssim(out.colour, shot.image.to(self.device), ssim_lambda))
        centre = se3.apply(self.T, self.middle[:, None])[:, 0]
        pulls = part_pulls(means, quats, self.parts[state], centre if state else self.middle)
        pulls = pulls if state else by_inverse(pulls, self.T)
        every = torch.ones(len(self.T)).bool()
        self.T = by_motion.take(self.T, pulls, centre, step / self.steps.config.steps, every)

    def loss(self, views: dict[int, TrainingViews], options: dict) -> float:
        """Image loss of all photographs, sum of both states'; options: of ``photometric_cost``."""
        own, total = self.splats.tensors().detach().to("cpu"), 0.0
        still = torch.zeros(len(own), dtype=torch.int64), torch.zeros(0, 4, 4).double()  # as they are
        for s in (0, 1):
            posed = carry(own, self.moved[s].cpu(), with_static(self.way(s)))
            posed = brighter(posed, self.gains(s).detach().cpu())
            total += photometric_cost(posed, *still, views[s], count=len(views[s]), **options)
        return total
