"""From what was learned to the twin: clean labels, drop empty slots, refine the screws with everything frozen, name the
joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal, Sequence

import torch
from torch import Tensor

from p2gs.gaussians.handover import Articulation, PartMotions, StateGaussians
from p2gs.losses.base import Loss
from p2gs.models.finish_record import FinishRecord, measure
from p2gs.models.joint_of import constrain, make_joint, name_types
from p2gs.models.together import fit_together
from p2gs.models.tune import TuneConfig, tune
from p2gs.models.twin_labels import (
    clean_labels,
    only,
    rows_as_found,
    settle_labels,
    state_labels,
    surviving_slots,
    with_mass,
)
from p2gs.motion.alternatives import other_angles
from p2gs.motion.directions import shared_axes
from p2gs.motion.joint_confidence import common_level, state_depth
from p2gs.motion.joint_range import extend_ranges
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import PolishConfig
from p2gs.motion.survey import leave_false_minima
from p2gs.ops import se3
from p2gs.parts.askew import keep_axes, lay_axes, on_axes
from p2gs.parts.fronts import weighed_amounts
from p2gs.parts.options import PartMotionsConfig
from p2gs.parts.part_choices import drop_needless, drop_untold, needless, settle_types
from p2gs.surface.closed import FACES
from p2gs.types import ArticulatedObject, GaussianTensors, Part, Similarity

EMPTY = "vanished: no Gaussians of its own, or no motion"


@dataclass
class FinishConfig:
    """Options of the last stage.

    polish: photometric refinement of the screws with hard labels and frozen Gaussians. survey: shifts of a part within
    its own surface that are tried after it (internal units; [] = none). together: then screws and Gaussians at once, if
    photographs prefer it. tune: the Gaussians once more, with the screws frozen. min_mass: a slot with a smaller share
    of the solid Gaussians vanishes. min_motion: likewise one that moves its points by less (internal units).
    part_penalty: share of the image loss in its own pixels that a part with an axis of its own must save against being
    static or one with a part that it touches, as in discovery (0: parts stay). min_confidence: a part whose joint is
    less likely to be right vanishes, but for the only one (0: none does).
    askew: share of the image loss that an axis which is askew to the object's directions must save against one along
    them (0: axes stay), or part_penalty in its own pixels where it is far from them. prismatic_below: a free motion
    (paper's start) that turns by less than this many degrees is a slide, and a turn by less is one unless it explains
    the photographs better by freedom_penalty (share of the image loss), as in discovery. clean_neighbours: labels are
    the majority among this many neighbours at canonical time (0 = as learned). islands: pieces of a part smaller than
    this share of its largest go to what they touch (0 = off).
    trays: views of a state by which drawers' trays are found, what is in or on which goes with the drawer (0 = off).
    exports: simulator formats written at the end of a fit, with meshes and report (empty: neither; `p2gs export` makes
    them later). extend_range: joint limits go on beyond the observed motion until the part touches another one (half a
    turn, the object's diagonal at most); off: they are the observed motion. unclear: Gaussians whose majority exceeds
    the rest by less are shown as such in the diagnosis (0..1). complete: meshes have guesses for what no camera saw
    (undersides, drawers' trays, hidden middles). closed: they are watertight, by a cut. max_faces: triangles of a
    part's closed mesh, as far as half a voxel of error allows. whole: the mesh of the whole is its parts
    "joined", or a surface of its own, made "separate"ly from each state's views, as PARIS, DTA and ArtGS have it.
    cluster: for meshes a moving part keeps only its largest DBSCAN cluster of Gaussians, this the radius (input units;
    0 = off; ArtGS cleans real scans so, with 0.05).
    """

    polish: PolishConfig = field(default_factory=lambda: PolishConfig(min_margin=0.0))
    together: TuneConfig = field(default_factory=TuneConfig)
    tune: TuneConfig = field(default_factory=TuneConfig)
    survey: list[float] = field(default_factory=lambda: [0.03, 0.06, 0.09])
    min_mass: float = 0.002
    min_motion: float = 0.01
    part_penalty: float = PartMotionsConfig.part_penalty
    min_confidence: float = 0.3  # of captures: false parts had 0.27 to 0.29, true ones 0.35 and more
    askew: float = 0.04  # sharp photographs prefer a plain front beside its place by up to 0.036
    prismatic_below: float = 5.0
    freedom_penalty: float = PartMotionsConfig.freedom_penalty
    clean_neighbours: int = 8
    islands: float = 0.25
    trays: int = 16
    exports: list[str] = field(default_factory=lambda: ["urdf", "mjcf", "glb"])
    extend_range: bool = False
    unclear: float = 0.8
    complete: bool = True
    closed: bool = True
    max_faces: int = FACES
    whole: Literal["joined", "separate"] = "joined"
    cluster: float = 0.0


def finish(
    learned: Articulation,
    states: list[StateGaussians],
    views,
    config: FinishConfig,
    similarity: Similarity,
    losses: dict[str, Loss] | None = None,
    discovered: PartMotions | None = None,
    *,
    seed: int,
    backend: str,
    twin_backend: str | None = None,
    device="cpu",
) -> tuple[ArticulatedObject, list[str], FinishRecord]:
    """The twin, one line for each slot that vanished, and what was measured on the way.

    views: photographs by state. discovered: motions of the slots before they were learned; slides that went along one
    direction then may leave it by a degree (``keep_axes``). losses: those of the last training phase, for ``tune``
    (None: it is left out).
    backend: draws the states, twin_backend: the twin in ``tune`` (None: the same).  A part's confidence is
    ``JointEvidence.confidence`` of its joint.
    """
    if discovered is not None and len(discovered) != len(learned.types):
        discovered = None  # slots were asked for
    labels = learned.part_ids
    if discovered is not None:
        labels = rows_as_found(learned, labels, states, discovered, config.polish.free_static)
    labels, alive, notes = _slots(learned, labels, config)
    keep = torch.tensor([k - 1 for k in alive], dtype=torch.int64)
    types, transforms = _typed(learned, labels, keep, config.prismatic_below)
    time = learned.canonical_time
    axes = torch.full((len(types), 3), torch.nan).double()
    if discovered is not None:
        axes = shared_axes(discovered.transforms, discovered.types)[keep]
    options: dict[str, Any] = {"backend": backend, "device": device}
    level = common_level(views)
    stacks = [state_depth(state, views[s], level, **options) for s, state in enumerate(states)]
    twin = assemble(learned.gaussians, labels, types, transforms, time, similarity)
    limits = {"islands": config.islands, "trays": config.trays, "tau": config.polish.free_static or 0.02}
    labels, moved = settle_labels(twin, views, stacks, **limits, backend=twin_backend or backend)
    stay = with_mass(learned.gaussians, labels, len(types), config.min_mass)  # settling may leave next to nothing
    labels, rows = only(labels, stay, len(types)), [k - 1 for k in stay]
    notes += [f"slot {slot} of {len(learned.types)} {EMPTY}" for k, slot in enumerate(alive) if k not in rows]
    alive, types, transforms = [alive[k] for k in rows], [types[k] for k in rows], transforms[rows]
    keep, axes = keep[rows], axes[rows]
    found = [state_labels(learned, labels, s, transforms) for s in states]
    record = FinishRecord(
        [f[0] for f in found], [f[1] for f in found], transforms, transforms, slots=alive, contents=moved
    )
    options["seed"] = seed
    if len(types):
        judge = Judge(None, states, views, config.polish, stacks, **options)
        motions = PartMotions(types, transforms, learned.confidence[keep], record.labels, record.margin)
        refined, axes, record.laid = _refined(judge, motions, axes, config)
        refined, labels, left = _needed(record, judge, refined, learned, labels, axes, config)
        notes += [f"slot {k} of {len(learned.types)} {why}" for k, why in left]
        types, transforms = refined.types, refined.transforms
        record.others = other_angles(judge, refined, config.part_penalty)
    options["backend"] = twin_backend or backend
    gaussians = tune(learned.gaussians, labels, transforms, time, views, losses or {}, config.tune, **options)
    trust = [e.confidence for e in record.evidence]
    twin = assemble(gaussians, labels, types, transforms, time, similarity, trust, record.others)
    if config.extend_range:
        twin.parts = extend_ranges(twin)
    return twin, notes, record


def _slots(learned: Articulation, labels: Tensor, config: FinishConfig) -> tuple[Tensor, list[int], list[str]]:
    """Labels [N], by slot, cleaned and counted by the slots that stay, these slots' numbers, and a line for each that
    vanishes."""
    slots = len(learned.types)
    labels = clean_labels(learned.gaussians, labels, slots + 1, config.clean_neighbours)
    alive = surviving_slots(learned, labels, config.min_mass, config.min_motion)
    gone = [f"slot {k} of {slots} {EMPTY}" for k in range(1, slots + 1) if k not in alive]
    return only(labels, alive, slots), alive, gone


def _typed(learned: Articulation, labels: Tensor, keep: Tensor, below: float) -> tuple[list[str], Tensor]:
    """Joint types of the learned motions ``keep`` and the nearest motions [K, 4, 4] of these types; labels [N] by the
    order of ``keep``."""
    transforms = learned.transforms[keep]
    types = name_types([learned.types[k] for k in keep], transforms, below)
    for k, kind in enumerate(types):
        points = learned.gaussians.means[labels == k + 1].double()
        start = se3.apply(se3.screw_at(transforms[k], -learned.canonical_time), points)
        transforms[k] = constrain(kind, transforms[k], start.mean(0))
    return types, transforms


def _refined(
    judge: Judge, motions: PartMotions, axes: Tensor, config: FinishConfig
) -> tuple[PartMotions, Tensor, list[dict]]:
    """The motions as photographs have them, the directions [K, 3] that joints keep (NaN: none), and the axes that were
    tried along the object's directions; axes [K, 3]: directions that slides share."""
    polished = config.polish.steps > 0
    refined = judge.no_worse(motions, judge.refine(motions)) if polished else motions
    refined, _ = leave_false_minima(judge, refined, config.survey)
    if polished:
        refined = settle_types(judge, refined, config.prismatic_below, config.freedom_penalty)
    refined, held, laid = lay_axes(judge, refined, config.askew, config.part_penalty)
    axes = torch.where(held.isnan(), axes, held)
    return keep_axes(judge, refined, axes), axes, laid


def _needed(
    record: FinishRecord,
    judge: Judge,
    motions: PartMotions,
    learned: Articulation,
    labels: Tensor,
    axes: Tensor,
    config: FinishConfig,
) -> tuple[PartMotions, Tensor, list[tuple[int, str]]]:
    """The motions of the parts that are worth being ones (``_founded``), fitted together with the Gaussians
    (``_with_gaussians``), again without those that then save less than they must; the twin's labels [N], and slot and
    reason of each that vanished."""
    left: list[tuple[int, str]] = []
    for number in count():
        before = len(motions)
        motions, labels, axes, gone = _founded(record, judge, motions, labels, axes, config)
        left += gone
        motions = _with_gaussians(record, judge, motions, learned, labels, axes, config)
        saved = [e.saved for e in record.evidence]
        if not needless(judge.states, motions, saved, config.part_penalty) or (number and len(motions) == before):
            break
    return motions, labels, left


def _founded(
    record: FinishRecord,
    judge: Judge,
    motions: PartMotions,
    labels: Tensor,
    axes: Tensor,
    config: FinishConfig,
) -> tuple[PartMotions, Tensor, Tensor, list[tuple[int, str]]]:
    """The parts that are worth being ones and whose motion photographs tell: their motions, the twin's labels [N], the
    directions that they keep, slot and reason of each that vanished; ``record`` says what was measured of them. axes
    [K, 3]: directions that joints keep (NaN: none)."""
    left: list[tuple[int, str]] = []
    motions, labels, gone = drop_needless(judge, motions, labels, config.part_penalty)
    while True:
        for part in gone:
            left.append((record.slots.pop(part["part"]), f"vanished: {part['why']}"))
            others = torch.arange(len(axes)) != part["part"]
            record.before, axes = record.before[others], axes[others]
        motions = keep_axes(judge, motions, axes) if gone else motions
        record.labels, record.after, record.polish, record.evidence = motions.labels, motions.transforms, {}, []
        if len(motions):
            record.polish = judge.single_ways(motions)
            reach = config.polish.free_moving
            motions, record.fronts = weighed_amounts(judge.states, motions, record.polish, reach)
            record.after = motions.transforms
            measure(record, judge, motions)
        trust = [e.confidence for e in record.evidence]
        motions, labels, gone = drop_untold(judge, motions, labels, trust, config.min_confidence)
        if not gone:
            return motions, labels, axes, left


def _with_gaussians(
    record: FinishRecord,
    judge: Judge,
    motions: PartMotions,
    learned: Articulation,
    labels: Tensor,
    axes: Tensor,
    config: FinishConfig,
) -> PartMotions:
    """The motions as photographs have them when Gaussians bend with them (``fit_together``); slides of a row keep their
    direction, and joints one along the object's that they were laid on. labels [N]: the twin's; axes [K, 3]."""
    if config.polish.steps <= 0:
        return motions
    options: dict[str, Any] = {"seed": judge.seed, "backend": judge.backend, "device": judge.device}
    options |= {"axes": on_axes(motions, axes), "tau": config.polish.free_static}
    options["stacks"] = judge.stacks if config.polish.free_static > 0 else None
    g, time, lambda_ = learned.gaussians, learned.canonical_time, config.polish.ssim_lambda
    fitted, record.together = fit_together(g, labels, motions, time, judge.views, config.together, lambda_, **options)
    if fitted is not motions:
        record.after = fitted.transforms
        measure(record, judge, fitted)
    return fitted


def assemble(
    g: GaussianTensors,
    labels: Tensor,
    types: list[str],
    transforms: Tensor,
    time: float,
    similarity: Similarity,
    confidence: Sequence[float] = (),
    others: Sequence[list[Tensor]] = (),
) -> ArticulatedObject:
    """A twin from Gaussians at canonical ``time``, labels [N], and of each moving part its motion start -> end [K, 4,
    4], confidence (none given: 1) and other motions that explain as much."""
    parts = [Part(0, None, int((labels == 0).sum()))]
    for k, kind in enumerate(types):
        rows = labels == k + 1
        centre = g.means[rows].double().mean(0)
        at_start = se3.apply(se3.screw_at(transforms[k], -time), centre[None])[0]
        joint, *alternatives = (make_joint(kind, T, at_start) for T in [transforms[k], *(others[k] if others else [])])
        trust = confidence[k] if confidence else 1.0
        parts.append(Part(k + 1, joint, int(rows.sum()), trust, tuple(alternatives)))
    return ArticulatedObject(g, labels, parts, time, similarity)
