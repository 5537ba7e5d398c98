"""How far a slide went, as its front tells: a plane across the way lies where it was and where it came to.

Photographs of a drawer that was shut tell its way badly: its front ends in a frame of the same colour, its upper edge
is hidden, and a shift that covers more of it explains more. Its plane is known to a few thousandths all the same. And a
rigid body goes by one amount: a front that went by two is two drawers'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import shortest_axes
from p2gs.motion.directions import axis_of
from p2gs.motion.discovery.rows import FACING
from p2gs.motion.refine_motions import Judge
from p2gs.motion.surface_fit import ALONG
from p2gs.ops import se3
from p2gs.ops.knn import knn, search_tree
from p2gs.ops.robust import MEDIAN_SIGMA
from p2gs.parts.bodies import FEWEST
from p2gs.visibility.surfels import Surfels

ROUNDS = 2  # of surfaces looked for: noise lets those win that are near to where they are looked for
# standard errors, of both states together, by which two halves of a front differ that are two bodies: of 33 fronts two
# true ones 9.4 and 18, an edge beside a front 17, of one body at most 5.6 where it differed by what surfaces tell apart
SURE = 7.0


@dataclass(frozen=True)
class Front:
    """A state's surface across a slide: points [N, 3] where they are at the start, and how much farther along the way
    than the motion takes them the other state's surface lies, farther [N] (negative: less far). Internal units,
    float64."""

    points: Tensor
    farther: Tensor

    def __len__(self) -> int:
        return len(self.points)

    @property
    def amount(self) -> float:
        """How much farther the front as a whole went."""
        return float(self.farther.median())

    @property
    def spread(self) -> float:
        """Standard deviation of single points, robust."""
        return MEDIAN_SIGMA * float((self.farther - self.amount).abs().median())


@dataclass(frozen=True)
class Surface:
    """A state's surface points and normals [N, 3], float64, and the part [N] that each belongs to (0 static)."""

    points: Tensor
    normals: Tensor
    labels: Tensor


def surfaces_of(states: list[StateGaussians], motions: PartMotions) -> list[Surface]:
    """Both states' solid Gaussians."""
    out = []
    for state, labels in zip(states, motions.labels, strict=True):
        g = state.gaussians.detach().to("cpu")
        solid = g.solid
        out.append(Surface(g.means[solid].double(), shortest_axes(g[solid]).double(), labels.cpu()[solid]))
    return out


def surfels_of(surfels: list[Surfels], states: list[StateGaussians], motions: PartMotions) -> list[Surface]:
    """Both states' surfels, labelled as the solid Gaussian next to each."""
    out = []
    for s, gaussians in zip(surfels, surfaces_of(states, motions), strict=True):
        near = knn(gaussians.points.float().contiguous(), s.points.contiguous(), 1, False)[1][:, 0]
        out.append(Surface(s.points.double(), s.normals.double(), gaussians.labels[near]))
    return out


def across(directions: Tensor, way: Tensor) -> Tensor:
    """Those of ``directions`` [D, 3] in which a surface across a slide's ``way`` [3] extends."""
    return directions[(directions @ way).abs() < math.sqrt(1 - FACING**2)]


def front_of(surfaces: list[Surface], T: Tensor, part: int, state: int, reach: float) -> Front:
    """What of slide ``part``, of motion T [4, 4], stands across its way in ``state`` and finds such a surface of it in
    the other state: the nearest, where a surface along the way by ``reach`` is as near as one beside it by as much as
    surfaces' points lie apart (of the nearest in space noise would choose what agrees)."""
    T = T.double().cpu()
    way = axis_of("prismatic", T)
    p, q = (
        of.points[(of.labels == part + 1) & ((of.normals @ way).abs() > FACING)]
        for of in (surfaces[state], surfaces[1 - state])
    )
    if min(len(p), len(q)) < 2 or reach <= 0:
        return Front(p[:0], p[:0, 0])
    x = se3.apply(se3.inverse(T) if state else T, p)
    beside = ALONG * float(knn(q, None, 1, True)[0].median())
    squeezed = torch.eye(3).double() + (beside / reach - 1) * torch.outer(way, way)  # both limits are ``beside``
    tree, farther, found = search_tree((q @ squeezed).numpy()), torch.zeros(len(p)).double(), torch.ones(len(p)) > 0
    for _ in range(ROUNDS):
        at = x + (farther[found].median() if bool(found.any()) else 0.0) * way
        off, near = (torch.from_numpy(a) for a in tree.query((at @ squeezed).numpy()))
        farther, found = (q[near] - x) @ way, off < beside
    return Front((x if state else p)[found], (-farther if state else farther)[found])


