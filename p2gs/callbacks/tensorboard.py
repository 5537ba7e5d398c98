"""``scalars`` and ``images``: losses, summaries and rendered pictures in TensorBoard."""

from __future__ import annotations

from dataclasses import field

from torch import Tensor

from p2gs.callbacks.base import Callback, due, register_callback


@register_callback("scalars")
class Scalars(Callback):
    """Losses by name, Gaussian count and the phase's summary (joint parameters, part masses) to every logger.

    every: steps between two entries. Goes to ``logger.log_metrics`` directly: ``LightningModule.log`` costs 0.2-0.35 ms
    a key and step whatever its interval, a quarter of a training step with a dozen losses.
    """

    changes_result = False
    every: int = 50

    def on_step(self, trainer, phase) -> None:
        if trainer.logger is None or not due(phase.step, self.every, phase.total_steps):
            return
        values = {name: float(value) for name, value in phase.scalars.items()}
        values["gaussians"] = float(phase.num_gaussians)
        values.update(phase.summary())
        for logger in trainer.loggers:
            logger.log_metrics({f"{phase.phase_name}/{k}": v for k, v in values.items()}, step=phase.step)


def add_image(logger, name: str, image: Tensor, step: int) -> bool:
    """Send a picture uint8 [H, W, 3] to a logger that takes pictures (TensorBoard); False where it takes none."""
    add = getattr(getattr(logger, "experiment", None), "add_image", None)
    if add is None:
        return False
    add(name, image.cpu().numpy(), global_step=step, dataformats="HWC")
    return True


@register_callback("images")
class Images(Callback):
    """Rendered pictures (part-coloured ones too) to TensorBoard. every: steps between.  times: states to render."""

    changes_result = False
    every: int = 500
    times: list[float] = field(default_factory=lambda: [0.0, 1.0])

    def on_step(self, trainer, phase) -> None:
        if trainer.logger is None or not due(phase.step, self.every, phase.total_steps):
            return
        for name, image in phase.preview(self.times).items():
            if not any([add_image(logger, name, image, phase.step) for logger in trainer.loggers]):
                return
