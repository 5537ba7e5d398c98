"""``repel``: place the repel points anew while parts move (the paper's "dynamic" variant; without this callback they stay fixed)."""

from __future__ import annotations

from p2gs.callbacks.base import Callback, register_callback


@register_callback("repel")
class RepelRefresh(Callback):
    """every: steps between two placements (paper: 5,000)."""

    every: int = 5000

    def on_step(self, trainer, phase) -> None:
        if hasattr(phase, "place_repel_points") and phase.step % self.every == 0 and phase.step < phase.total_steps:
            phase.place_repel_points(phase.step)
