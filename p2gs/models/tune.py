"""The Gaussians once more, with the final labels and motions held fixed: the photographs of both states decide alone.

While motions are learned the Gaussians bend to whatever they happen to be, and to the terms that teach parts; once both
stand, surfaces and colours still have to follow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews, view_index
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs, Target
from p2gs.models.adam import NamedAdam
from p2gs.models.single_state import SplatRates
from p2gs.native import serial_torch
from p2gs.ops import se3
from p2gs.ops.carry import RigidMoves
from p2gs.render import draws_natively
from p2gs.types import GaussianTensors


@dataclass
class TuneConfig:
    """Options of the last fit of the Gaussians. steps: over both states, in turn (0 = off).  levels: image sizes (long
    edge, pixels), of which the last is used."""

    steps: int = 900
    levels: list[int] = field(default_factory=lambda: [400])
    rates: SplatRates = field(default_factory=lambda: SplatRates(3e-4, 4e-6, 2e-2, 1.2e-1, 3e-3, 1e-2, 2e-3))


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
    splats, labels = Splats(gaussians).to(device), labels.to(device)
    moves = [RigidMoves(labels, se3.screw_at(transforms, state - time).to(device)) for state in (0, 1)]
    rates = config.rates.at(0.0)
    optimizer = NamedAdam(
        [{"params": [getattr(splats, name)], "lr": rate, "name": name} for name, rate in rates.items()], eps=1e-15
    )
    cache: dict = {}

    def one_step(step: int) -> None:
        state = step % 2
        rates = config.rates.at(step / config.steps)
        for group in optimizer.param_groups:
            group["lr"] = rates[group["name"]]
        of = views[state]
        background = torch.rand(3, generator=torch.Generator().manual_seed(seed * 1_000_003 + step))
        shot = of.get(
            view_index(seed + 7919 * state + 31, step // 2, len(of)), of.levels.index(config.levels[-1]), background
        )
        depth = None if shot.depth is None else shot.depth.to(device)
        camera, background = shot.camera.to(device), background.to(device)
        target = Target(shot.image.to(device), shot.alpha.to(device), background, depth)
        g = splats.tensors()
        posed = g.placed(*moves[state](g.means, g.quats))
        depth_sq = any("depth_sq" in loss.needs for loss in losses.values())
        render = render_gaussians(posed, camera, background, depth_sq=depth_sq, backend=backend)
        inputs = LossInputs(step, config.steps, g, render, target, camera, cache=cache)
        values = [value for value in (loss(inputs) for loss in losses.values()) if value is not None]
        if not values:  # none is due in this step
            return
        optimizer.zero_grad(set_to_none=True)
        total: Any = sum(values)
        total.backward()
        optimizer.step()

    with serial_torch(draws_natively(splats.means, backend)):
        for step in range(config.steps):
            one_step(step)
    return splats.tensors().detach().to("cpu").clone()
