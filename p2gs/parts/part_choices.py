"""Which parts there are and how each may move: merge, drop, slide or turn, as the images decide."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.directions import has_own_axis
from p2gs.motion.discovery import as_motions, axes_used
from p2gs.motion.refine_motions import Judge
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn


def simplify(
    judge: Judge, motions: PartMotions, same_motion: float, log: list[dict] | None = None, final: bool = False
) -> PartMotions:
    """Make one of touching parts that ``same_motion`` (internal units) does not tell apart, and drop parts, while the
    energy does not rise; drop one of several, too, that has an axis of its own and saves less of the image loss in its
    own pixels (``Judge.own_share``) than a further one must (``judge.further``).

    log: told of each part that goes: what was done, its index then, the label that its Gaussians got (numbered as
    then), its type, the share of the image loss that it saved in its own pixels, the change of the energy.  final:
    motions are known for good. Then a part may go to any that it touches, not to the static one alone; and a turn
    about another's line goes if it saves nothing in its own pixels. A slide along another's direction stays: of a row's
    shut drawers photographs alone know little.
    """
    tried: set[tuple] = set()
    states = judge.states
    while len(motions):
        for change, reduced in _reductions(states, motions, same_motion, final):
            if change in tried:
                continue
            tried.add(change)
            done, part, into = change
            if not final and judge.gain(reduced, motions) >= 0:
                break
            alone = len(motions) > 1 and not final and lonely(states, motions, reduced, part)
            least = must_save(states, motions, part, judge.further) if final else judge.further if alone else None
            if done != "merge" and least is not None and judge.own_share(motions, reduced) < least:
                break
        else:
            return motions
        if log is not None:
            gone = {"change": done, "part": part, "into": into, "type": motions.types[part]}
            log.append({**gone, "own_share": judge.own_share(motions, reduced)})
            log[-1]["energy"] = -judge.gain(reduced, motions)
        motions = reduced
        tried.clear()
    return motions


def drop_needless(
    judge: Judge, motions: PartMotions, labels: Tensor, penalty: float
) -> tuple[PartMotions, Tensor, list[dict]]:
    """The motions and the twin's labels [N] without parts that save less than ``penalty`` of the image loss in their
    own pixels now that all motions are known (``simplify``; 0, or no refinement: all stay), refined again where any
    went; and those that went, each with a sentence ``why``. Where discovery saw a part's motion half a degree wrong, it
    may have taken another to make up for it."""
    gone: list[dict] = []
    if penalty <= 0 or judge.config.steps <= 0:
        return motions, labels, gone
    fewer = simplify(replace(judge, further=penalty), motions, 0.0, gone, final=True)
    for count, part in zip(range(len(motions), 0, -1), gone, strict=False):
        labels = renumbering(count, part["part"], part["into"])[labels]
        share = f"{100 * part['own_share']:.0f} % of the image loss in its own pixels"
        part["why"] = f"as a {part['type']} part of its own it saves {share}"
    return judge.improved(fewer)[2] if gone else motions, labels, gone


def needless(states, motions: PartMotions, saved: list[float | None], penalty: float) -> list[int]:
    """The parts of several that save less in their own pixels than ``drop_needless`` asks of them. saved: of each, as
    ``own_shares`` has it (None: not asked)."""
    if penalty <= 0:
        return []
    least = [must_save(states, motions, k, penalty) for k in range(len(motions))]
    asked = enumerate(zip(saved, least, strict=True))
    return [k for k, (share, of) in asked if share is not None and of is not None and share < of]


def must_save(states, motions: PartMotions, part: int, penalty: float) -> float | None:
    """What a part must save in its own pixels (``Judge.own_share``) once all motions are known: ``penalty`` if it has
    an axis of its own, something if it turns about another's, nothing (None) as a slide along another's direction or
    as the only part."""
    if len(motions) > 1 and has_own_axis(states, motions, part):
        return penalty
    return 0.0 if len(motions) > 1 and motions.types[part] == "revolute" else None


def drop_untold(
    judge: Judge, motions: PartMotions, labels: Tensor, trust: list[float], least: float
) -> tuple[PartMotions, Tensor, list[dict]]:
    """The motions and the twin's labels [N] without the part of least confidence where that is below ``least``, the
    rest refined again (no refinement: all stay); and, if it went, which it was and a sentence ``why``. trust: of each
    part, as the final motions were measured. The only part stays: something moved, however badly its motion is told."""
    if len(trust) < 2 or judge.config.steps <= 0 or min(trust) >= least:
        return motions, labels, []
    part = trust.index(min(trust))
    why = f"photographs do not tell its motion (confidence {trust[part]:.2f})"
    fewer = without_part(motions, part, 0)
    return judge.improved(fewer)[2], renumbering(len(motions), part, 0)[labels], [{"part": part, "why": why}]


def own_shares(judge: Judge, motions: PartMotions) -> list[float]:
    """Of each part, what it saves of the image loss in its own pixels (``Judge.own_share``) against being static or one
    with a part that it touches, whichever explains them best."""
    out = [1.0] * len(motions)
    for (_, part, _), fewer in _reductions(judge.states, motions, 0.0, joins=True):
        out[part] = min(out[part], judge.own_share(motions, fewer))
    return out


def better(judge: Judge, tried: PartMotions, than: PartMotions) -> bool:
    """Is the energy of ``tried`` lower? One that has more axes than the other must save ``judge.further`` of the image
    loss in its own pixels (``Judge.own_share``) against it as well, or is none the better."""
    more = further_axes(tried, than)
    if more < 0:
        return not better(judge, than, tried)
    return judge.gain(tried, than) > 0 and (more == 0 or judge.own_share(tried, than) >= judge.further)


def lonely(states, more: PartMotions, fewer: PartMotions, part: int) -> bool:
    """Is there an axis less with ``fewer`` than with ``more``, in which ``part`` is new? Of a row of drawers, or of
    doors on one hinge line, each saves little, and has the axis of the others."""
    return further_axes(more, fewer) > 0 and has_own_axis(states, more, part, coarse=True)


def further_axes(more: PartMotions, fewer: PartMotions) -> int:
    """How many axes ``more`` has above those of ``fewer`` (``axes_used``)."""
    return axes_used(as_motions(more.transforms, more.types)) - axes_used(as_motions(fewer.transforms, fewer.types))


def _reductions(states, motions: PartMotions, same_motion: float, joins: bool = False):
    """Explanations with one part less: ((what is done, part, label that its Gaussians get), motions). Merging comes
    first, small parts go before large ones; with ``joins`` also into each larger part that they touch."""
    solid = [s.gaussians.solid for s in states]
    points = [
        [
            s.gaussians.means[of & (lab == k + 1)].double()
            for s, of, lab in zip(states, solid, motions.labels, strict=True)
        ]
        for k in range(len(motions))
    ]
    order = sorted(range(len(motions)), key=lambda k: len(points[k][0]))
    for i, small in enumerate(order):
        for large in reversed(order[i + 1 :]):
            # each state by itself: what one hides of a part (the inside of a shut drawer) the other shows
            for a, b, back in ((points[small][0], points[large][0], False), (points[small][1], points[large][1], True)):
                if min(len(a), len(b)) < 5:
                    continue
                ways = [se3.inverse(motions.transforms[k]) if back else motions.transforms[k] for k in (small, large)]
                if float(se3.mean_gap(ways[0], ways[1], a)) < same_motion and _touch(a, b):
                    yield ("merge", small, large + 1), without_part(motions, small, large + 1)
                    break
    for i, small in enumerate(order):
        yield ("drop", small, 0), without_part(motions, small, 0)
        for large in order[i + 1 :] if joins else ():
            if any(
                min(len(a), len(b)) >= 5 and _touch(a, b) for a, b in zip(points[small], points[large], strict=True)
            ):
                yield ("join", small, large + 1), without_part(motions, small, large + 1)


def _touch(a: Tensor, b: Tensor) -> bool:
    """Whether two point sets [N, 3], [M, 3] come as near to each other somewhere as the smaller one's points are to
    theirs."""
    if len(a) > len(b):
        a, b = b, a
    spacing = knn(a, None, 1, True)[0].median()
    return float(knn(b, a, 1, False)[0].quantile(0.02)) < 3 * float(spacing)


def renumbering(count: int, index: int, into: int) -> Tensor:
    """[count + 1] new label of each old one, where entry ``index`` of ``count`` goes and its Gaussians get label
    ``into``."""
    out = torch.arange(count + 1)
    out[index + 1 :] -= 1
    out[index + 1] = out[into]
    return out


def without_part(motions: PartMotions, index: int, into: int) -> PartMotions:
    """The same motions without entry ``index``; its Gaussians get label ``into`` (numbered as before: 0 static, k + 1
    for entry k)."""
    keep = [k for k in range(len(motions)) if k != index]
    renumber = renumbering(len(motions), index, into)
    labels = [renumber[old] for old in motions.labels]
    return PartMotions(
        [motions.types[k] for k in keep],
        motions.transforms[keep],
        motions.confidence[keep],
        labels,
        motions.margin,
        motions.diagnostics,
    )


def settle_types(judge: Judge, motions: PartMotions, below: float, penalty: float) -> PartMotions:
    """Fit both joint types where a part turns by less than ``below`` (degrees), keep the one the images prefer; then
    refine with the types held.

    penalty: share of the image loss by which a turn must win: it has two freedoms more.
    """
    for k in range(len(motions)):
        angle = math.degrees(float(so3.rotation_angle(motions.transforms[k, :3, :3])))
        if motions.types[k] != "revolute" or angle >= below:
            continue
        other = judge.refine(min(_as_slides(judge.states, motions, k), key=judge.cost))
        if judge.saved(other, motions) >= -math.log1p(penalty):
            motions = other
    return motions


def _as_slides(states, motions: PartMotions, k: int) -> list[PartMotions]:
    """The same with part k a slide that carries its middle where it goes, or as far as that is along the slide of
    another part."""
    own = states[0].gaussians.means[motions.labels[0] == k + 1].double()
    centre = own.mean(0) if len(own) else torch.zeros(3).double()
    way = se3.apply(motions.transforms[k], centre[None])[0] - centre
    ways = [way]
    for i, kind in enumerate(motions.types):
        if kind == "prismatic":
            along = torch.nn.functional.normalize(motions.transforms[i, :3, 3], dim=0)
            ways += [along * (way @ along), along * way.norm() * torch.sign(way @ along)]
    out = []
    for w in ways:
        T = torch.eye(4).double()
        T[:3, 3] = w
        out.append(motions.with_motion(k, "prismatic", T))
    return out
