"""Every stage's own measure, from what the stages handed over and the photographs; no ground truth, the same for a
resumed run.

Lengths are in the input's units, angles in degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import Articulation, CanonicalGaussians, PartMotions, StateGaussians
from p2gs.gaussians.pose import carry, with_static
from p2gs.models.finish_record import FinishRecord
from p2gs.motion.joint_confidence import (
    ON_SURFACE,
    CrossViews,
    common_level,
    measure_joints,
    measuring_level,
    state_depth,
)
from p2gs.ops import se3
from p2gs.types import ArticulatedObject, GaussianTensors, Part
from p2gs.visibility.depth_stack import DepthStack, classify

FORMAT = "p2gs-diagnostics/1"
STATES = ("start", "end")
FOG = (0.1, 0.9)  # opacities that are neither air nor surface


@dataclass
class StageResults:
    """What the stages handed over. found_in: the states as discovery had them.  motions: None where the run started
    without discovery.
    states: as the stages after it had them (the same Gaussians, sharpened).  notes: lines about vanished slots."""

    found_in: list[StateGaussians]
    motions: Optional[PartMotions]
    states: list[StateGaussians]
    canonical: CanonicalGaussians
    learned: Articulation
    record: FinishRecord
    notes: list[str] = field(default_factory=list)


@torch.no_grad()
def diagnose(
    stages: StageResults,
    twin: ArticulatedObject,
    views: dict[int, TrainingViews],
    *,
    min_margin: float,
    backend: str = "auto",
    twin_backend: str | None = None,
    device="cpu",
) -> dict:
    """What RUN/diagnostics.json holds, without verdicts and losses.

    views: photographs by state.  min_margin: labels less clear than this count as ambiguous.  backend, twin_backend: as
    of ``finish``; the latter drew the states before they were sharpened, too.
    """
    states, motions, canonical, learned, record = (
        stages.states,
        stages.motions,
        stages.canonical,
        stages.learned,
        stages.record,
    )
    first: dict[str, Any] = {"backend": twin_backend or backend, "device": device}
    unit = 1.0 / twin.similarity.scale
    render: dict[str, Any] = {"backend": backend, "device": device}
    level = max(n for s in (0, 1) for n in views[s].levels)
    coarse = common_level(views)
    stacks = [state_depth(state, views[s], coarse, count=16, **render) for s, state in enumerate(states)]
    single = {STATES[s.state]: reconstruction(s.gaussians, views[s.state], level, **first) for s in stages.found_in}
    for s in states:
        single[STATES[s.state]]["psnr_sharpened"] = reconstruction(s.gaussians, views[s.state], level, **render)["psnr"]
    d: dict[str, Any] = {
        "format": FORMAT,
        "single_state": single,
        "motion_evidence": None if motions is None else motion_evidence(motions, stages.found_in),
        "discovery": None if motions is None else discovery(motions, unit),
        "labels": {STATES[s]: labelling(states[s], record, s, min_margin, stacks[1 - s]) for s in (0, 1)},
        "fusion": fusion(canonical, learned.canonical_time),
        "articulation": articulation(states, motions, canonical, learned, views, unit, render),
        "polish": polishing(record, twin, states, unit),
        "residuals": residuals(states, record, views, coarse, render),
        "joints": [],
        "finish": {"parts": len(twin.parts), "notes": list(stages.notes)},
    }
    for part, evidence in zip(twin.parts[1:], record.evidence, strict=True):
        row = {"part": part.id, "type": joint_type(part)} | evidence.as_dict()
        if row["disagreement"] is not None:
            row["disagreement"] *= unit
        d["joints"].append(row)
    for row, slot, earlier in zip(
        d["joints"], record.slots, trace(states, motions, record, views, stacks, coarse, render), strict=True
    ):
        row |= {"slot": slot, "confidence_by_stage": {**earlier, "finish": row["confidence"]}}
    return plain(d)


def residuals(states, record: FinishRecord, views, level: int, render: dict) -> dict:
    """Each state's Gaussians in the other state's photographs: mean residual of the static part, and the share of the
    object's pixels where it is plainly wrong. What only one state shows (a cupboard's inside) is wrong one way; a
    moving piece that was left static both ways."""
    out = {}
    for s, name in enumerate(("start_to_end", "end_to_start")):
        T = record.after if s == 0 else se3.inverse(record.after)
        seen = CrossViews(states[s], record.labels[s], T, views[1 - s], level=level, **render)
        out[name] = {"static": seen.static_error, "bright_static": seen.bright_static}
    return out


def trace(states, motions, record: FinishRecord, views, stacks, level: int, render: dict) -> list[dict[str, float]]:
    """Per joint of the twin the confidence it would have had as discovery and as the articulation phase handed it over,
    on fewer photographs and without the two directions: where it falls, a stage lost the joint."""
    slots = [k - 1 for k in record.slots]
    if not slots:
        return []
    options = {"level": level, "looks": 8, "count": 3, **render}
    types = ["prismatic" if bool((T[:3, :3] == torch.eye(3)).all()) else "revolute" for T in record.before]
    out: list[dict[str, float]] = [{} for _ in slots]
    if motions is not None and max(slots) < len(motions):
        found = measure_joints(states, motions.labels, motions.transforms, motions.types, views, stacks, **options)
        for row, slot in zip(out, slots, strict=True):
            row["discovery"] = found[slot].confidence
    for row, e in zip(
        out, measure_joints(states, record.labels, record.before, types, views, stacks, **options), strict=True
    ):
        row["articulation"] = e.confidence
    return out


def reconstruction(
    g: GaussianTensors, views: TrainingViews, level: int, count: int = 8, backend: str = "auto", device="cpu"
) -> dict:
    """A state against its own photographs (PSNR over grey, alpha IoU over ``count`` of them) and the share of fog among
    its Gaussians."""
    grey = torch.full((3,), 0.5)
    squared = pixels = both = either = 0.0
    picked = views.spread(count)
    for i in picked:
        shot = views.get(i, views.levels.index(level), grey)
        out = render_gaussians(g.to(device), shot.camera.to(device), grey.to(device), backend=backend)
        squared += float((out.colour.cpu().clamp(0, 1) - shot.image).square().mean(-1).sum())
        pixels += shot.alpha.numel()
        mine, mask = out.alpha.cpu() > 0.5, shot.alpha > 0.5
        both, either = both + int((mine & mask).sum()), either + int((mine | mask).sum())
    opacity = torch.sigmoid(g.opacity_logits)
    return {
        "views": len(picked),
        "psnr": -10 * math.log10(max(squared / max(pixels, 1), 1e-10)),
        "alpha_iou": both / max(either, 1),
        "gaussians": len(g),
        "fog": float(((opacity > FOG[0]) & (opacity < FOG[1])).float().mean()),
    }


def motion_evidence(motions: PartMotions, states: list[StateGaussians]) -> dict:
    """Surface points of each state that were seen to have moved, to have stayed, or neither; what of the moved ones no
    part took."""
    counted = motions.diagnostics.get("states", [{}, {}])
    out = {}
    for s, name in enumerate(STATES):
        row = {k: counted[s].get(k) for k in ("moved", "static", "unknown")}
        solid, seen = evidence_points(motions, states[s])
        if seen is not None:
            moved = solid[seen == 1]
            row["moved_without_part"] = float((motions.labels[s][moved] == 0).float().mean()) if len(moved) else 0.0
        out[name] = row
    return out


def evidence_points(motions: PartMotions, state: StateGaussians) -> tuple[Tensor, Optional[Tensor]]:
    """Indices [M] of the Gaussians discovery looked at and what it saw of each [M]: 1 moved, 0 static, -1 unknown
    (None: not recorded)."""
    solid = (
        (torch.sigmoid(state.gaussians.opacity_logits) > motions.diagnostics.get("min_opacity", 0.5))
        .nonzero()
        .squeeze(1)
    )
    kept = motions.diagnostics.get("evidence")
    return solid, None if kept is None else kept[state.state].long()


def discovery(motions: PartMotions, unit: float) -> dict:
    """Explanations that were compared, with their image losses; parts that were dropped or merged, with the reason;
    which parts of the others the best took over; what was tried when it was reconsidered; which parts beside each other
    were asked whether they are one."""
    told = motions.diagnostics
    return {
        "chosen": told.get("explanation"),
        "explanations": told.get("explanations", []),
        "fused": told.get("fused", []),
        "reconsidered": told.get("reconsidered", []),
        "candidates": told.get("candidates", []),
        "seamless": told.get("seamless", []),
        "parts": [
            {"part": k + 1, "type": t, **amount(t, T, unit), "confidence": float(c)}
            for k, (t, T, c) in enumerate(zip(motions.types, motions.transforms, motions.confidence, strict=True))
        ],
    }


def amount(kind: str, T: Tensor, unit: float) -> dict:
    """How far a motion [4, 4] goes: {"degrees"} of a turn, {"length"} of a slide."""
    if kind == "prismatic":
        return {"length": float(T[:3, 3].norm()) * unit}
    return {"degrees": math.degrees(float(se3.screw_parameters(T.double()).angle))}


def labelling(state: StateGaussians, record: FinishRecord, s: int, min_margin: float, other: DepthStack) -> dict:
    """Gaussians by part, the share of the solid ones whose label is too unclear for the polish, and of those that
    ``other``, the other state's rendered depth, says have moved (how many, and the share that is called static all the
    same)."""
    solid = state.gaussians.solid
    labels, margin = record.labels[s][solid], record.margin[s][solid]
    count = torch.bincount(labels, minlength=len(record.after) + 1).tolist()
    unclear = margin < min_margin
    shares = [float(unclear[labels == k].float().mean()) if n else 0.0 for k, n in enumerate(count)]
    free, on, _ = other.counts(state.gaussians.means[solid], ON_SURFACE)
    moved = classify(free, on)[0]
    left = float((labels[moved] == 0).float().mean()) if bool(moved.any()) else 0.0
    unclear = float(unclear.float().mean()) if len(margin) else 0.0
    return {
        "gaussians": count,
        "ambiguous": unclear,
        "ambiguous_by_part": shares,
        "moved": int(moved.sum()),
        "moved_static": left,
    }


def fusion(canonical: CanonicalGaussians, time: float) -> dict:
    """How many Gaussians each state gave a partner, what free space took away, and what became of openings (None: not
    looked at)."""
    parts = len(canonical.betas)
    count = torch.bincount(canonical.labels, minlength=parts)
    matched = torch.bincount(canonical.labels[canonical.paired], minlength=parts)
    return {
        "canonical_time": time,
        "gaussians": count.tolist(),
        "matched": matched.tolist(),
        "relabelled": canonical.diagnostics.get("relabelled"),
        "dropped": canonical.diagnostics.get("dropped"),
        "owners": canonical.diagnostics.get("owners"),
        "openings": canonical.diagnostics.get("openings"),
    }


def articulation(states, motions, canonical, learned, views, unit: float, render: dict) -> dict:
    """Image loss of the twin in both states' photographs as fusion handed it over and as it was learned; how far joints
    went (None for a spare slot, which discovery knows nothing of)."""
    out = {"image_loss_start": None, "image_loss_end": None, "joints": []}
    labels = learned.part_ids
    after = [
        carry(learned.gaussians, labels, se3.screw_at(with_static(learned.transforms), s - learned.canonical_time))
        for s in (0, 1)
    ]
    out["image_loss_end"] = own_loss(after, views, render)
    if motions is None or canonical.offsets is not None:
        return out
    T, times = with_static(motions.transforms), canonical.canonical_times
    before = [carry(canonical.gaussians, canonical.labels, se3.screw_at(T, s - times)) for s in (0, 1)]
    out["image_loss_start"] = own_loss(before, views, render)
    for k, kind in enumerate(learned.types):
        row: dict[str, Any] = {"slot": k + 1, "type": kind, "moved_degrees": None, "moved": None}
        if k < len(motions):
            own = states[0].gaussians.means[motions.labels[0] == k + 1]
            shift, turn = apart(motions.transforms[k], learned.transforms[k], own)
            row |= {"moved_degrees": turn, "moved": shift * unit}
        out["joints"].append(row)
    return out


def own_loss(posed: list[GaussianTensors], views: dict[int, TrainingViews], render: dict, count: int = 6) -> float:
    """Mean |render - photo| of the posed Gaussians of both states over ``count`` views each."""
    grey, total, pixels = torch.full((3,), 0.5), 0.0, 0
    device = render["device"]
    for s, g in enumerate(posed):
        level = views[s].levels.index(measuring_level(views[s]))
        for i in views[s].spread(count):
            shot = views[s].get(i, level, grey)
            out = render_gaussians(g.to(device), shot.camera.to(device), grey.to(device), backend=render["backend"])
            error = (out.colour.cpu() - shot.image).abs().mean(-1)
            total, pixels = total + float(error.sum()), pixels + error.numel()
    return total / max(pixels, 1)


def apart(a: Tensor, b: Tensor, points: Tensor) -> tuple[float, float]:
    """How far two motions [4, 4] put the same points apart on average, and their difference in degrees."""
    turn = se3.screw_parameters(se3.inverse(a.double()) @ b.double()).angle
    if not len(points):
        return 0.0, math.degrees(float(turn))
    return float(se3.mean_gap(a.double(), b.double(), points.double())), math.degrees(float(turn))


def joint_type(part: Part) -> str:
    """Of a moving part."""
    assert part.joint is not None
    return part.joint.type


def polishing(record: FinishRecord, twin: ArticulatedObject, states, unit: float) -> dict:
    """Image loss of each direction before and after the last refinement, what became a drawer's; per joint what the
    refinement changed and how the two directions differ."""
    names = ("start_to_end", "end_to_start")
    out: dict[str, Any] = {}
    if record.costs:
        out = {n: {w: record.costs[w][i] for w in record.costs} for i, n in enumerate(names)}
    out |= {"contents": record.contents, "together": record.together, "laid": record.laid, "fronts": record.fronts}
    out["joints"] = []
    for k, part in enumerate(twin.parts[1:]):
        points = states[0].gaussians.means[record.labels[0] == k + 1]
        shift, turn = apart(record.before[k], record.after[k], points)
        row = {"part": part.id, "type": joint_type(part), "changed_degrees": turn, "changed": shift * unit}
        if "backward" in record.polish:
            shift, turn = apart(record.polish["forward"][k], record.polish["backward"][k], points)
            row |= {"disagreement_degrees": turn, "disagreement": shift * unit}
        out["joints"].append(row)
    return out


def plain(value: Any) -> Any:
    """Numbers of six digits (so that the last bits of a float do not change the file), None for what is not finite."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Tensor):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
