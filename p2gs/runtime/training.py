"""One training phase with a Lightning Trainer of its own, from its checkpoint where it was interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional

import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.plugins.environments import LightningEnvironment  # pyright: ignore[reportPrivateImportUsage]

from p2gs.config.trainer import trainer_arguments
from p2gs.context import RunContext
from p2gs.gaussians.sealed import check_seal
from p2gs.models.phase import Phase
from p2gs.models.stage import Stage
from p2gs.stopping import at_step_ends


def train(run: RunContext, cls: type[Stage], stage: str, section: Any, key: str, given: dict) -> Any:
    """What the phase hands over. stage: its name in the result folder (``single_state_0``).  section: its part of the
    config."""
    seed_everything(run.seed, verbose=False)
    phase: Phase = cls.build(run, section, **given)
    phase.phase_name = stage
    phase.save_hyperparameters({"stage": stage, "key": key})
    callbacks = section.new_callbacks()
    for callback in callbacks.values():
        callback.prepare(run.cfg, run.scene)
    order = sorted(callbacks, key=lambda n: (not callbacks[n].changes_result, n == "checkpoint"))
    if phase.total_steps <= 0:
        return phase.hand_over()
    arguments = trainer_arguments(run.cfg.trainer, run.run_dir, stage)
    arguments["callbacks"] = [*(callbacks[n] for n in order), *arguments["callbacks"]]
    trainer = Trainer(
        max_steps=phase.total_steps,
        accelerator="gpu" if run.device.type == "cuda" else "cpu",
        default_root_dir=run.run_dir,
        # on SLURM, too: a run is one process, and resumes from its own checkpoints alone
        plugins=[LightningEnvironment()],
        **arguments,
    )
    with at_step_ends():
        trainer.fit(phase, datamodule=run.cfg.data, ckpt_path=resumable(run.run_dir, stage, key), weights_only=True)
    if trainer.global_step < phase.total_steps:
        raise KeyboardInterrupt
    return phase.cpu().hand_over()


def resumable(run_dir: Path, stage: str, key: str) -> Optional[str]:
    """The training state an interrupted stage goes on from, when it is of this very key."""
    path = run_dir / "checkpoints" / f"{stage}.ckpt"
    if not path.exists():
        return None
    try:
        check_seal(path)
        stored = torch.load(path, weights_only=True)["hyper_parameters"]
    except OSError:
        raise
    except Exception as err:
        print(f"{stage}: {path} is damaged ({err}); starting this stage anew", flush=True)
        return None
    if stored.get("key") != key:
        print(f"{stage}: {path} is of other options, code or photographs; starting this stage anew", flush=True)
        return None
    print(f"{stage}: going on from {path}", flush=True)
    return str(path)
