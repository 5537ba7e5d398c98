"""``repel``: place the repel points anew while parts move (the paper's "dynamic" variant; without this callback they
stay fixed)."""

from __future__ import annotations

from p2gs.callbacks.base import Callback, register_callback


@register_callback("repel")
class RepelRefresh(Callback):
    """every: steps between two placements (paper: 5,000 of 20,000).  fraction: of the phase instead, when above 0 (0.25
    is the paper's ratio for a phase of any length).
    """

    every: int = 5000
    fraction: float = 0.0

    def on_step(self, trainer, phase) -> None:
        every = max(round(self.fraction * phase.total_steps), 1) if self.fraction > 0 else self.every
        if hasattr(phase, "place_repel_points") and phase.step % every == 0 and phase.step < phase.total_steps:
            phase.place_repel_points(phase.step)
