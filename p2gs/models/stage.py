"""How a phase takes part in a run: what it needs of the phases before it, by name, and what it hands over.

The phases of a run are the config's ``stages``, in that order. What each hands over lies under a name, where later
phases find it; a phase that gives a name anew replaces it for those after it. The names of the built-in phases:

    states        two ``StateGaussians`` (start, end), registered to the start's frame
    registration  the ``Registration`` by which they are
    motions       ``PartMotions`` of discovery, None where articulation starts without
    sharpened     the states once more, the same Gaussians sharpened
    canonical     ``CanonicalGaussians``
    learned       ``Articulation``
    twin          what the finish wrote
"""

from __future__ import annotations

from typing import Any, ClassVar

from p2gs.context import RunContext
from p2gs.registry import Registry


class Stage:
    """Base of every phase. One that trains is a ``Phase`` and gives ``build``; one that computes gives ``compute``.

    Config: dataclass of its options.  needs: names that earlier phases must have handed over.  uses: names given as
    None where no phase hands them over.  gives: name of its own result.  each_state: it runs once for the start and
    once for the end, and its result is the list of both.  num_parts_matters: whether ``num_parts`` decides its result.
    changes_scene: whether ``hand_on`` gives the run another scene, on which all phases after it then build.
    """

    Config: type
    phase_name: str = "phase"
    trained: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()
    uses: ClassVar[tuple[str, ...]] = ()
    gives: ClassVar[str] = ""
    each_state: ClassVar[bool] = False
    num_parts_matters: ClassVar[bool] = True
    changes_scene: ClassVar[bool] = False

    @classmethod
    def build(cls, run: RunContext, section: Any, **given: Any) -> Any:
        """The ``Phase`` to train. section: its ``config`` and ``losses``.  given: what ``needs`` and ``uses`` name (and
        ``state``, 0 or 1)."""
        raise NotImplementedError(f"{cls.__name__} trains and has to define build()")

    @classmethod
    def compute(cls, run: RunContext, section: Any, **given: Any) -> Any:
        """The result of a phase that does not train: a dataclass of ``gaussians.handover``, or plain values. Arguments
        as of ``build``."""
        raise NotImplementedError(f"{cls.__name__} does not train and has to define compute()")

    @classmethod
    def wanted(cls, run: RunContext) -> bool:
        """Whether this run's config asks for the phase at all; of one that is left out, ``gives`` is None."""
        return True

    @classmethod
    def complete(cls, run: RunContext) -> bool:
        """Whether what it writes beside its result is still there; else it runs again."""
        return True

    @classmethod
    def hand_on(cls, run: RunContext, value: Any, **given: Any) -> dict[str, Any]:
        """What later phases find, by name; also in a run that took the result from its file. May change the run's
        scene."""
        return {cls.gives: value}

    @classmethod
    def num_parts_key(cls, run: RunContext) -> Any:
        """The part of ``num_parts`` and ``exact_parts`` that decides the result (plain values)."""
        return {"num_parts": run.num_parts, "exact_parts": run.exact}


PHASES: Registry[type[Stage]] = Registry("phase")


def register_phase(name: str):
    """Decorator: register a phase and tell it its name."""
    if name.endswith(("_0", "_1")):
        raise ValueError(f"phase '{name}': names that end in _0 or _1 are those of the two states' runs of a phase")

    def wrap(cls):
        cls.phase_name = name
        return PHASES.register(name)(cls)

    return wrap
