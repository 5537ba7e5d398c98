"""Every key that the config of a run may have: its top-level options, the data's, and a section a phase, loss and
callback."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Optional, Union

from p2gs.callbacks.base import CALLBACKS
from p2gs.config.schema import Keys, keys_of
from p2gs.data.base import DATASETS, TwoStateData
from p2gs.losses.base import LOSSES
from p2gs.models.phase import PHASES
from p2gs.registry import suggest
from p2gs.types import UserError, short

STAGES = ("single_state", "registration", "sharpen", "discovery", "canonical_fusion", "articulation", "finish")


@dataclass(eq=False)
class Options:
    """Top-level options of a run.

    seed: every random choice is a function of it.  run: result folder, default runs/<scene>.  device: auto takes CUDA
    where there is one.  threads: of the CPU kernels, and of torch outside training steps, default all cores.
    rasterizer: a registered backend or auto.  num_parts: including the static base; auto finds out, and a number is the
    most that discovery may find. exact_parts: num_parts is the number of slots instead: of more parts found the alike
    become one, fewer get spare slots beside them. plugins: modules that register losses, callbacks, phases, ...
    stages: phases in the order in which they run, each of which ``phases`` has to mention.
    strict_paths: files of the scene that lead out of its folder are refused; they are only named else.
    trainer: what goes to each phase's Lightning Trainer.
    """

    seed: int = 0
    run: Optional[str] = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: Optional[int] = None
    rasterizer: str = "auto"
    num_parts: Union[int, Literal["auto"]] = "auto"
    exact_parts: bool = False
    plugins: list[str] = field(default_factory=list)
    stages: list[str] = field(default_factory=lambda: list(STAGES))
    strict_paths: bool = False
    trainer: Optional[dict] = field(default_factory=dict)

    def __post_init__(self):
        self.trainer = self.trainer or {}
        if self.run is not None and "\0" in self.run:
            raise UserError(f"run: expected a folder, got {short(self.run)}")
        if not 0 <= self.seed < 2**32:
            raise UserError(f"seed: expected a whole number from 0 to {2**32 - 1}, got {short(self.seed)}")
        if self.num_parts != "auto" and self.num_parts < 2:
            raise UserError(f"num_parts: expected at least 2 (it counts the static base), got {self.num_parts}")
        if self.exact_parts and self.num_parts == "auto":
            raise UserError("exact_parts: true needs a number of parts (--num_parts N)")
        if self.threads is not None and self.threads < 1:
            raise UserError(f"threads: expected at least 1, got {self.threads}")


def run_keys(data_format: Optional[str]) -> Keys:
    """All keys a config may have, given the data format and what is registered by now.

    A phase whose class says ``trained = False`` has neither losses nor callbacks. Raises UserError for an unknown
    format.
    """
    losses = {name: keys_of(cls) for name, cls in LOSSES.items()}
    callbacks = {name: keys_of(cls) for name, cls in CALLBACKS.items()}
    phases = {}
    for name, cls in PHASES.items():
        inner = {"losses": losses, "callbacks": callbacks} if getattr(cls, "trained", True) else {}
        both = inner.keys() & keys_of(cls.Config).keys()
        if both:
            raise TypeError(
                f"{cls.__qualname__}.Config: '{both.pop()}' is a section of every phase and cannot be a field"
            )
        phases[name] = {**keys_of(cls.Config), **inner}
    data = {"format": None, **keys_of(data_class(data_format))}
    return {**keys_of(Options), "p2gs": None, "data": data, "phases": phases, "callbacks": callbacks}


def data_class(name: Optional[str]) -> type:
    """The class of a data format; of none, the options that every source of photographs has."""
    if name is not None and name not in DATASETS:
        raise UserError(f"data.format: there is no '{name}'{suggest(name, list(DATASETS))}")
    return TwoStateData if name is None else DATASETS[name]
