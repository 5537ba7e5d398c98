"""``checkpoint``: the phase's whole training state, so that a killed run goes on where it was."""

from __future__ import annotations

import os
from pathlib import Path

from p2gs.callbacks.base import Callback, due, register_callback, run_folder


def checkpoint_path(run_dir: Path, phase_name: str) -> Path:
    """Where a phase's newest training state is kept."""
    return Path(run_dir) / "checkpoints" / f"{phase_name}.ckpt"


def save_atomically(trainer, path: Path) -> None:
    """``trainer.save_checkpoint`` beside ``path``, flushed to disk, then renamed: a kill leaves the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    trainer.save_checkpoint(part)
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)


@register_callback("checkpoint")
class Checkpoint(Callback):
    """every: steps between two checkpoints, each replacing the one before; the last step is always saved."""

    changes_result = False
    every: int = 500

    def on_step(self, trainer, phase) -> None:
        if due(phase.step, self.every, phase.total_steps):
            save_atomically(trainer, checkpoint_path(run_folder(trainer), phase.phase_name))
