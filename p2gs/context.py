"""What a phase may ask of the run it is in: scene, photographs, device, and the options that concern every phase."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from p2gs.data.views import TrainingViews
from p2gs.types import TwoStateScene, UserError


class RunContext:
    """One run as its phases see it.

    cfg: the run's ``RunConfig``.  device: what tensors are computed on.  seed, rasterizer, num_parts (int or "auto"):
    of the config.
    """

    def __init__(self, cfg: Any, device: torch.device):
        self.cfg, self.device = cfg, device
        self.seed: int = cfg.seed
        self.rasterizer: str = cfg.rasterizer
        self.num_parts = cfg.num_parts
        self.run_dir: Path = cfg.run_dir
        self._views: dict[int, TrainingViews] = {}
        self._scene: TwoStateScene | None = None

    # -- options ------------------------------------------------------------------------------------------------------
    def config(self, phase: str) -> Any:
        """Another phase's options; its defaults where the run does not have it."""
        return self.cfg.phase_config(phase)

    def losses(self, phase: str) -> dict:
        """Another phase's losses by name; none where the run does not have it."""
        return self.cfg.phases[phase].losses if phase in self.cfg.phases else {}

    @property
    def init(self) -> str:
        """What articulation starts from."""
        return self.config("articulation").init

    @property
    def exact(self) -> bool:
        """Whether ``num_parts`` is the number of slots beside discovery, not a limit for it."""
        return self.cfg.exact_parts and self.init == "discovery"

    @property
    def backend(self) -> str:
        """What draws from sharpening to the last polish; ``rasterizer`` draws before and the twin itself."""
        return self.config("sharpen").backend(self.rasterizer) if "sharpen" in self.cfg.stages else self.rasterizer

    def common(self) -> dict:
        """The keyword arguments that every ``Phase`` takes."""
        return {"seed": self.seed, "rasterizer": self.backend}

    def log(self, phase: str, *text: object) -> None:
        """A line of progress."""
        print(f"{phase}:", *text, flush=True)

    # -- scene --------------------------------------------------------------------------------------------------------
    @property
    def scene(self) -> TwoStateScene:
        """As read, until phases find errors of cameras and exposures, or register the end to the start; corrected from
        then on."""
        return self._scene or self.cfg.data.scene()

    @property
    def scene_as_read(self) -> TwoStateScene:
        return self.cfg.data.scene()

    def take(self, scene: TwoStateScene) -> None:
        """The scene from here on, where it is another one."""
        if scene is not self.scene:
            self._scene = scene
            self._views.clear()

    @property
    def extent(self) -> float:
        """Diagonal of the object's box, internal units."""
        box = self.scene.box
        assert box is not None  # every scene that is trained on has one
        return float((box[1] - box[0]).norm())

    @property
    def views(self) -> dict[int, TrainingViews]:
        """Training views of both states."""
        return {state: self.views_of(state) for state in (0, 1)}

    def views_of(self, state: int) -> TrainingViews:
        """Training views of a state, at every size a stage asks for; made once."""
        if state not in self._views:
            views = self.scene.select(state=state, split="train")
            if not views:
                name, both = self.scene.name, "expected photographs of both states"
                raise UserError(f"{name}: there are no training views of state {state}; {both}")
            sizes = set().union(*(levels_of(self.cfg.phases[name].config) for name in self.cfg.stages))
            self._views[state] = TrainingViews(views, sorted(sizes))
        return self._views[state]


def levels_of(config: Any) -> set[int]:
    """Every image size named in a config or in the configs inside it."""
    sizes: set[int] = set(getattr(config, "levels", ()))
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            sizes |= levels_of(value)
    return sizes
