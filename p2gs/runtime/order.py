"""The phases of a run in their order, checked before anything is computed."""

from __future__ import annotations

from typing import Any

from p2gs.context import RunContext
from p2gs.models.stage import PHASES, Stage
from p2gs.registry import suggest
from p2gs.types import UserError


def stage_order(run: RunContext) -> dict[str, type[Stage]]:
    """Name -> phase for the config's ``stages``. Raises UserError for a name that is unknown, given twice or without
    options, for a phase with options that is no stage, and for one whose ``needs`` no stage before it hands over.
    """
    names, phases = run.cfg.stages, run.cfg.phases
    for name in names:
        if name not in PHASES:
            raise UserError(f"stages: there is no phase '{name}'{suggest(name, PHASES)}")
        if names.count(name) > 1:
            raise UserError(f"stages: '{name}' is named twice; a phase runs once")
    missing = [name for name in names if name not in phases]
    if missing:
        raise UserError(
            f"phases.{missing[0]} is not in the config; expected options ({{}} for its defaults) of each of the stages "
            f"{', '.join(names)} (start from -c configs/preset/cpu.yaml)"
        )
    idle = [name for name in phases if name not in names]
    if idle:
        raise UserError(
            f"phases.{idle[0]} is in the config but not among the stages ({', '.join(names)}), so it would never run; "
            f"add it to stages, or switch it off (phases.{idle[0]}: null)"
        )
    order = {name: PHASES[name] for name in names}
    given: dict[str, str] = {}
    for name, phase in order.items():
        check_declaration(name, phase)
        lacking = [what for what in phase.needs if what not in given]
        if lacking:
            giver = next((n for n, p in order.items() if p.gives == lacking[0]), None)
            after = f" ({giver} does, and comes later)" if giver else ""
            raise UserError(f"stages: {name} needs '{lacking[0]}', which no stage before it hands over{after}")
        given[phase.gives] = name
    return order


def check_declaration(name: str, phase: Any) -> None:
    """Raise UserError where a registered class does not say how it takes part in a run."""
    if not (isinstance(phase, type) and issubclass(phase, Stage)):
        expected = "a subclass of p2gs.models.phase.Phase or Stage"
        raise UserError(f"phase '{name}': {phase.__name__} is no Stage; expected {expected}")
    if not phase.gives:
        raise UserError(f"phase '{name}': {phase.__name__} does not say what it hands over (gives = \"NAME\")")
    hook = "build" if phase.trained else "compute"
    if getattr(phase, hook).__func__ is getattr(Stage, hook).__func__:
        does = "trains" if phase.trained else "does not train"
        raise UserError(f"phase '{name}': {phase.__name__} {does} and has to define {hook}()")
