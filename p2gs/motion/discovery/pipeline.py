"""Two reconstructed states -> parts, motions, labels: the stages in order."""

from __future__ import annotations

import math
import time
from typing import Callable, Optional

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from p2gs.motion.discovery.amounts import parted
from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.finish import Explanation, settle_parts
from p2gs.motion.discovery.hypotheses import directions, static_axes, sweep
from p2gs.motion.discovery.labels import Graph, Labelling, label
from p2gs.motion.discovery.pairs import crossed
from p2gs.motion.discovery.pool import plausibility
from p2gs.motion.discovery.problem import FEWEST, Problem, build_problem, resampled
from p2gs.motion.discovery.result import Candidate, Discovery, FoundMotion
from p2gs.motion.discovery.rigid import Motions, axes_used, without
from p2gs.motion.discovery.rows import rows
from p2gs.motion.discovery.search import ExclusiveGain, Search, two_sided
from p2gs.motion.discovery.verify import image_score, violation
from p2gs.native import at_once
from p2gs.ops import se3
from p2gs.types import UserError
from p2gs.visibility.depth_stack import StateEvidence


def discover(
    start: StateEvidence,
    end: StateEvidence,
    num_parts: "int | str" = "auto",
    config: Optional[DiscoveryConfig] = None,
    seed: int = 0,
    progress: Optional[Callable[[str, float], None]] = None,
) -> Discovery:
    """Find the moving parts, their motions and who belongs to them. No ground truth, no learning.

    num_parts: upper bound that counts the static base, or "auto" (``max_parts``).  progress: called with a stage's name
    and the share done. Raises UserError for a bad ``num_parts``.  Deterministic for a seed.
    """
    config = config or DiscoveryConfig()
    if num_parts != "auto" and (not isinstance(num_parts, int) or num_parts < 1):
        raise UserError(
            f"num_parts is {num_parts!r}, expected 'auto' or a whole number of parts that counts the static base"
        )
    limit = (config.max_parts if num_parts == "auto" else num_parts) - 1
    tell = progress or (lambda stage, share: None)
    clock, seconds = time.perf_counter(), {}

    def lap(stage: str, share: float) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage], clock = round(now - clock, 2), now
        tell(stage, share)

    problem, figures = build_problem(start, end, config, seed)
    lap("evidence", 0.2)
    graphs = [Graph(s.points, s.normals, s.colours) for s in problem.surfels]
    explanations: list[Explanation] = []
    search = None
    enough = max(int(m.sum()) for m in problem.moved) >= config.min_moved
    if limit > 0 and enough and min(map(len, problem.samples)) >= FEWEST:
        axes, still = directions(problem), static_axes(problem)
        most = max(limit, config.max_parts - 1)  # a bound cuts what is found, not the search
        sets: list[Motions] = []
        figures |= {"axes": axes.tolist(), "search": []}
        looks = [problem, *(resampled(problem, seed + number) for number in range(1, config.searches))]
        done = at_once(lambda looked: searched(looked, axes, most), looks)
        search = done[0][0]
        for one, found in done:
            sets += [f for f in found[: config.candidates] if not any(search.agree(f, other) for other in sets)]
            tried = {"motions_tried": len(one.swept.motions)}
            figures["search"].append({**tried, **one.trace[-1]} if one.trace else {})
        lap("selection", 0.7)
        explanations = at_once(lambda motions: finish(problem, graphs, motions, limit, still), sets)
        explanations += again(problem, graphs, search, explanations, limit, still)
        explanations = ranked(search, explanations)
        best = at_once(lambda e: divided(problem, graphs, e, limit, still), explanations[: config.candidates])
        explanations = ranked(search, best + explanations[config.candidates :])
        lap("labels", 0.95)
    if not explanations:
        nothing = [torch.ones(len(s), 1) for s in problem.surfels]
        explanations = [Explanation(Motions.empty(), Labelling(nothing, nothing))]
    candidates = [describe(problem, e, start, end) for e in explanations]
    best = candidates[0]
    out = Discovery(
        motions=best.motions,
        surfels=best.surfels,
        probability=best.probability,
        score=best.score,
        labels_start=best.labels_start,
        labels_end=best.labels_end,
        candidates=candidates,
        diagnostics=figures | {"seconds": seconds},
        problem=problem,
        graphs=graphs,
        search=search,
    )
    out.margin_start = best.label_points(start.points, start.colours, 0)[1]
    out.margin_end = best.label_points(end.points, end.colours, 1)[1]
    out.evidence_start, out.evidence_end = (nearest_evidence(problem, e.points, s) for s, e in enumerate((start, end)))
    out.diagnostics["candidates"] = [
        {
            "score": round(c.score, 4),
            "parts": [(m.type, round(m.amount, 4), round(m.confidence, 3)) for m in c.motions],
        }
        for c in candidates
    ]
    lap("description", 1.0)
    return out