@dataclass(frozen=True)
class Step:
    """A front that went by two amounts: the plane between them, normal [3] and offset along it, at the start; how much
    farther than the part's motion what lies before and behind it went; by how many standard errors they differ, both
    states together; whether the same one went farther in both."""

    normal: Tensor
    offset: float
    farther: tuple[float, float]
    sure: float
    alike: bool

    @property
    def size(self) -> float:
        """By how much the amounts differ."""
        return abs(self.farther[1] - self.farther[0])


def border_in(fronts: list[Front], directions: Tensor) -> tuple[Tensor, float] | None:
    """The plane across one of ``directions`` [D, 3], normal and offset, that parts a slide's front (``fronts`` of both
    states) in two so that least squares are left of what either half's amount does not explain. None where no plane
    leaves enough on either side."""
    best, least = None, math.inf
    for normal in directions:
        places = torch.cat([f.points @ normal for f in fronts]).sort().values
        for offset in places[FEWEST - 1 :: FEWEST].tolist():
            halves = _halves(fronts, normal, offset)
            if halves is not None:
                left = sum(float((_squares(a) + _squares(b)) / _squares(torch.cat([a, b]))) for a, b in halves)
                best, least = ((normal, offset), left) if left < least else (best, least)
    return best


def step_at(fronts: list[Front], normal: Tensor, offset: float) -> Step | None:
    """By how much the halves of a front (``fronts`` of both states) before and behind a plane differ; None where either
    is less than a front."""
    halves = _halves(fronts, normal, offset)
    if halves is None:
        return None
    steps = [float(b.median() - a.median()) for a, b in halves]
    errors = [math.sqrt(float(a.var() / len(a) + b.var() / len(b)) + 1e-12) for a, b in halves]
    before, behind = (float(sum(h[i].median() for h in halves)) / 2 for i in (0, 1))
    sure = math.hypot(*(d / e for d, e in zip(steps, errors, strict=True)))
    return Step(normal, offset, (before, behind), sure, steps[0] * steps[1] > 0)


def _halves(fronts: list[Front], normal: Tensor, offset: float) -> list[tuple[Tensor, Tensor]] | None:
    """Of each front the amounts [N] before and behind a plane; None where any are fewer than ``FEWEST``."""
    behind = [f.points @ normal >= offset for f in fronts]
    halves = [(f.farther[~b], f.farther[b]) for f, b in zip(fronts, behind, strict=True)]
    return None if min(len(h) for pair in halves for h in pair) < FEWEST else halves


def _squares(x: Tensor) -> Tensor:
    """Sum of squared deviations of [N] from their mean."""
    return (x - x.mean()).square().sum()


def part_fronts(
    judge: Judge,
    sharpened: list[StateGaussians],
    surfels: list[Surfels],
    motions: PartMotions,
    directions: Tensor,
    apart: float,
    limit: int,
) -> tuple[PartMotions, list[dict]]:
    """Each slide of which the front went by two amounts as two parts, each with its own, up to ``limit`` parts: by
    amounts that surfaces tell ``apart``, the same one farther in both states, by ``SURE`` standard errors, and if the
    photographs like that no less where it makes a difference (``Judge.own_share``: what lies in an edge is no front).
    ``surfels`` of both states, which are smooth, say where the border is, ``sharpened`` Gaussians by how much the
    halves differ.

    directions [D, 3]: of the object. Lengths are internal units. Returns the motions and what was tried: part, both
    amounts, by how many standard errors they differ, what was saved.
    """
    log: list[dict] = []
    part = 0
    while part < len(motions) < limit:
        step = _step_of(judge, sharpened, surfels, motions, part, directions)
        if step is not None and step.alike and step.size > apart and step.sure > SURE:
            two = in_two(judge.states, motions, part, step.normal, step.offset, step.farther)
            saved = judge.own_share(two, motions)
            amounts = [float(two.transforms[k, :3, 3].norm()) for k in (part, -1)]
            log.append({"part": part, "amounts": amounts, "standard_errors": step.sure, "own_share": saved})
            if saved >= 0:
                motions = two
                continue
        part += 1
    return motions, log


