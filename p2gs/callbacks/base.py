"""What a callback is: a small dataclass that is a Lightning Callback, found by name.

Write one in a file of your own::

    from p2gs.callbacks.base import Callback, register_callback

    @register_callback("count")
    class Count(Callback):
        every: int = 100

        def on_step(self, trainer, phase):
            if phase.step % self.every == 0:
                print(phase.step, phase.num_gaussians)

and switch it on from YAML: ``callbacks: {count: {every: 50}}``, for all phases or under one of them.
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from lightning.pytorch import Callback as LightningCallback

from p2gs.registry import Registry

CALLBACKS: Registry[type["Callback"]] = Registry("callback")


class Callback(LightningCallback):
    """Base of every callback: all hooks of Lightning, and ``on_step`` after each optimiser step.

    A phase offers ``phase_name``, ``step`` (steps done), ``total_steps``, ``scalars`` (name -> detached Tensor or
    float; call ``.item()`` only when logging), ``num_gaussians``, ``preview(times)`` (name -> uint8 [H, W, 3]),
    ``summary()`` (name -> float).

    changes_result: whether the twin depends on it. A phase runs again when such a callback's options change; callbacks
    that only watch say False.  alone: with it only one phase trains at a time (else both single states may, each in a
    process).
    """

    changes_result: ClassVar[bool] = True
    alone: ClassVar[bool] = False

    def prepare(self, cfg, scene) -> None:
        """Before a phase's training. cfg: the run's RunConfig.  scene: the TwoStateScene as trained on (internal
        units)."""

    def on_step(self, trainer, phase) -> None:
        """After an optimiser step; ``phase.step`` counts it already."""

    def on_train_batch_end(self, trainer, phase, outputs, batch, batch_idx) -> None:
        self.on_step(trainer, phase)


def register_callback(name: str):
    """Decorator: make the class a dataclass and register it under ``name``."""

    def wrap(cls: type[Callback]) -> type[Callback]:
        return CALLBACKS.register(name)(dataclass(eq=False)(cls))

    return wrap


def run_folder(trainer) -> Path:
    """The result folder: the pipeline gives every phase's Trainer it as ``default_root_dir``."""
    return Path(trainer.default_root_dir)


def due(step: int, every: int, total: int) -> bool:
    """Whether something done every ``every`` steps is due after ``step`` steps: at multiples, and at the end. every 0:
    at the end only."""
    return step == total or (every > 0 and step > 0 and step % every == 0)


def silence_lightning() -> None:
    """Keep Lightning's advice, device lines and known-harmless warnings off the terminal; its errors still come."""
    for name in ("lightning.pytorch", "lightning.fabric", "pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    for pattern in (
        r".*LeafSpec.*",
        r".*isinstance\(treespec.*",
        r".*`training_step` returned `None`.*",
        r".*Checkpoint directory .* exists and is not empty.*",
        r".*GPU available but not used.*",
        r".*resuming from a checkpoint that ended before the epoch ended.*",
    ):
        warnings.filterwarnings("ignore", message=pattern)
