"""What a finished discovery is asked later: labels and energy of other motions, and motions that explain more."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.motion.discovery.amounts import parted
from p2gs.motion.discovery.describe import found_motions
from p2gs.motion.discovery.explanations import total_score
from p2gs.motion.discovery.hypotheses import static_axes
from p2gs.motion.discovery.labels import label
from p2gs.motion.discovery.pairs import crossed
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.result import Candidate, Discovery
from p2gs.motion.discovery.rigid import Motions, without
from p2gs.motion.discovery.rows import rows
from p2gs.motion.discovery.search import ExclusiveGain, two_sided
from p2gs.ops import se3


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
    or on what has another colour, moved surface that nothing carries, hinges that no hinge would be, a price on each
    part. Lower is better; 0 where nothing moved."""
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
    motions, _ = search.propose(rest, 192, 12, each=True, unknown=True)
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


def stacked(motions: Motions) -> tuple[Tensor, list[str]]:
    """Motions as transforms [K, 4, 4] and types "revolute" | "prismatic"."""
    kinds = ["revolute" if bool(t) else "prismatic" for t in motions.turn]
    return torch.stack([motions.transform(i) for i in range(len(motions))]), kinds


def sided(problem: Problem, motions: Motions) -> Motions:
    """The motions with the thickness of plate under which most of the moved surface arrives."""
    return two_sided(problem, motions, ExclusiveGain(problem, problem.samples, problem.weights))


def as_motions(transforms: Tensor, types: list[str]) -> Motions:
    """Motions [K] of transforms [K, 4, 4] start -> end of types "revolute" | "prismatic"."""
    screw = se3.screw_parameters(transforms.double())
    turn = torch.tensor([t == "revolute" for t in types], dtype=torch.bool)
    amount = torch.where(turn, screw.angle, screw.translation)
    return Motions(turn, screw.axis.float(), screw.origin.float(), amount.float())
