"""Discovery as a stage of a run; ``models.part_motions`` has what it does."""

from __future__ import annotations

from functools import partial
from typing import Any

from p2gs.context import RunContext
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.models.part_discovery import DiscoveryStage as DiscoveryOptions
from p2gs.models.part_discovery import find_part_motions
from p2gs.models.stage import Stage, register_phase
from p2gs.parts.slots import merge_to


@register_phase("discovery")
class DiscoveryStage(DiscoveryOptions, Stage):  # pyright: ignore[reportGeneralTypeIssues]
    """Parts and motions, from both states' reconstructions and photographs. Takes the place of the bare options."""

    needs = ("states",)
    gives = "motions"

    @classmethod
    def wanted(cls, run: RunContext) -> bool:
        return run.init == "discovery"

    @classmethod
    def num_parts_key(cls, run: RunContext) -> Any:
        """With ``exact_parts`` discovery finds what there is; later stages take it to the number that was asked for."""
        return "auto" if run.exact else run.num_parts

    @classmethod
    def compute(cls, run: RunContext, section, *, states: list[StateGaussians]) -> PartMotions:
        return find_part_motions(
            states,
            run.scene,
            run.views,
            "auto" if run.exact else run.num_parts,
            section.config,
            seed=run.seed,
            backend=run.rasterizer,
            device=run.device,
            report=partial(run.log, cls.phase_name),
        )

    @classmethod
    def hand_on(cls, run: RunContext, value: PartMotions, *, states: list[StateGaussians]) -> dict:
        if run.exact:
            value, notes = merge_to(value, states, run.num_parts)
            for note in notes:
                print(note, flush=True)
        return {cls.gives: value}
