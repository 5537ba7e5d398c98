"""Joints that are askew to the object: where photographs hardly tell which way a part went (a shut drawer shows a
plain front, and its border is a guess), its free axis ends degrees off, while the object's own directions are known to
a degree."""

from __future__ import annotations

import math
from functools import partial
from operator import itemgetter

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.directions import (
    KNOWN,
    SQUARE,
    WITHIN,
    axis_of,
    directions_of,
    hinged_directions,
    shared_axes,
    turned_onto,
)
from p2gs.motion.discovery.rigid import one_way
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled
from p2gs.native import at_once


def lay_axes(
    judge: Judge, motions: PartMotions, price: float, further: float
) -> tuple[PartMotions, Tensor, list[dict]]:
    """Each joint's axis that is askew to the directions of the object (its surfaces' and what two hinges agree on) on
    the nearest of them, the rest refined, where that costs at most ``price`` of energy (``Judge.gain``; 0, or no
    refinement: none is laid), and if it is farther off than ``WITHIN``, so that it need not be meant to lie there, at
    most ``further`` of the image loss in the part's own pixels (``Judge.own_share``); with labels chosen anew where the
    judge has discovery's surfaces. Of several measures of one direction, a hinge's and the surfaces', the one that
    gains most.

    Returns the motions, the directions [K, 3] that axes were laid on (NaN: none), and what was tried: part, type,
    degrees off, what it gained and saved in its own pixels, whether it was taken.
    """
    log: list[dict] = []
    held = torch.full((len(motions), 3), math.nan, dtype=torch.float64)
    if price <= 0 or judge.config.steps <= 0 or not len(motions):
        return motions, held, log
    faced = directions_of(judge.states, motions)
    directions = torch.cat([faced, hinged_directions(motions, faced)])
    for k, kind in enumerate(motions.types):
        if not bool(held[k].isnan().all()):
            continue  # laid with another part that has the same axis
        along = (directions @ axis_of(kind, motions.transforms[k])).abs()
        if not len(along) or float(along.max()) >= math.cos(math.radians(KNOWN)):
            continue
        shared = shared_axes(motions.transforms, motions.types)
        parts = [k] if bool(shared[k].isnan().any()) else one_way(shared, shared[k]).nonzero()[:, 0].tolist()
        alike = (directions @ directions[along.argmax()]).abs() > math.cos(math.radians(SQUARE))
        tried = [_at(held, parts, d) for d in directions[alike]]
        gained, laid, axes = max(at_once(partial(_best_laid, judge, motions, parts), tried), key=itemgetter(0))
        saved = judge.own_share(laid, motions)
        off = math.degrees(math.acos(min(1.0, float(along.max()))))
        taken = gained >= -price and (off <= WITHIN or saved >= -further)
        log.append({"part": k, "type": kind, "degrees": off, "gained": gained, "own_share": saved, "laid": taken})
        if taken:
            motions, held = laid, axes
    return motions, held, log


def keep_axes(judge: Judge, motions: PartMotions, axes: Tensor) -> PartMotions:
    """The motions with the joints that have a direction, ``axes`` [K, 3] (NaN: none), laid on it again and refined with
    it held, if photographs took any of them farther than ``KNOWN`` from it. Each by itself, a shut drawer's plain front
    or a round handle hardly tells which way it went."""
    held = (~axes.isnan().any(1)).nonzero()[:, 0].tolist()
    along = [float((axis_of(motions.types[k], motions.transforms[k]).double() @ axes[k]).abs()) for k in held]
    strayed = min(along, default=1.0) < math.cos(math.radians(KNOWN))
    return judge.refine(_onto(judge, motions, held, axes), axes) if strayed else motions


def on_axes(motions: PartMotions, axes: Tensor) -> Tensor:
    """[K, 3] the directions that joints lie on: of ``axes`` [K, 3] (NaN: none), or what slides share; NaN: none."""
    out = shared_axes(motions.transforms, motions.types)
    for k in (~axes.isnan().any(1)).nonzero()[:, 0].tolist():
        if bool(one_way(axes[k : k + 1], axis_of(motions.types[k], motions.transforms[k].double()))):
            out[k] = axes[k]
    return out


def _at(axes: Tensor, parts: list[int], direction: Tensor) -> Tensor:
    """axes [K, 3] with ``direction`` [3] as that of ``parts``."""
    out = axes.clone()
    out[parts] = direction
    return out


def _onto(judge: Judge, motions: PartMotions, parts: list[int], axes: Tensor) -> PartMotions:
    """The motions with the axes of ``parts`` turned onto ``axes[k]``."""
    for k in parts:
        points = judge.states[0].gaussians.means[motions.labels[0] == k + 1].double().cpu()
        middle = points.mean(0) if len(points) else torch.zeros(3, dtype=torch.float64)
        T = turned_onto(motions.types[k], motions.transforms[k], axes[k], middle)
        motions = motions.with_motion(k, motions.types[k], T)
    return motions


def _best_laid(judge: Judge, motions: PartMotions, parts: list[int], axes: Tensor) -> tuple[float, PartMotions, Tensor]:
    """What it gains, and motions, with the axes of ``parts`` along ``axes[k]``: as they are turned onto them, refined,
    or refined with labels chosen anew, whichever gains most; and ``axes`` [K, 3]: directions that joints keep (NaN:
    free)."""
    laid = _onto(judge, motions, parts, axes)
    tried = [laid, judge.refine(laid, axes)]
    if judge.found is not None:
        tried.append(judge.refine(relabelled(judge.found, judge.states, tried[1]), axes))
    return *max(((judge.gain(m, motions), m) for m in tried), key=itemgetter(0)), axes
