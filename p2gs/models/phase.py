"""What every training phase shares: manual optimisation, loss bookkeeping, step-addressed randomness, resumable
state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from lightning.pytorch import LightningModule
from torch import Tensor

from p2gs.data.base import Visit
from p2gs.data.views import TrainingViews
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs
from p2gs.models.adam import NamedAdam
from p2gs.models.health import check_gaussians, check_loss
from p2gs.models.stage import PHASES, Stage, register_phase
from p2gs.native import serial_torch
from p2gs.ops.recorded import Recorder, recording
from p2gs.render import draws_natively
from p2gs.stopping import leave_if_asked
from p2gs.types import UserError

__all__ = ["PHASES", "Phase", "PhaseConfig", "Stage", "register_phase"]


@dataclass
class PhaseConfig:
    """Fields every phase has. steps: optimiser steps."""

    steps: int = 1000


class Phase(LightningModule, Stage):
    """One training phase. Owns its Gaussians, rasterizer and whatever else it learns; hands over a small saved object.

    Subclasses give ``build`` (see ``models.stage``), ``parameter_groups`` (name -> (tensors, learning rate)),
    ``learning_rates(step)`` and ``inputs(visit)``; the sum of the losses on those inputs is minimised with one Adam.
    Which losses are on is the config's business. It trains from the run's LightningDataModule.

    views: the photographs it looks at, of each state; none in a phase that renders none.  losses: name -> Loss.
    scalars: latest detached values by name, for callbacks to log.  seed: makes every random choice a pure function of
    (seed, step), so that a resumed run goes the same way.
    """

    Config: type[PhaseConfig] = PhaseConfig
    trained = True

    def __init__(self, config: PhaseConfig, losses: dict[str, Loss], *, seed: int = 0, rasterizer: str = "auto"):
        super().__init__()
        self.automatic_optimization = False
        self.config: Any = config  # of the subclass's Config
        self.losses = losses
        self.seed = seed
        self.rasterizer = rasterizer
        self.splats: Splats
        self.views: dict[int, TrainingViews] = {}
        self.scalars: dict[str, Tensor | float] = {}
        self.loss_cache: dict = {}
        self.recorder = Recorder()
        self.track_gradients = False  # set by the densification callback

    # -- what a subclass gives ----------------------------------------------------------------------------------------
    def parameter_groups(self) -> dict[str, tuple[list[Tensor], float]]:
        """name -> (parameters, learning rate at step 0)."""
        raise NotImplementedError

    def learning_rates(self, step: int) -> dict[str, float]:
        """Learning rates that change with the step; groups not named keep theirs."""
        return {}

    def inputs(self, visit: Visit) -> LossInputs:
        """Render what this step looks at: the batch that the data module's loader has for it."""
        raise NotImplementedError

    def hand_over(self) -> Any:
        """The result of the phase, a dataclass of ``gaussians.handover``."""
        raise NotImplementedError

    def preview(self, times: list[float]) -> dict[str, Tensor]:
        """Pictures by name, uint8 [H, W, 3]."""
        return {}

    def summary(self) -> dict[str, float]:
        """Numbers worth plotting that are no losses (joint parameters, part masses)."""
        return {}

    # -- what all share -----------------------------------------------------------------------------------------------
    @property
    def step(self) -> int:
        """Optimiser steps done."""
        return self.global_step

    @property
    def total_steps(self) -> int:
        return self.config.steps

    def needed(self, what: str) -> bool:
        """Whether a loss that is due in this step asks for ``what`` (of ``losses.base.NEEDS``)."""
        return any(what in loss.needs and loss.active(self.step, self.total_steps) for loss in self.losses.values())

    @property
    def num_gaussians(self) -> int:
        return len(self.splats)

    def generator(self, step: int, purpose: int = 0) -> torch.Generator:
        """A generator that depends on (seed, phase, step, purpose) only."""
        name = sum((i + 1) * ord(c) for i, c in enumerate(self.phase_name))
        number = ((self.seed * 1_000_003 + name) * 1_000_003 + step) * 31 + purpose
        return torch.Generator().manual_seed(number % 2**63)

    def configure_optimizers(self):
        groups = [
            {"params": list(params), "lr": lr, "name": name} for name, (params, lr) in self.parameter_groups().items()
        ]
        return NamedAdam([g for g in groups if g["params"]], eps=1e-15)

    def total_loss(self, inputs: LossInputs) -> Tensor:
        """Weighted sum of the active losses; fills ``scalars``. Raises UserError when no loss applies."""
        total = None
        for name, loss in self.losses.items():
            value = loss(inputs)
            if value is None:
                continue
            self.scalars[f"loss/{name}"] = value.detach()
            total = value if total is None else total + value
        if total is None or not total.requires_grad:
            on = ", ".join(self.losses) or "none"
            raise UserError(
                f"phases.{self.phase_name}.losses: no loss applies at step {inputs.step} (switched on: {on}); "
                "expected at least 'render'"
            )
        self.scalars["loss/total"] = total.detach()
        return total

    def on_train_start(self):
        leave_if_asked()

    def training_step(self, batch: Visit, batch_idx):
        assert batch.step == self.step, f"the loader is at step {batch.step}, {self.phase_name} at {self.step}"
        with serial_torch(draws_natively(self.splats.means, self.rasterizer)), recording(self.recorder):
            self.one_step(batch)

    def one_step(self, visit: Visit) -> None:
        """Render, losses, backward pass, optimiser. Raises UserError where no Gaussian is left and where the loss is
        not finite."""
        step = visit.step
        check_gaussians(self.phase_name, len(self.splats))
        optimizer: Any = self.optimizers()  # the one
        rates = self.learning_rates(step)
        for group in optimizer.param_groups:
            if group["name"] in rates:
                group["lr"] = rates[group["name"]]
        inputs = self.inputs(visit)
        optimizer.zero_grad(set_to_none=True)
        total = self.total_loss(inputs)
        check_loss(self.phase_name, step, self.scalars)
        total.backward()
        render = inputs.render
        if (
            self.track_gradients
            and render is not None
            and render.means2d_abs_grad is not None
            and render.radii is not None
        ):
            # in units of the full image, so that levels of the resolution schedule weigh alike
            self.splats.note_gradients(render.means2d_abs_grad, render.radii, float(render.alpha.shape[0]))
        self.constrain_gradients()
        optimizer.step()

    def constrain_gradients(self) -> None:
        """Hook between backward and the optimiser's step."""