def _step_of(
    judge: Judge,
    sharpened: list[StateGaussians],
    surfels: list[Surfels],
    motions: PartMotions,
    part: int,
    directions: Tensor,
) -> Step | None:
    """What the sharpened Gaussians say of a part's front at the border that surfels see in it, of planes across
    ``directions`` [D, 3] that its way lies in; None of a turn, and where there is no front."""
    if motions.types[part] != "prismatic":
        return None
    T, reach = motions.transforms[part], judge.config.free_moving
    along = across(directions, axis_of("prismatic", T))
    smooth = surfels_of(surfels, judge.states, motions)
    border = border_in([front_of(smooth, T, part, s, reach) for s in (0, 1)], along)
    if border is None:
        return None
    surfaces = surfaces_of(sharpened, motions)
    return step_at([front_of(surfaces, T, part, s, reach) for s in (0, 1)], *border)


def weighed_amounts(
    states: list[StateGaussians], motions: PartMotions, ways: dict[str, Tensor], reach: float
) -> tuple[PartMotions, list[dict]]:
    """Each slide as long as photographs and its front say together, each weighed by how sure it is: photographs by how
    far apart both directions put the part (``ways``: "forward" and "backward" [K, 4, 4]), surfaces by how uneven they
    are. A slide of which either state shows no front stays.

    Returns the motions and of each slide that was weighed: part, how much farther its front went by either state, the
    front's weight.
    """
    log: list[dict] = []
    slides = [k for k, kind in enumerate(motions.types) if kind == "prismatic"] if ways else []
    surfaces = surfaces_of(states, motions) if slides else []
    for k in slides:
        T = motions.transforms[k]
        fronts = [front_of(surfaces, T, k, s, reach) for s in (0, 1)]
        if min(map(len, fronts)) < FEWEST:
            continue
        apart = float((ways["forward"][k] - ways["backward"][k])[:3, 3] @ axis_of("prismatic", T)) ** 2
        uneven = sum(f.spread**2 for f in fronts) / 2
        weight = apart / (apart + uneven) if apart > 0 else 1.0  # 0: no photograph pulled either way
        log.append({"part": k, "farther": [f.amount for f in fronts], "weight": weight})
        motions = motions.with_motion(k, "prismatic", slid_farther(T, weight * sum(f.amount for f in fronts) / 2))
    return motions, log


def in_two(
    states: list[StateGaussians],
    motions: PartMotions,
    part: int,
    normal: Tensor,
    offset: float,
    farther: tuple[float, float] = (0.0, 0.0),
) -> PartMotions:
    """The motions with what of slide ``part`` lies behind a plane (at the start) as a part of its own, the last; what
    is before and behind it goes ``farther`` than the part did."""
    T, labels = motions.transforms[part], []
    for s, (state, of) in enumerate(zip(states, motions.labels, strict=True)):
        means = state.gaussians.means.detach().double()
        start = se3.apply(se3.inverse(T).to(means), means) if s else means
        behind = (of == part + 1) & (start @ normal.to(means) >= offset)
        labels.append(torch.where(behind, len(motions) + 1, of))
    two = motions.with_motion(part, "prismatic", slid_farther(T, farther[0]))
    two = two.with_motion(len(motions), "prismatic", slid_farther(T, farther[1]))
    confidence = torch.cat([motions.confidence, motions.confidence[part : part + 1]])
    return replace(two, labels=labels, confidence=confidence)


def slid_farther(T: Tensor, farther: float) -> Tensor:
    """A slide [4, 4] that goes ``farther`` along its way."""
    out = T.clone()
    out[:3, 3] += farther * axis_of("prismatic", T)
    return out
