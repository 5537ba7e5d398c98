"""Each state once more, drawn with sharp pixels: surfaces out to where they are, before the states are joined and
joints polished.

With 3DGS's pixels (0.3 pixels^2 added to every Gaussian) and thick Gaussians a surface seen edge-on is a stack of faint
rims. So that outlines come out right, training draws surfaces 0.4 to 0.8 pixels inward, more where a state shows them
as outlines: a door's free edge when open, not when shut. Joints measured between the two are off by that. The loss
``depth_variance`` does its share (it would have rims thin, too), so it is not for this phase, which is too short for
fog to come back. Parts are found before, in Gaussians as 3DGS leaves them: how well both states' static surfaces agree
sets the scale of that search, and moving ones gain less from sharp pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from p2gs.context import RunContext
from p2gs.data.base import Visit
from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import StateGaussians
from p2gs.gaussians.splats import Splats
from p2gs.losses.base import Loss, LossInputs
from p2gs.models.phase import register_phase
from p2gs.models.single_state import ImageConfig, SplatRates, StatePhase
from p2gs.render import with_pixels


@dataclass
class SharpenConfig(ImageConfig):
    """Options of sharpening. steps: of each state (0 = off: all stages draw with the pixels of ``rasterizer``).
    pixels: what this phase, fusion, articulation and the last polish draw with ("sharp": ``rasterize(eps2d=0.1,
    antialias=True)``); the twin itself is fitted in the end with those of ``rasterizer``, so that any 3DGS viewer shows
    it as it is.
    """

    steps: int = 300
    pixels: Literal["sharp", "classic"] = "sharp"
    levels: list[int] = field(default_factory=lambda: [400])
    level_starts: list[float] = field(default_factory=lambda: [0.0])
    rates: SplatRates = field(default_factory=lambda: SplatRates(1.5e-4, 1.2e-5, 1.5e-2, 6e-2, 3e-3, 6e-3, 6e-4))

    def backend(self, rasterizer: str) -> str:
        """``rasterizer`` with the pixels of the stages from here to the polish."""
        return with_pixels(rasterizer, self.pixels) if self.steps > 0 else rasterizer


@register_phase("sharpen")
class SharpenPhase(StatePhase):
    """One state's Gaussians, all of them and in their order: labels of discovery stay theirs."""

    Config = SharpenConfig
    needs = ("states",)
    gives = "sharpened"
    each_state = True
    num_parts_matters = False
    picture_name = "sharpen"

    @classmethod
    def build(cls, run: RunContext, section, *, states: list[StateGaussians], state: int) -> "SharpenPhase":
        return cls(section.config, section.losses, states[state], run.views_of(state), **run.common())

    def __init__(
        self, config: SharpenConfig, losses: dict[str, Loss], state: StateGaussians, views: TrainingViews, **common
    ):
        super().__init__(config, losses, state.state, views, **common)
        self.splats = Splats(state.gaussians)

    def inputs(self, visit: Visit) -> LossInputs:
        camera, target = self.target(visit)
        g = self.splats.tensors()
        render = self.render(g, camera, target.background)
        return LossInputs(visit.step, self.total_steps, g, render, target, camera, cache=self.loss_cache)

    def hand_over(self) -> StateGaussians:
        return StateGaussians(self.state, self.splats.tensors().clone())
