"""From what was learned to the twin: clean labels, drop empty slots, refine the screws with everything frozen, name the
joints."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, Sequence

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import Articulation, PartMotions, StateGaussians
from p2gs.gaussians.pose import carry, with_static
from p2gs.losses.base import Loss
from p2gs.models.tune import TuneConfig, tune
from p2gs.motion.directions import shared_axes
from p2gs.motion.joint_confidence import JointEvidence, common_level, measure_joints, state_depth
from p2gs.motion.joint_range import extend_ranges
from p2gs.motion.refine_motions import Judge, single_ways
from p2gs.motion.screw_polish import PolishConfig, photometric_cost
from p2gs.motion.survey import leave_false_minima
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.parts.askew import keep_shared, lay_axes
from p2gs.parts.islands import settle_twin_islands
from p2gs.parts.options import PartMotionsConfig
from p2gs.parts.part_choices import drop_needless, own_shares, settle_types
from p2gs.surface.contents import in_trays
from p2gs.types import ArticulatedObject, GaussianTensors, Joint, Part, Similarity
from p2gs.visibility.depth_stack import DepthStack

UNKNOWN = 4.0  # a state's Gaussian farther than this from the twin, in the median's units, is none of the twin's


@dataclass
class FinishConfig:
    """Options of the last stage.

    polish: photometric refinement of the screws with hard labels and frozen Gaussians. survey: shifts of a part within
    its own surface that are tried after it (internal units; [] = none). tune: then the Gaussians once more, with the
    screws frozen. min_mass: a slot with a smaller share of the solid Gaussians vanishes. min_motion: likewise one that
    moves its points by less (internal units).
    part_penalty: share of the image loss in its own pixels that a part with an axis of its own must save against being
    static or one with a part that it touches, as in discovery (0: parts stay).
    askew: share of the image loss that an axis which is askew to the object's directions must save against one along
    them (0: axes stay). prismatic_below: a free motion (paper's start) that turns by less than this many degrees is a
    slide, and a turn by less is one unless it explains the photographs better by freedom_penalty (share of the image
    loss), as in discovery. clean_neighbours: labels are the majority among this many neighbours at canonical time (0 =
    as learned). islands: pieces of a part smaller than this share of its largest go to what they touch (0 = off).
    trays: views of a state by which drawers' trays are found, what is in or on which goes with the drawer (0 = off).
    exports: simulator formats written at the end of a fit, with meshes and report (empty: neither; `p2gs export` makes
    them later). extend_range: joint limits go on beyond the observed motion until the part touches another one (half a
    turn, the object's diagonal at most); off: they are the observed motion. unclear: Gaussians whose majority exceeds
    the rest by less are shown as such in the diagnosis (0..1). complete: meshes have guesses for what no camera saw
    (undersides, drawers' trays, hidden middles). closed: they are watertight, by a cut; a sheet that hangs in an
    opening gets two sides (CD static of five objects 1.23 open, 1.38 closed). whole: the mesh of the whole is its parts
    "joined", or a surface of its own, made "separate"ly from each state's views, as PARIS, DTA and ArtGS have it.
    cluster: for meshes a moving part keeps only its largest DBSCAN cluster of Gaussians, this the radius (input units;
    0 = off; ArtGS cleans real scans so, with 0.05).
    """

    polish: PolishConfig = field(default_factory=lambda: PolishConfig(min_margin=0.0))
    tune: TuneConfig = field(default_factory=TuneConfig)
    survey: list[float] = field(default_factory=lambda: [0.03, 0.06, 0.09])
    min_mass: float = 0.002
    min_motion: float = 0.01
    part_penalty: float = PartMotionsConfig.part_penalty
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
    closed: bool = False
    whole: Literal["joined", "separate"] = "joined"
    cluster: float = 0.0


@dataclass
class FinishRecord:
    """What the last stage measured, for the diagnosis.

    labels, margin: of the Gaussians of both states (ids as in the twin).  before, after [K-1, 4, 4]: motions around the
    polish (start -> end, internal units); polish: ``single_ways`` ({} without polish).  costs: image loss of the
    start's Gaussians in the end's photographs and the reverse, as {"before": [2], "after": [2]}.  evidence: per joint.
    laid: axes that were tried along the object's directions (``lay_axes``).  slots: the learned slot of each part.
    contents: Gaussians that became a drawer's because they are on or in its tray.
    """

    labels: list[Tensor]
    margin: list[Tensor]
    before: Tensor
    after: Tensor
    polish: dict = field(default_factory=dict)
    costs: dict[str, list[float]] = field(default_factory=dict)
    evidence: list[JointEvidence] = field(default_factory=list)
    slots: list[int] = field(default_factory=list)
    contents: int = 0
    laid: list[dict] = field(default_factory=list)


def majority(labels: Tensor, neighbours: Tensor, weights: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Weighted majority of labels [M] over neighbours [N, k] (indices into labels), weights [N, k]: label [N] and its
    share [N]."""
    votes = torch.zeros(len(neighbours), parts)
    votes.scatter_add_(1, labels[neighbours], weights)
    share, label = votes.max(1)
    return label, share / votes.sum(1).clamp_min(1e-9)


def clean_labels(g: GaussianTensors, labels: Tensor, parts: int, k: int) -> Tensor:
    """Labels [N] by the opacity-weighted majority of the k nearest Gaussians, each counting itself twice."""
    if k <= 0 or len(labels) <= k:
        return labels
    _, index = knn(g.means, None, k, True)
    own = torch.arange(len(labels))[:, None]
    index = torch.cat([own, own, index], dim=1)
    return majority(labels, index, torch.sigmoid(g.opacity_logits)[index], parts)[0]


def surviving_slots(learned: Articulation, labels: Tensor, config: FinishConfig) -> list[int]:
    """Movable slots with mass and motion, as slot numbers; labels [N]."""
    solid = torch.sigmoid(learned.gaussians.opacity_logits) > 0.5
    alive = []
    for k in range(1, len(learned.types) + 1):
        rows = solid & (labels == k)
        mass = float(rows.sum()) / max(float(solid.sum()), 1.0)
        if mass < config.min_mass:
            continue
        points = learned.gaussians.means[rows].double()
        at = [
            se3.apply(se3.screw_at(learned.transforms[k - 1], s - learned.canonical_time), points) for s in (0.0, 1.0)
        ]
        if float((at[1] - at[0]).norm(dim=1).mean()) >= config.min_motion:
            alive.append(k)
    return alive


def state_labels(
    learned: Articulation, labels: Tensor, state: StateGaussians, transforms: Tensor, k: int = 6
) -> tuple[Tensor, Tensor]:
    """Labels [M] of a single-state reconstruction by the twin posed in that state; margin = how far the majority
    exceeds the rest, 0..1, or -1 for what the twin has nothing near of (lids that gave way to walls): the polish leaves
    that out."""
    posed = carry(
        learned.gaussians, labels, se3.screw_at(with_static(transforms), state.state - learned.canonical_time)
    )
    solid = (torch.sigmoid(posed.opacity_logits) > 0.1).nonzero().squeeze(1)
    distance, index = knn(posed.means[solid], state.gaussians.means, k, False)
    spacing = distance[:, 0].median().clamp_min(1e-4)
    weights = torch.exp(-(distance / (2 * spacing)).square()) + 1e-9
    label, share = majority(labels[solid], index, weights, len(transforms) + 1)
    margin = torch.where(distance[:, 0] > UNKNOWN * spacing, -1.0, 2 * share - 1)
    return label, margin


def name_types(types: list[str], transforms: Tensor, below: float) -> list[str]:
    """Give every "free" motion a joint type by its angle; transforms [K, 4, 4]."""
    angle = so3.rotation_angle(transforms[:, :3, :3]) * 57.29578 if len(transforms) else []
    return [
        ("prismatic" if float(a) < below else "revolute") if t == "free" else t
        for t, a in zip(types, angle, strict=True)
    ]


def constrain(kind: str, T: Tensor, centre: Tensor) -> Tensor:
    """The nearest motion [4, 4] of a joint type: a slide carries ``centre`` [3] where T does, a turn loses its
    pitch."""
    if kind == "prismatic":
        out = torch.eye(4, dtype=T.dtype)
        out[:3, 3] = T[:3, :3] @ centre + T[:3, 3] - centre
        return out
    return se3.project_revolute(T)


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
    direction then may leave it by a degree (``keep_shared``). losses: those of the last training phase, for ``tune``
    (None: it is left out).
    backend: draws the states, twin_backend: the twin in ``tune`` (None: the same).  A part's confidence is
    ``JointEvidence.confidence`` of its joint.
    """
    labels = clean_labels(learned.gaussians, learned.part_ids, len(learned.types) + 1, config.clean_neighbours)
    alive = surviving_slots(learned, labels, config)
    notes = [
        f"slot {k} of {len(learned.types)} vanished: no Gaussians of its own, or no motion"
        for k in range(1, len(learned.types) + 1)
        if k not in alive
    ]
    remap = torch.zeros(len(learned.types) + 1, dtype=torch.int64)
    for new, old in enumerate(alive):
        remap[old] = new + 1
    labels = remap[labels]
    keep = torch.tensor([k - 1 for k in alive], dtype=torch.int64)
    transforms = learned.transforms[keep]
    types = name_types([learned.types[k - 1] for k in alive], transforms, config.prismatic_below)
    time = learned.canonical_time
    axes = torch.full((len(types), 3), torch.nan).double()
    if discovered is not None and len(discovered) == len(learned.types):
        axes = shared_axes(discovered.transforms, discovered.types)[keep]
    for k, kind in enumerate(types):
        rows = labels == k + 1
        start = se3.apply(se3.screw_at(transforms[k], -time), learned.gaussians.means[rows].double())
        transforms[k] = constrain(kind, transforms[k], start.mean(0))
    options: dict[str, Any] = {"backend": backend, "device": device}
    level = common_level(views)
    stacks = [state_depth(state, views[s], level, **options) for s, state in enumerate(states)]
    twin = assemble(learned.gaussians, labels, types, transforms, time, similarity)
    labels, moved = settle_labels(twin, views, stacks, config, twin_backend or backend)
    found = [state_labels(learned, labels, s, transforms) for s in states]
    record = FinishRecord(
        [f[0] for f in found], [f[1] for f in found], transforms, transforms, slots=alive, contents=moved
    )
    options["seed"] = seed
    if len(types):
        motions = PartMotions(types, transforms, learned.confidence[keep], record.labels, record.margin)
        judge = Judge(None, states, views, config.polish, stacks, **options)
        refined = judge.no_worse(motions, judge.refine(motions)) if config.polish.steps > 0 else motions
        refined, _ = leave_false_minima(judge, refined, config.survey)
        if config.polish.steps > 0:
            refined = settle_types(judge, refined, config.prismatic_below, config.freedom_penalty)
        refined, record.laid = lay_axes(judge, refined, config.askew)
        refined = keep_shared(judge, refined, axes)
        refined, labels, gone = drop_needless(judge, refined, labels, config.part_penalty)
        for part in gone:
            notes.append(f"slot {alive.pop(part['part'])} of {len(learned.types)} vanished: {part['why']}")
            transforms = torch.cat([transforms[: part["part"]], transforms[part["part"] + 1 :]])
        types, record.labels, record.before = refined.types, refined.labels, transforms
        record.after = transforms = refined.transforms
    if len(types):
        record.polish = single_ways(states, refined, views, config.polish, stacks, **options)
        measure(record, judge, refined, level)
    options["backend"] = twin_backend or backend
    gaussians = tune(learned.gaussians, labels, transforms, time, views, losses or {}, config.tune, **options)
    twin = assemble(gaussians, labels, types, transforms, time, similarity, [e.confidence for e in record.evidence])
    if config.extend_range:
        twin.parts = extend_ranges(twin)
    return twin, notes, record


def settle_labels(
    twin: ArticulatedObject,
    views: dict[int, TrainingViews],
    stacks: list[DepthStack],
    config: FinishConfig,
    backend: str,
) -> tuple[Tensor, int]:
    """Labels [N] without islands, what is in drawers with these; and to how many Gaussians the latter happened.

    twin: as learned, internal coordinates; views: photographs by state; stacks: rendered depth of both states; backend:
    draws the twin for what is in drawers.
    """
    fuller = round(twin.canonical_time)  # the state that shows more
    T = torch.stack(
        [torch.eye(4, dtype=torch.float64)] + [p.joint.transform for p in twin.parts[1:] if p.joint is not None]
    )
    away, tau = se3.inverse(T) if fuller else T, config.polish.free_static or 0.02

    def without_islands(labels: Tensor, held: Tensor | None = None) -> Tensor:
        posed = carry(twin.gaussians, labels, se3.screw_at(T, fuller - twin.canonical_time))
        return settle_twin_islands(posed, labels, config.islands, away, stacks[1 - fuller], tau, held)

    labels = without_islands(twin.part_ids)
    if config.trays <= 0:
        return labels, 0
    cameras = [(s, views[s].camera(i, -1)) for s in (0, 1) for i in views[s].spread(config.trays)]
    settled, held = in_trays(replace(twin, part_ids=labels), cameras, backend)
    count = int((settled != labels).sum())
    return without_islands(settled, held) if count else labels, count


def assemble(
    g: GaussianTensors,
    labels: Tensor,
    types: list[str],
    transforms: Tensor,
    time: float,
    similarity: Similarity,
    confidence: Sequence[float] | None = None,
) -> ArticulatedObject:
    """A twin from Gaussians at canonical ``time``, labels [N], and a motion start -> end [K, 4, 4] per moving part."""
    parts = [Part(0, None, int((labels == 0).sum()))]
    for k, kind in enumerate(types):
        rows = labels == k + 1
        centre = g.means[rows].double().mean(0)
        joint = make_joint(kind, transforms[k], se3.apply(se3.screw_at(transforms[k], -time), centre[None])[0])
        parts.append(Part(k + 1, joint, int(rows.sum()), 1.0 if confidence is None else confidence[k]))
    return ArticulatedObject(g, labels, parts, time, similarity)


def measure(record: FinishRecord, judge: Judge, motions: PartMotions, level: int) -> None:
    """Fill in ``costs`` and ``evidence`` of the final motions. level: image size."""
    states, views = judge.states, judge.views
    options = {"level": level, "backend": judge.backend, "device": judge.device}
    for name, T in (("before", record.before), ("after", record.after)):
        ways = (T, se3.inverse(T))
        record.costs[name] = [
            photometric_cost(states[s].gaussians, record.labels[s], ways[s], views[1 - s], count=8, **options)
            for s in (0, 1)
        ]
    both = [record.polish[w] for w in ("forward", "backward")] if "backward" in record.polish else None
    known = [m >= 0 for m in record.margin]
    shown = [replace(s, gaussians=s.gaussians[k]) for s, k in zip(states, known, strict=True)]
    labels = [x[k] for x, k in zip(record.labels, known, strict=True)]
    found = measure_joints(shown, labels, record.after, motions.types, views, judge.stacks, both=both, **options)
    record.evidence = [replace(e, saved=own) for e, own in zip(found, own_shares(judge, motions), strict=True)]


def make_joint(kind: str, transform: Tensor, centre: Tensor) -> Joint:
    """A joint from its start -> end motion [4, 4]; ``centre`` [3] is the part's centre at the start (origin of a slide;
    picks the origin on a hinge's axis nearest to it). The observed motion is the range."""
    screw = se3.screw_parameters(transform.double())
    if kind == "prismatic":
        length = float(transform[:3, 3].norm())
        axis = transform[:3, 3] / max(length, 1e-12)
        return Joint("prismatic", axis, centre, length, (0.0, length), transform)
    axis = screw.axis
    origin = screw.origin + axis * ((centre - screw.origin) @ axis)
    degrees = float(screw.angle) * 57.29577951308232
    return Joint("revolute", axis, origin, degrees, (min(0.0, degrees), max(0.0, degrees)), transform)