def searched(problem: Problem, axes: Tensor, limit: int) -> tuple[Search, list[Motions]]:
    """A search among all motions about ``axes`` [D, 3], and the sets of motions that it found, best first."""
    search = Search(problem, sweep(problem, axes), limit, problem.config.part_cost)
    solutions = search.solve()
    solutions += search.alternatives(solutions)
    found = [search.pool.motions[torch.tensor(chosen)] for value, chosen in solutions if value > 0 and chosen]
    return search, found


def relabel(found: Discovery, transforms: Tensor, types: list[str]) -> Candidate:
    """The explanation by other motions: transforms [K, 4, 4] start -> end, types "revolute" | "prismatic". Every surfel
    chooses anew."""
    motions = sided(found.problem, as_motions(transforms, types))
    labelling = label(found.problem, motions, found.graphs, revealed=True)
    return Candidate(
        found_motions(found.problem, motions, labelling), found.problem.surfels, labelling.probability, 0.0
    )


def surface_energy(found: Discovery, transforms: Tensor, types: list[str]) -> float:
    """What the surfaces say against motions [K, 4, 4], every surfel choosing anew: where they land in seen-free space
    or on what has another colour, moved surface that nothing carries, implausible joints, a price on each part, less
    what the motions explain. Lower is better; 0 where nothing moved."""
    if found.search is None:
        return 0.0
    motions = sided(found.problem, as_motions(transforms, types))
    labelling = label(found.problem, motions, found.graphs)
    return total_score(found.problem, motions, labelling)


def instead_of(
    found: Discovery, transforms: Tensor, types: list[str], part: int | None, count: int = 2
) -> list[tuple[Tensor, str]]:
    """Motions [4, 4] that best explain what all parts but ``part`` leave over (None: what all leave over), and their
    types: up to ``count`` turns and as many slides, without the part's own.

    The search fits all parts to one another's remains while all are rough; with the others refined the same evidence
    can say more.
    """
    search = found.search
    if search is None:
        return []
    own = sided(found.problem, as_motions(transforms, types))
    rest = search.pool.add(own if part is None else without(own, part)).tolist()
    motions, _ = search.propose(rest, 96, 12, each=True)
    if not len(motions):
        return []
    index = search.pool.add(motions).tolist()
    best = sorted(range(len(index)), key=lambda i: search.value([*rest, index[i]]), reverse=True)
    known = own if part is None else own[part : part + 1]
    far = (known.swept(search.probe, motions) > search.radius).all(0)
    picked = [
        i for turn in (True, False) for i in [i for i in best if far[i] and bool(motions.turn[i]) == turn][:count]
    ]
    return [(motions.transform(i), "revolute" if bool(motions.turn[i]) else "prismatic") for i in picked]


def in_two(found: Discovery, transforms: Tensor, types: list[str]) -> list[tuple[int, Tensor, list[str]]]:
    """Each part as two bodies that move about one axis by amounts of their own, by the pairs that leave least of the
    moved surface unexplained: (part, motions [K + 1, 4, 4] with the second body's last, their types)."""
    if found.search is None:
        return []
    problem = found.problem
    own, axes = sided(problem, as_motions(transforms, types)), static_axes(problem)
    labelling, out = label(problem, own, found.graphs), []
    for k in range(len(own)):
        for more in parted(problem, found.graphs, labelling, own, k, axes):
            out.append((k, torch.stack([more.transform(i) for i in range(len(more))]), [*types, types[k]]))
    return out


def in_rows(
    found: Discovery, transforms: Tensor, types: list[str], axes: Tensor, limit: int
) -> list[tuple[Tensor, list[str]]]:
    """Up to ``limit`` motions where several bodies slid along one of the directions ``axes`` [D, 3], each by an amount
    of its own (``rows``): (motions [K', 4, 4], their types)."""
    if found.search is None:
        return []
    own = sided(found.problem, as_motions(transforms, types))
    labelling = label(found.problem, own, found.graphs)
    return [stacked(m) for m in rows(found.problem, labelling, own, axes.float()) if len(m) <= limit]


def stacked(motions: Motions) -> tuple[Tensor, list[str]]:
    """Motions as transforms [K, 4, 4] and types "revolute" | "prismatic"."""
    kinds = ["revolute" if bool(t) else "prismatic" for t in motions.turn]
    return torch.stack([motions.transform(i) for i in range(len(motions))]), kinds


