"""An explanation in words: joints, confidences, and labels of the points that discovery was given."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from p2gs.motion.discovery.explanations import masses
from p2gs.motion.discovery.finish import Explanation
from p2gs.motion.discovery.labels import Labelling
from p2gs.motion.discovery.pool import plausibility
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.result import Candidate, FoundMotion
from p2gs.motion.discovery.rigid import Motions
from p2gs.motion.discovery.verify import light_of, violation
from p2gs.visibility.depth_stack import StateEvidence


def describe(problem: Problem, e: Explanation, start: StateEvidence, end: StateEvidence) -> Candidate:
    """Motions in words, confidences, labels of the input points."""
    c = Candidate(found_motions(problem, e.motions, e.labelling), problem.surfels, e.labelling.probability, e.score)
    c.labels_start = c.label_points(start.points, start.colours, 0)[0]
    c.labels_end = c.label_points(end.points, end.colours, 1)[0]
    return c


def found_motions(problem: Problem, motions: Motions, labelling: Labelling) -> list[FoundMotion]:
    """Each motion in words, with its confidence and mass under the labels."""
    found = []
    mass, light = masses(problem, labelling), light_of(problem, motions, labelling)
    pays = [p for p, _ in problem.pay(motions)] if len(motions) else []
    plausible = plausibility(problem, motions, pays, problem.samples, False) if len(motions) else torch.zeros(0)
    for k in range(len(motions)):
        T = motions.transform(k)
        turn = bool(motions.turn[k])
        mine = [labelling.labels(s) == k + 1 for s in (0, 1)]
        rows = [of.nonzero()[:, 0] for of in mine]
        agree = [
            1 - float(violation(problem, motions, labelling, s, i, light=light).mean()) if len(i) else 0.0
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
    j = surf.nearest(points, 1)[1][:, 0]
    e = torch.full((len(surf),), -1, dtype=torch.long)
    e[problem.static[state]] = 0
    e[problem.moved[state]] = 1
    return e[j]
