"""``densify``: Gaussians grow to a budget and faint ones go."""

from __future__ import annotations

from p2gs.callbacks.base import Callback, register_callback
from p2gs.models.densify import densify


@register_callback("densify")
class Densify(Callback):
    """budget: Gaussians aimed at.  every: steps between two calls.  start, stop: fractions of the phase; the aim rises linearly from the
    present count to the budget over three quarters of this span.  min_opacity, max_scale: what is fainter or larger (internal units) goes.
    split_scale: what is larger is split, the rest cloned."""

    budget: int = 20000
    every: int = 100
    start: float = 0.05
    stop: float = 0.6
    min_opacity: float = 0.005
    max_scale: float = 0.15
    split_scale: float = 0.012

    def on_fit_start(self, trainer, phase) -> None:
        phase.track_gradients = True

    def on_step(self, trainer, phase) -> None:
        fraction = phase.step / phase.total_steps
        if phase.step % self.every or not self.start <= fraction <= self.stop:
            return
        progress = min((fraction - self.start) / max(0.75 * (self.stop - self.start), 1e-9), 1.0)
        aim = max(round(len(phase.splats) + progress * (self.budget - len(phase.splats))), 1)
        densify(
            phase.splats,
            phase.optimizers().optimizer,
            min(aim, self.budget),
            generator=phase.generator(phase.step, 5),
            min_opacity=self.min_opacity,
            max_scale=self.max_scale,
            split_scale=self.split_scale,
        )