def places_changed(
    found: Discovery, transforms: Tensor, types: list[str], count: int = 3
) -> list[tuple[int, Tensor, list[str]]]:
    """Two parts each with the other's end for its own, for the ``count`` pairs that explain most so: (one of them,
    motions [K, 4, 4], types)."""
    if found.search is None or len(types) < 2:
        return []
    own = sided(found.problem, as_motions(transforms, types))
    out = []
    for k, more in crossed(found.search, label(found.problem, own, found.graphs), own, count):
        out.append((k, *stacked(more)))
    return out


def sided(problem: Problem, motions: Motions) -> Motions:
    """The motions with the thickness of plate under which most of the moved surface arrives."""
    return two_sided(problem, motions, ExclusiveGain(problem, problem.samples, problem.weights))


def as_motions(transforms: Tensor, types: list[str]) -> Motions:
    """Motions [K] of transforms [K, 4, 4] start -> end of types "revolute" | "prismatic"."""
    screw = se3.screw_parameters(transforms.double())
    turn = torch.tensor([t == "revolute" for t in types], dtype=torch.bool)
    amount = torch.where(turn, screw.angle, screw.translation)
    return Motions(turn, screw.axis.float(), screw.origin.float(), amount.float())


def finish(problem: Problem, graphs: list[Graph], motions: Motions, limit: int, axes: Tensor) -> Explanation:
    """Label and fit a chosen set; drop parts without mass, and those that the score is better without."""
    motions, labelling = settle_parts(problem, graphs, motions, axes)
    while (pair := twins(problem, motions, labelling)) is not None:
        motions, labelling = settle_parts(problem, graphs, without(motions, pair), axes)
    while len(motions):
        mass = masses(problem, labelling)
        k = min(range(len(mass)), key=lambda i: mass[i])
        if mass[k] >= problem.config.min_mass:
            break
        motions, labelling = settle_parts(problem, graphs, without(motions, k), axes, rounds=1)
    return prune(problem, graphs, motions, labelling, limit, axes)


def divided(problem: Problem, graphs: list[Graph], found: Explanation, limit: int, axes: Tensor) -> Explanation:
    """Parts made two by amounts of their own about one axis (``parted``), up to ``limit`` parts, while the score
    falls."""
    while 0 < len(found.motions) < limit:
        best = found
        for k in range(len(found.motions)):
            for motions in parted(problem, graphs, found.labelling, found.motions, k, axes):
                labelling = label(problem, motions, graphs)
                score = total_score(problem, motions, labelling)
                if score < best.score:
                    best = Explanation(motions, labelling, score)
        if best is found:
            break
        motions, labelling = settle_parts(problem, graphs, best.motions, axes, rounds=1)
        score = total_score(problem, motions, labelling)
        found = min(best, Explanation(motions, labelling, score), key=lambda e: e.score)
    return found


def again(
    problem: Problem, graphs: list[Graph], search: Search, found: list[Explanation], limit: int, axes: Tensor
) -> list[Explanation]:
    """What the search makes of the best explanations once their motions are fitted: sets that are new to it, finished.

    A wrong motion is often there because a rough one left over what it explains.
    """
    known = [search.pool.add(e.motions).tolist() for e in found]
    out = []
    for start in sorted(range(len(found)), key=lambda i: found[i].score)[:2]:
        chosen = search.improve(search.refit(known[start]))
        if chosen and not any(search.same(chosen, other) for other in known):
            known.append(chosen)
            motions = search.pool.motions[torch.tensor(chosen)]
            out.append(finish(problem, graphs, motions, limit, axes))
    return out


def ranked(search: Search, found: list[Explanation]) -> list[Explanation]:
    """Best first, without those whose motions all agree with a better one's."""
    out: list[Explanation] = []
    for e in sorted(found, key=lambda e: e.score):
        if not any(search.agree(e.motions, better.motions) for better in out):
            out.append(e)
    return out


def prune(
    problem: Problem, graphs: list[Graph], motions: Motions, labelling: Labelling, limit: int, axes: Tensor
) -> Explanation:
    """Drop parts, the least needed first, down to ``limit`` and while the explanation of both states' images gets no
    worse without them."""
    score = total_score(problem, motions, labelling)
    while len(motions) > 1:
        tried = []
        for k in range(len(motions)):
            fewer = without(motions, k)
            tried.append((total_score(problem, fewer, label(problem, fewer, graphs)), k, fewer))
        least, _, fewer = min(tried, key=lambda t: t[:2])
        if least > score and len(motions) <= limit:
            break
        motions, labelling = settle_parts(problem, graphs, fewer, axes, rounds=1)
        score = total_score(problem, motions, labelling)
    return Explanation(motions, labelling, score)


