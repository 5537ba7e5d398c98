"""``checkpoint``: the phase's whole training state, so that a killed run goes on where it was."""

from __future__ import annotations

from pathlib import Path

from lightning.pytorch.utilities.exceptions import SIGTERMException

from p2gs.callbacks.base import Callback, due, register_callback, run_folder
from p2gs.gaussians.sealed import seal
from p2gs.models.health import LossNotFinite, all_finite


def checkpoint_path(run_dir: Path, phase_name: str) -> Path:
    """Where a phase's newest training state is kept."""
    return Path(run_dir) / "checkpoints" / f"{phase_name}.ckpt"


def save_atomically(trainer, path: Path) -> None:
    """``trainer.save_checkpoint`` beside ``path``, sealed and flushed to disk, then renamed: a kill leaves the old file
    or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    trainer.save_checkpoint(part)
    seal(part, path)


@register_callback("checkpoint")
class Checkpoint(Callback):
    """every: steps between two checkpoints, each replacing the one before; the last step is always saved, and so is the
    last good one when a loss stops being finite or the scheduler ends the process (SIGTERM)."""

    changes_result = False
    every: int = 500

    def on_step(self, trainer, phase) -> None:
        if due(phase.step, self.every, phase.total_steps):
            save_atomically(trainer, checkpoint_path(run_folder(trainer), phase.phase_name))

    def on_exception(self, trainer, phase, exception) -> None:
        """Both come between two steps, when parameters and optimiser agree; an interrupt or a mistake elsewhere may
        come amid one."""
        if isinstance(exception, (LossNotFinite, SIGTERMException)) and phase.step > 0 and all_finite(phase):
            save_atomically(trainer, checkpoint_path(run_folder(trainer), phase.phase_name))
