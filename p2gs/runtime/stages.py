"""The stages of a run that are no class of their own in ``models``: discovery, a function there, and the finish, which writes files."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from p2gs.models.context import RunContext
from p2gs.models.finish import FinishConfig, finish
from p2gs.models.handover import Articulation, CanonicalGaussians, PartMotions, StateGaussians
from p2gs.models.part_motions import DiscoveryStage as DiscoveryOptions
from p2gs.models.part_motions import find_part_motions
from p2gs.models.slots import merge_to, slot_report
from p2gs.models.stage import Stage, register_phase


@register_phase("discovery")
class DiscoveryStage(DiscoveryOptions, Stage):
    """Parts and motions, from the reconstructions of both states and the photographs. Takes the place of the bare options."""

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


@register_phase("finish")
class FinishStage(Stage):
    """The twin and the result folder; hands over what a later run needs to know of it."""

    Config = FinishConfig
    needs = ("states", "canonical", "learned")
    uses = ("sharpened", "motions")
    gives = "twin"

    @classmethod
    def complete(cls, run: RunContext) -> bool:
        return (run.run_dir / "twin.json").exists()

    @classmethod
    def compute(
        cls,
        run: RunContext,
        section,
        *,
        states: list[StateGaussians],
        canonical: CanonicalGaussians,
        learned: Articulation,
        sharpened: list[StateGaussians] | None = None,
        motions: PartMotions | None = None,
    ) -> dict:
        from p2gs.export.contents import in_trays
        from p2gs.export.diagnostics_page import write_diagnosis
        from p2gs.export.run_folder import complete_run, write_twin
        from p2gs.models.diagnosis import StageResults

        config, found_in, states = section.config, states, sharpened or states
        backend = {"backend": run.backend, "twin_backend": run.rasterizer, "device": run.device}
        losses = run.losses("articulation")
        obj, notes, record = finish(
            learned, states, run.views, config, run.scene.similarity, losses, seed=run.seed, contents=in_trays, **backend
        )
        for note in notes:
            print(note, flush=True)
        stages = StageResults(found_in, motions, states, canonical, learned, record, notes)
        write_diagnosis(run.run_dir, stages, obj, run.views, min_margin=config.unclear, **backend)
        write_twin(obj, run.run_dir, run.scene)
        if run.exact:
            report = slot_report(learned, obj, record.slots, len(motions))
            (run.run_dir / "slots.json").write_text(json.dumps(report, indent=1) + "\n")
        if config.exports:
            complete_run(run.run_dir, config.exports, log=partial(print, flush=True))
        return {"parts": len(obj.parts), "notes": notes, "joints": [e.as_dict() for e in record.evidence]}
