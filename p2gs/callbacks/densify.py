"""``densify``: Gaussians grow to a budget and faint ones go."""

from __future__ import annotations

from typing import Optional

from p2gs.callbacks.base import Callback, register_callback
from p2gs.models.densify import densify, reset_opacity
from p2gs.types import UserError


@register_callback("densify")
class Densify(Callback):
    """budget: Gaussians aimed at, or null for as many as ``threshold`` lets grow.  every: steps between two calls.
    start, stop: fractions of the phase; the aim rises linearly from the present count to the budget over three quarters
    of this span.
    min_opacity, max_scale: what is fainter or larger (internal units) goes.
    split_scale: what is larger is split, the rest cloned.  threshold: above 0, what has a larger mean screen gradient
    grows, as in 3DGS (per half the image's height; the budget, where there is one, is a cap then).  reset_every: steps
    after which opacities are cut to ``reset_to`` while Gaussians grow (3DGS: 3,000 and 0.01; 0 = never)."""

    budget: Optional[int] = 20000
    every: int = 100
    start: float = 0.05
    stop: float = 0.6
    min_opacity: float = 0.005
    max_scale: float = 0.15
    split_scale: float = 0.012
    threshold: float = 0.0
    reset_every: int = 0
    reset_to: float = 0.01

    def __post_init__(self):
        if self.budget is None and self.threshold <= 0:
            raise UserError(
                "callbacks.densify: budget null needs a threshold above 0, else nothing says how much may grow"
            )

    def on_fit_start(self, trainer, phase) -> None:
        phase.track_gradients = True

    def on_step(self, trainer, phase) -> None:
        fraction = phase.step / phase.total_steps
        if phase.step % self.every or not self.start <= fraction <= self.stop:
            return
        densify(
            phase.splats,
            phase.optimizers().optimizer,
            self.aim(len(phase.splats), fraction),
            generator=phase.generator(phase.step, 5),
            min_opacity=self.min_opacity,
            max_scale=self.max_scale,
            split_scale=self.split_scale,
            threshold=self.threshold,
        )
        if self.reset_every and phase.step % self.reset_every == 0:
            reset_opacity(phase.splats, phase.optimizers().optimizer, self.reset_to)

    def aim(self, count: int, fraction: float) -> Optional[int]:
        """How many Gaussians there may be now; None: as many as will."""
        if self.budget is None or self.threshold > 0:
            return self.budget
        progress = min((fraction - self.start) / max(0.75 * (self.stop - self.start), 1e-9), 1.0)
        return min(max(round(count + progress * (self.budget - count)), 1), self.budget)
