"""A phase trained by a Trainer and nothing else, for benches that time it: no run folder, no logger, no checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Sequence

from lightning.pytorch import Trainer

from p2gs.callbacks.base import Callback
from p2gs.data.base import TwoStateData
from p2gs.models.phase import Phase

QUIET = ("logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing")


class OwnViews(TwoStateData):
    """Says which of the phase's own views a step looks at; there is nothing to read."""

    def setup(self, stage=None):
        pass


def train_bare(phase: Phase, callbacks: Sequence[Callback], folder: Path | str = ".") -> None:
    """All steps of the phase, on the CPU. folder: where Lightning would put what it writes."""
    options: dict[str, Any] = {"max_steps": phase.total_steps, "max_epochs": -1, "default_root_dir": str(folder)}
    options |= {name: False for name in QUIET}
    Trainer(accelerator="cpu", callbacks=list(callbacks), **options).fit(phase, datamodule=OwnViews(""))
