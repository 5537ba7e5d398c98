"""What the last stage measures of its motions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.joint_confidence import JointEvidence, common_level, measure_joints
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import losses_both_ways
from p2gs.parts.part_choices import own_shares


@dataclass
class FinishRecord:
    """What the last stage measured, for the diagnosis.

    labels, margin: of the Gaussians of both states (ids as in the twin).  before, after [K-1, 4, 4]: motions around the
    polish (start -> end, internal units); polish: ``Judge.single_ways`` ({} without polish).  costs: image loss of the
    start's Gaussians in the end's photographs and the reverse, as {"before": [2], "after": [2]}.  evidence: per joint.
    together: image loss with screws held and free (``fit_together``; {}: not tried).
    laid: axes that were tried along the object's directions (``lay_axes``).  fronts: of slides, what their fronts said
    (``weighed_amounts``).  slots: the learned slot of each part.
    contents: Gaussians that became a drawer's because they are on or in its tray.  others: per joint, motions that
    explain the photographs as well (``other_angles``).
    """

    labels: list[Tensor]
    margin: list[Tensor]
    before: Tensor
    after: Tensor
    polish: dict = field(default_factory=dict)
    costs: dict[str, list[float]] = field(default_factory=dict)
    evidence: list[JointEvidence] = field(default_factory=list)
    others: list[list[Tensor]] = field(default_factory=list)
    slots: list[int] = field(default_factory=list)
    contents: int = 0
    laid: list[dict] = field(default_factory=list)
    fronts: list[dict] = field(default_factory=list)
    together: dict[str, float] = field(default_factory=dict)


def measure(record: FinishRecord, judge: Judge, motions: PartMotions) -> None:
    """Fill in ``costs`` and ``evidence`` of the final motions, at the states' ``common_level``."""
    states, views = judge.states, judge.views
    options = {"level": common_level(views), "backend": judge.backend, "device": judge.device}
    for name, T in (("before", record.before), ("after", record.after)):
        record.costs[name] = losses_both_ways(states, record.labels, T, views, count=8, **options)
    both = [record.polish[w] for w in ("forward", "backward")] if "backward" in record.polish else None
    known = [m >= 0 for m in record.margin]
    shown = [replace(s, gaussians=s.gaussians[k]) for s, k in zip(states, known, strict=True)]
    labels = [x[k] for x, k in zip(record.labels, known, strict=True)]
    found = measure_joints(shown, labels, record.after, motions.types, views, judge.stacks, both=both, **options)
    record.evidence = [replace(e, saved=own) for e, own in zip(found, own_shares(judge, motions), strict=True)]
