"""With refined motions: what each part's motion should be amid the others, and which Gaussians belong to it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from operator import itemgetter

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.directions import LINE, directions_of
from p2gs.motion.discovery import Discovery, in_rows, in_two, instead_of, places_changed
from p2gs.motion.refine_motions import Judge
from p2gs.motion.relabel import relabelled
from p2gs.native import at_once
from p2gs.ops import se3
from p2gs.parts.islands import settle_islands
from p2gs.parts.options import PartMotionsConfig
from p2gs.parts.part_choices import lonely, settle_types

# Of a proposal's energy (a log ratio of image losses), the most by which refining is taken to lower it: of 245
# proposals on fourteen objects no accepted one stood above 0.042 before it, and none of the 88 above this came so low.
REACH = 0.15


def reconsider(
    judge: Judge, motions: PartMotions, limit: int, config: PartMotionsConfig
) -> tuple[PartMotions, list[dict]]:
    """Exchange motions for others that explain what the refined rest leaves over, or that turn a part over, those of
    two like parts for such as change their ends, add one, make one part two, or many of a row of drawers, while the
    energy falls.

    For each part, and below ``limit`` for one more, the search proposes motions (``instead_of``), for a turning part
    its half turns (``_turned_over``), for two parts such as take each for the other at the end (``places_changed``),
    for each part the two amounts about one axis that explain most (``in_two``), and the amounts of all bodies that
    slid one way (``in_rows``). Under each proposal every surfel chooses its part anew, and with the ``candidates`` of
    each kind that surfaces like best the states are re-rendered. The best of each kind is refined where that can be
    enough (``REACH``), and the energy must fall; with a further part the image loss must as well, in its own pixels
    (``Judge.own_share``): what surfaces alone gain is junk. Returns the motions and what was tried.
    """
    found, states, log = judge.found, judge.states, []
    _, cost = judge(motions)
    for _ in range(limit if len(motions) else 0):
        tries = {"exchanged": [(k, m) for k in range(len(motions)) for m in _with_part(found, states, motions, k)]}
        tries["turned over"] = _turned_over(found, states, motions)
        tries["crossed"] = _proposed(found, states, motions, places_changed(found, motions.transforms, motions.types))
        if len(motions) < limit:
            tries["added"] = [(len(motions), m) for m in _with_part(found, states, motions, None)]
            tries["parted"] = _proposed(found, states, motions, in_two(found, motions.transforms, motions.types))
            in_row = in_rows(found, motions.transforms, motions.types, directions_of(states, motions), limit)
            tries["in a row"] = _proposed(found, states, motions, [(0, *row) for row in in_row])
        best = None
        tries = {change: proposed for change, proposed in tries.items() if proposed}
        done = at_once(partial(_best_refined, judge, motions, config.candidates), list(tries.values()))
        for change, (part, proposed, outcome) in zip(tries, done, strict=True):
            log.append({"change": change, "part": part, "cost": cost, "proposed": -proposed})
            if outcome is None:
                continue
            gained, refined = outcome
            reached = judge.cost(refined)
            log[-1] |= {"type": refined.types[part], "after": reached, "energy": -gained}
            new = part if len(refined) == len(motions) else len(motions)
            better = gained > (0 if best is None else best[0])
            if better and lonely(states, refined, motions, new):
                log[-1]["own_share"] = judge.own_share(refined, motions)
                better = log[-1]["own_share"] >= judge.further
            if better:
                best = (gained, reached, refined)
        if best is None:
            break
        _, cost, motions = best
    return motions, log


def _best_refined(
    judge: Judge, motions: PartMotions, count: int, proposed: list[tuple[int, PartMotions]]
) -> tuple[int, float, tuple[float, PartMotions] | None]:
    """Of the ``count`` proposals (part, motions) that surfaces like best the one of least energy: its part, what it
    gains against ``motions``, and refined what it gains and its motions; None for these where it is further than
    ``REACH`` from a gain."""
    proposed = sorted(proposed, key=lambda p: judge.surfaces(p[1]))[:count]
    gain, (part, tried) = max(((judge.gain(p[1], motions), p) for p in proposed), key=itemgetter(0))
    if gain < -REACH:
        return part, gain, None
    refined = judge.improved(tried)[2]
    return part, gain, (judge.gain(refined, motions), refined)


def _with_part(found: Discovery, states, motions: PartMotions, part: int | None) -> list[PartMotions]:
    """The motions with another one for ``part`` (None: with one more), labels chosen anew."""
    k, proposed = len(motions) if part is None else part, instead_of(found, motions.transforms, motions.types, part)
    return at_once(partial(relabelled, found, states), [motions.with_motion(k, kind, T) for T, kind in proposed])


def _turned_over(found: Discovery, states, motions: PartMotions) -> list[tuple[int, PartMotions]]:
    """Each turning part with a half turn of its own before its motion: a plate turned over, front for back, or a cross
    covers its place as well. Half turns are about the principal axes of its points; what is no turn then is left
    out."""
    out = []
    for k, (kind, T) in enumerate(zip(motions.types, motions.transforms.double(), strict=True)):
        points = states[0].gaussians.means[motions.labels[0] == k + 1].double()
        if kind != "revolute" or len(points) < 3:
            continue
        middle = points.mean(0)
        for axis in torch.linalg.svd(points - middle, full_matrices=False)[2]:
            over = T @ se3.from_screw(axis, middle, math.pi)
            turn = se3.project_revolute(over)
            if float(se3.mean_gap(over, turn, points)) < LINE:
                out.append((k, relabelled(found, states, motions.with_motion(k, kind, turn))))
    return out


def _proposed(found: Discovery, states, motions: PartMotions, proposals: list[tuple]) -> list[tuple[int, PartMotions]]:
    """Of each (part, transforms, types) the part and the motions, labels chosen anew."""
    tried = [replace(motions, types=of, transforms=T, confidence=torch.zeros(len(of))) for _, T, of in proposals]
    labelled = at_once(partial(relabelled, found, states), tried)
    return [(k, m) for (k, _, _), m in zip(proposals, labelled, strict=True)]


def settle_labels(judge: Judge, motions: PartMotions, config: PartMotionsConfig) -> tuple[PartMotions, list[dict]]:
    """With the refined motions every Gaussian chooses its part anew, islands are settled, motions refined again and
    types settled.

    For up to ``rounds`` rounds, while the energy falls. Returns the motions and what each round measured.
    """
    rounds = []
    for number in range(config.rounds if len(motions) else 0):
        cost, best = judge.cost(motions), None
        # amid a wrong explanation's labels the larger pieces need not be the right ones: islands are settled only from
        # here on
        both = at_once(partial(_settled, judge, motions, config), (False, True))
        for name, done in zip(("kept", "anew"), both, strict=True):
            if done is None:
                continue
            count, reached, gained, tried = done
            told = {"round": number, "labels": name, "islands": count, "before": cost, "after": reached}
            rounds.append({**told, "energy": -gained})
            if best is None or gained > best[0]:
                best = (gained, tried)
        if best is None or best[0] <= 0:
            break
        motions = settle_types(judge, best[1], config.compare_types_below, config.freedom_penalty)
    return motions, rounds


def _settled(
    judge: Judge, motions: PartMotions, config: PartMotionsConfig, anew: bool
) -> tuple[int, float, float, PartMotions] | None:
    """The motions with islands settled, of these labels or of labels chosen ``anew``, and refined: how many islands,
    the image loss, what they gain, the motions; None where no label changes."""
    tried = relabelled(judge.found, judge.states, motions) if anew else motions
    gaussians = [s.gaussians for s in judge.states]
    labels, count = settle_islands(gaussians, tried.labels, tried.transforms, config.islands)
    if all(map(torch.equal, labels, motions.labels)):
        return None
    _, reached, tried = judge.improved(replace(tried, labels=labels))
    return count, reached, judge.gain(tried, motions), tried