def total_score(problem: Problem, motions: Motions, labelling: Labelling) -> float:
    """Image-space violation, the price of the parts and half of the moved surface that hangs on implausible joints.
    Lower is better.

    A further slide along the very direction of another costs a third: of its three freedoms it takes one.
    """
    if not len(motions):
        return image_score(problem, motions, labelling)
    pays = [p for p, _ in problem.pay(motions)]
    doubt = float(
        (
            torch.tensor(masses(problem, labelling))
            * (1 - plausibility(problem, motions, pays, problem.samples, False))
        ).sum()
    )
    axes = axes_used(motions)
    price = problem.config.part_cost * (axes + (len(motions) - axes) / 3)
    return image_score(problem, motions, labelling) + price + 0.5 * doubt


def twins(problem: Problem, motions: Motions, labelling: Labelling) -> int | None:
    """The smaller part of two that touch and whose motions carry their points to the same places, to within the
    tolerance across surfaces: surfaces cannot tell them apart (the photographs are asked later). None where there are
    no such two."""
    mass = masses(problem, labelling)
    for small in sorted(range(len(motions)), key=mass.__getitem__):
        for large in (k for k in range(len(motions)) if k != small):
            for s in (0, 1):
                a, b = (problem.surfels[s].points[labelling.labels(s) == k + 1] for k in (small, large))
                if len(a) and len(b) and touching(a, b, problem.scale.spacing):
                    gap = motions[small : small + 1].apply(a, s == 1) - motions[large : large + 1].apply(a, s == 1)
                    if float(gap.pow(2).sum(-1).mean().sqrt()) < problem.scale.tp:
                        return small
    return None


def touching(a: Tensor, b: Tensor, spacing: float) -> bool:
    """Do some of the surfels a [N, 3] lie as near to b [M, 3] as neighbours on one surface do?"""
    return bool((cKDTree(b.numpy()).query(a.numpy())[0] < 2 * spacing).sum() > 2)


def masses(problem: Problem, labelling: Labelling) -> list[float]:
    """Share of the moved surface of both states of each part."""
    out = torch.zeros(labelling.probability[0].shape[1])
    for s in (0, 1):
        out.index_add_(0, labelling.labels(s), problem.trust[s] * problem.moved[s])
    return (out[1:] / out.sum().clamp_min(1e-9)).tolist()


def describe(problem: Problem, e: Explanation, start: StateEvidence, end: StateEvidence) -> Candidate:
    """Motions in words, confidences, labels of the input points."""
    c = Candidate(found_motions(problem, e.motions, e.labelling), problem.surfels, e.labelling.probability, e.score)
    c.labels_start = c.label_points(start.points, start.colours, 0)[0]
    c.labels_end = c.label_points(end.points, end.colours, 1)[0]
    return c


def found_motions(problem: Problem, motions: Motions, labelling: Labelling) -> list[FoundMotion]:
    """Each motion in words, with its confidence and mass under the labels."""
    found = []
    mass = masses(problem, labelling)
    pays = [p for p, _ in problem.pay(motions)] if len(motions) else []
    plausible = plausibility(problem, motions, pays, problem.samples, False) if len(motions) else torch.zeros(0)
    for k in range(len(motions)):
        T = motions.transform(k)
        turn = bool(motions.turn[k])
        mine = [labelling.labels(s) == k + 1 for s in (0, 1)]
        rows = [of.nonzero()[:, 0] for of in mine]
        agree = [
            1 - float(violation(problem, motions, labelling, s, i).mean()) if len(i) else 0.0
            for s, i in enumerate(rows)
        ]
        middle = problem.surfels[0].points[mine[0]].mean(0).double() if mine[0].any() else problem.centre.double()
        axis = motions.axis[k].double()
        axis = axis / axis.norm()
        origin = motions.centre[k].double()
        origin = origin + axis * ((middle - origin) @ axis) if turn else middle
        found.append(
            FoundMotion(
                type="revolute" if turn else "prismatic",
                transform=T,
                axis=axis,
                origin=origin,
                amount=math.degrees(float(motions.amount[k])) if turn else float(motions.amount[k]),
                confidence=float(max(0.0, min(agree)) * plausible[k].clamp(0, 1) * min(1.0, mass[k] / 0.05)),
                mass=mass[k],
            )
        )
    return found


def nearest_evidence(problem: Problem, points: Tensor, state: int) -> Tensor:
    """1 moved, 0 static, -1 unknown, of the surfel nearest to each point."""
    surf = problem.surfels[state]
    j = torch.from_numpy(np.asarray(cKDTree(surf.points.numpy()).query(points.detach().cpu().float().numpy())[1]))
    e = torch.full((len(surf),), -1, dtype=torch.long)
    e[problem.static[state]] = 0
    e[problem.moved[state]] = 1
    return e[j]
