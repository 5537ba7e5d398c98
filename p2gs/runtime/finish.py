"""The last stage of a run: the twin, its diagnosis and the result folder. Here, not in ``models``, because it writes
exports."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

from p2gs.context import RunContext
from p2gs.gaussians.handover import Articulation, CanonicalGaussians, PartMotions, StateGaussians
from p2gs.models.finish import FinishConfig, finish
from p2gs.models.stage import Stage, register_phase
from p2gs.parts.slots import slot_report


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
        from p2gs.diagnosis.measures import StageResults
        from p2gs.diagnosis.page import write_diagnosis
        from p2gs.export.run_folder import complete_run, write_twin

        config, found_in, states = section.config, states, sharpened or states
        if run.exact:
            config = replace(config, part_penalty=0.0, min_confidence=0.0)  # as many slots as were asked for
        backend = {"backend": run.backend, "twin_backend": run.rasterizer, "device": run.device}
        losses = run.losses("articulation")
        obj, notes, record = finish(
            learned,
            states,
            run.views,
            config,
            run.scene.similarity,
            losses,
            motions,
            seed=run.seed,
            **backend,
        )
        for note in notes:
            print(note, flush=True)
        stages = StageResults(found_in, motions, states, canonical, learned, record, notes)
        write_diagnosis(run.run_dir, stages, obj, run.views, min_margin=config.unclear, **backend)
        write_twin(obj, run.run_dir, run.scene)
        if run.exact and motions is not None:
            report = slot_report(learned, obj, record.slots, len(motions))
            (run.run_dir / "slots.json").write_text(json.dumps(report, indent=1) + "\n")
        if config.exports:
            complete_run(run.run_dir, config.exports, log=partial(print, flush=True))
        return {"parts": len(obj.parts), "notes": notes, "joints": [e.as_dict() for e in record.evidence]}
