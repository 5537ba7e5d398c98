"""The Gaussians once more, with the final labels and motions held fixed: the photographs of both states decide alone.

While motions are learned the Gaussians bend to whatever they happen to be, and to the terms that teach parts; once both
stand, surfaces and colours still have to follow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from p2gs.data.views import TargetImage, TrainingViews, view_index
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs, Target
from p2gs.models.adam import NamedAdam
from p2gs.models.single_state import SplatRates
from p2gs.native import serial_torch
from p2gs.ops import se3
from p2gs.ops.carry import Parts, RigidMoves
from p2gs.ops.recorded import Recorder, recording
from p2gs.render import draws_natively
from p2gs.types import GaussianTensors


@dataclass
class TuneConfig:
    """Options of the last fit of the Gaussians. steps: over both states, in turn (0 = off).  levels: image sizes (long
    edge, pixels), of which the last is used."""

    steps: int = 900
    levels: list[int] = field(default_factory=lambda: [400])
    rates: SplatRates = field(default_factory=lambda: SplatRates(3e-4, 4e-6, 2e-2, 1.2e-1, 3e-3, 1e-2, 2e-3))


class TwinSteps:
    """What every fit of the twin's Gaussians does in a step, beside its loss: the states in turn, their photographs in
    an order of the seed's on any background, rates that fall. light: learned at the rate of colours, if it is."""

    def __init__(
        self,
        splats: Splats,
        views: dict[int, TrainingViews],
        config: TuneConfig,
        seed: int,
        light: Tensor | None = None,
    ):
        self.views, self.config, self.seed = views, config, seed
        learned = {name: getattr(splats, name) for name in config.rates.at(0.0)}
        if light is not None:
            learned["light"] = light
        self.optimizer = NamedAdam([{"params": [p], "name": name} for name, p in learned.items()], eps=1e-15)

    def shot(self, step: int) -> tuple[int, TargetImage, Tensor]:
        """The state (0 or 1), its photograph and the background [3] of this step; sets the rates."""
        rates = self.config.rates.at(step / self.config.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = rates["sh0" if group["name"] == "light" else group["name"]]
        state = step % 2
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + step)
        of, background = self.views[state], torch.rand(3, generator=generator)
        number = view_index(self.seed + 7919 * state + 31, step // 2, len(of))
        return state, of.get(number, of.levels.index(self.config.levels[-1]), background), background

    def take(self, loss: Tensor) -> None:
        """One step of the Gaussians down the loss."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()


def tune(
    gaussians: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    time: float,
    views: dict[int, TrainingViews],
    losses: dict[str, Loss],
    config: TuneConfig,
    *,
    seed: int,
    backend: str = "auto",
    device: torch.device | str = "cpu",
) -> GaussianTensors:
    """The Gaussians (at canonical ``time``) fitted to the photographs of both states under fixed motions.

    labels [N]; transforms [K-1, 4, 4] start -> end; views: photographs by state; losses: of these the ones of kind
    ``image`` count; without any nothing changes.  Returns new Gaussians, detached, on the CPU.
    """
    # priors on surfaces have had their say, and cost more PSNR here than they gain in shape
    losses = {name: loss for name, loss in losses.items() if loss.kind == "image"}
    if config.steps <= 0 or not losses or len(gaussians) == 0:
        return gaussians
    splats, parts = Splats(gaussians).to(device), Parts(labels.to(device))
    moves = [RigidMoves(parts, se3.screw_at(transforms, state - time).to(device)) for state in (0, 1)]
    steps, cache = TwinSteps(splats, views, config, seed), {}

    def one_step(step: int) -> None:
        state, shot, background = steps.shot(step)
        depth = None if shot.depth is None else shot.depth.to(device)
        camera, background = shot.camera.to(device), background.to(device)
        target = Target(shot.image.to(device), shot.alpha.to(device), background, depth, view=shot.key)
        g = splats.tensors()
        posed = g.placed(*moves[state](g.means, g.quats))
        wanted = {what for loss in losses.values() for what in loss.needs}
        made = {"depth_sq": "depth_sq" in wanted, "planes": depth is not None and "planes" in wanted}
        render = render_gaussians(posed, camera, background, backend=backend, **made)
        inputs = LossInputs(step, config.steps, g, render, target, camera, cache=cache)
        values = [value for value in (loss(inputs) for loss in losses.values()) if value is not None]
        if not values:  # none is due in this step
            return
        total: Any = sum(values)
        steps.take(total)

    with serial_torch(draws_natively(splats.means, backend)), recording(Recorder()):
        for step in range(config.steps):
            one_step(step)
    return splats.tensors().detach().to("cpu").clone()
