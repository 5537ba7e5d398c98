"""Joints that are askew to the object: where photographs hardly tell which way a part went (a shut drawer shows a
plain front, and its border is a guess), its free axis ends degrees off, while the object's own directions are known to
a degree."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.directions import KNOWN, WITHIN, axis_of, directions_of, hinged_directions, shared_axes, turned_onto
from p2gs.motion.discovery.rigid import one_way
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled


def lay_axes(judge: Judge, motions: PartMotions, price: float) -> tuple[PartMotions, list[dict]]:
    """Each joint's axis that is askew to the directions of the object (its surfaces' and what two hinges agree on) on
    the nearest of them, the rest refined, where that costs at most ``price`` of energy (``Judge.gain``; 0, or no
    refinement: none is); with labels chosen anew where the judge has discovery's surfaces.

    Returns the motions and what was tried: part, type, degrees off, what it gained.
    """
    log: list[dict] = []
    if price <= 0 or judge.config.steps <= 0 or not len(motions):
        return motions, log
    directions = torch.cat([directions_of(judge.states, motions), hinged_directions(motions)])
    held = torch.full((len(motions), 3), math.nan, dtype=torch.float64)
    for k, kind in enumerate(motions.types):
        if not bool(held[k].isnan().all()):
            continue  # laid with another part that has the same axis
        axis = axis_of(kind, motions.transforms[k])
        near = sorted((math.degrees(math.acos(min(1.0, abs(float(axis @ d))))), i) for i, d in enumerate(directions))
        shared = shared_axes(motions.transforms, motions.types)
        parts = [k] if bool(shared[k].isnan().any()) else one_way(shared, shared[k]).nonzero()[:, 0].tolist()
        if not near or not KNOWN < near[0][0] <= WITHIN:
            continue
        axes = held.clone()
        axes[parts] = directions[near[0][1]]
        gained, laid = _best_laid(judge, motions, parts, axes)
        log.append({"part": k, "type": kind, "degrees": near[0][0], "gained": gained})
        if gained >= -price:
            motions, held = laid, axes
    return motions, log


def keep_shared(judge: Judge, motions: PartMotions, axes: Tensor) -> PartMotions:
    """The motions with the slides that shared a direction, ``axes`` [K, 3] (NaN: none), laid on it again and refined
    with it held, if photographs took any of them farther than ``KNOWN`` from it. Each by itself, a shut drawer's plain
    front hardly tells which way it went."""
    held, laid, strayed = torch.full_like(axes, math.nan), motions, False
    for k in (~axes.isnan().any(1)).nonzero()[:, 0].tolist():
        T = motions.transforms[k]
        if motions.types[k] == "prismatic":
            held[k] = axes[k]
            laid = laid.with_motion(k, "prismatic", turned_onto("prismatic", T, axes[k], torch.zeros(3).double()))
            strayed |= float((axis_of("prismatic", T).double() @ axes[k]).abs()) < math.cos(math.radians(KNOWN))
    return judge.refine(laid, held) if strayed else motions


def _best_laid(judge: Judge, motions: PartMotions, parts: list[int], axes: Tensor) -> tuple[float, PartMotions]:
    """What it gains, and motions, with the axes of ``parts`` along ``axes[k]``: as they are turned onto them, refined,
    or refined with labels chosen anew, whichever gains most. axes [K, 3]: directions that joints keep (NaN: free)."""
    laid = motions
    for k in parts:
        points = judge.states[0].gaussians.means[motions.labels[0] == k + 1].double().cpu()
        middle = points.mean(0) if len(points) else torch.zeros(3, dtype=torch.float64)
        T = turned_onto(motions.types[k], motions.transforms[k], axes[k], middle)
        laid = laid.with_motion(k, motions.types[k], T)
    tried = [laid, judge.refine(laid, axes)]
    if judge.found is not None:
        tried.append(judge.refine(relabelled(judge.found, judge.states, tried[1]), axes))
    return max(((judge.gain(m, motions), m) for m in tried), key=lambda t: t[0])
