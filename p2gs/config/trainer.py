"""``trainer:`` of the config: what goes to each phase's Lightning Trainer, and what cannot.

trainer:
  logger: {class_path: CSVLogger}                  # or a list of them, or false; default TensorBoard in RUN/logs
  callbacks: [{class_path: my_module.MyCallback}]  # Lightning callbacks, beside those of ``callbacks``
  profiler: simple
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from p2gs.config.class_path import instance
from p2gs.registry import suggest
from p2gs.types import UserError, short

STEPS = "a phase's steps are phases.NAME.steps"
OWN_OPTIMISER = "phases step an optimiser of their own, Gaussian by Gaussian"
DEVICE = "a run is one process on one device: --device cpu|cuda"
REFUSED = {
    **dict.fromkeys(("max_steps", "max_epochs", "min_steps", "min_epochs", "max_time", "limit_train_batches"), STEPS),
    **dict.fromkeys(("fast_dev_run", "overfit_batches"), f"{STEPS}; -c preset/smoke.yaml takes few everywhere"),
    **dict.fromkeys(("gradient_clip_val", "gradient_clip_algorithm", "accumulate_grad_batches"), OWN_OPTIMISER),
    **dict.fromkeys(
        ("accelerator", "devices", "strategy", "num_nodes", "sync_batchnorm", "use_distributed_sampler", "plugins"),
        DEVICE,
    ),
    "default_root_dir": "the result folder is --run DIR",
    "barebones": "it leaves out the callbacks that keep a run's state",
}
FULL_PRECISION = ("32", "32-true", 32, None)
SHOWN = ("enable_progress_bar", "enable_model_summary", "enable_checkpointing")
WATCHING = ("logger", "profiler", "log_every_n_steps", "detect_anomaly", "enable_autolog_hparams", *SHOWN)
FIXED = {"max_epochs": -1, "devices": 1, "num_sanity_val_steps": 0, **dict.fromkeys(SHOWN, False)}


def check_trainer_options(options: dict[str, Any]) -> None:
    """Raise UserError for an argument that the Trainer does not have, and for one that cannot work here."""
    from lightning.pytorch import Trainer

    known = [name for name in inspect.signature(Trainer.__init__).parameters if name != "self"]
    for name, value in options.items():
        if name in REFUSED:
            raise UserError(f"trainer.{name}: cannot be set: {REFUSED[name]}")
        if name not in known:
            near = suggest(str(name), [n for n in known if n not in REFUSED])
            raise UserError(f"trainer: Lightning's Trainer has no '{name}'{near}")
        if name == "precision" and value not in FULL_PRECISION:
            only = "Gaussians are trained in float32, which is all that the kernels know"
            raise UserError(f"trainer.precision: {only}, got {short(value)}")
        if name in ("logger", "callbacks") and not isinstance(value, (bool, list, dict, str, type(None))):
            raise UserError(f"trainer.{name}: expected {{class_path, init_args}} or a list of them, got {short(value)}")


def decides_result(options: dict[str, Any]) -> dict[str, Any]:
    """The options that may change what is learned."""
    return {name: value for name, value in options.items() if name not in WATCHING and name != "precision"}


def callback_modules(options: dict[str, Any]) -> set[str]:
    """The modules of ``callbacks`` that are not Lightning's own: their code may decide the result."""
    values = options.get("callbacks") or []
    values = values if isinstance(values, list) else [values]
    paths = [str(v.get("class_path", "") if isinstance(v, dict) else v) for v in values]
    own = [path for path in paths if not path.startswith(("lightning.", "pytorch_lightning."))]
    return {path.rpartition(".")[0] for path in own if "." in path}


def trainer_arguments(options: dict[str, Any], run_dir: Path, stage: str) -> dict[str, Any]:
    """The Trainer's keyword arguments of a stage; ``callbacks`` are the config's own alone. Raises UserError."""
    check_trainer_options(options)
    made = FIXED | {k: v for k, v in options.items() if k not in ("logger", "callbacks", "profiler", "precision")}
    return made | {
        "logger": loggers(options.get("logger", True), run_dir, stage),
        "callbacks": lightning_callbacks(options.get("callbacks")),
        "profiler": profiler(options.get("profiler"), run_dir, stage),
    }


def loggers(value: Any, run_dir: Path, stage: str) -> Any:
    """TensorBoard's by default; files go to RUN/logs where the class has a ``save_dir`` and none is given."""
    from lightning.pytorch.loggers import Logger, TensorBoardLogger

    if value is True:
        return TensorBoardLogger(run_dir / "logs", name=stage, version="", default_hp_metric=False)
    if value in (False, None):
        return False
    defaults = {"save_dir": str(run_dir / "logs"), "name": stage, "version": "", "default_hp_metric": False}
    values = value if isinstance(value, list) else [value]
    named = [f"trainer.logger.{i}" if isinstance(value, list) else "trainer.logger" for i in range(len(values))]
    return [instance(v, Logger, where, **defaults) for v, where in zip(values, named, strict=True)]


def lightning_callbacks(value: Any) -> list:
    """Callbacks by class_path, fresh for each stage."""
    from lightning.pytorch import Callback

    values = value if isinstance(value, list) else [] if value is None else [value]
    return [instance(v, Callback, f"trainer.callbacks.{i}") for i, v in enumerate(values)]


def profiler(value: Any, run_dir: Path, stage: str) -> Any:
    """simple, advanced or pytorch, or a class; reports go to RUN/logs."""
    from lightning.pytorch import profilers

    if value is None:
        return None
    short_names = {"simple": "SimpleProfiler", "advanced": "AdvancedProfiler", "pytorch": "PyTorchProfiler"}
    value = short_names.get(value, value) if isinstance(value, str) else value
    defaults = {"dirpath": str(run_dir / "logs"), "filename": f"profile_{stage}"}
    return instance(value, profilers.Profiler, "trainer.profiler", **defaults)
