"""From a chosen set of motions to parts: labels, and fits to the labelled points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.motion.discovery.labels import Graph, Labelling, label
from p2gs.motion.discovery.problem import Problem, spread_sample
from p2gs.motion.discovery.refine import gauss_newton, pattern_search
from p2gs.motion.discovery.rigid import Motions


@dataclass
class Explanation:
    """A complete explanation: motions, labelling and image-space score (lower is better)."""

    motions: Motions
    labelling: Labelling
    score: float = 0.0


def part_samples(problem: Problem, labelling: Labelling, k: int, n: int, moved_only: bool = True) -> list[Tensor]:
    """Surfels of part k (label k + 1) in each state, at most n, spread evenly."""
    out = []
    g = torch.Generator().manual_seed(k)
    for s in (0, 1):
        mask = (labelling.labels(s) == k + 1) & (labelling.probability[s][:, k + 1] > 0.6)
        if moved_only:
            mask &= problem.moved[s]
        index = torch.nonzero(mask)[:, 0]
        out.append(index[spread_sample(problem.surfels[s].points[index], n, g)] if len(index) else index)
    return out


def snapped(problem: Problem, motion: Motions, middle: Tensor, axes: Tensor, within: float = 15.0) -> Motions:
    """``motion`` [1] with its axis turned (about the part's middle) onto each scene direction within ``within``
    degrees: [0..]."""
    c = axes @ motion.axis[0]
    near = c.abs() > math.cos(math.radians(within))
    n = int(near.sum())
    a = motion.axis[0]
    centre = motion.centre[0] + a * ((middle - motion.centre[0]) @ a)
    return Motions(
        motion.turn.expand(n),
        axes[near] * c[near].sign()[:, None],
        centre.expand(n, 3),
        motion.amount.expand(n),
        motion.thick.expand(n),
    )


def fit_part(problem: Problem, labelling: Labelling, motions: Motions, k: int, axes: Tensor, n: int = 900) -> Motions:
    """Part k's motion fitted to its labelled points: evidence search, then point-to-plane where it is well determined.

    axes [D, 3]: directions of the static surfaces; an axis near one is laid on it unless that costs evidence.
    """
    samples = part_samples(problem, labelling, k, n, moved_only=False)
    m = motions[k : k + 1]
    if max(len(s) for s in samples) < 8:
        return m
    weights = []
    # who is not known to have moved may be a neighbour's, and only seconds the others
    for s, index in enumerate(samples):
        w = torch.where(problem.moved[s], 0.3 + problem.trust[s], torch.where(problem.static[s], 0.03, 0.2))[index]
        weights.append(w / w.sum().clamp_min(1e-9))
    tp = problem.scale.tp

    def gain(m: Motions) -> Tensor:
        return sum((1 - problem.cost(m, s, samples[s])[0]) @ weights[s] for s in (0, 1) if len(samples[s]) >= 8)

    def sharpen(m: Motions) -> tuple[Motions, Tensor]:
        m, v = pattern_search(gain, m, 0.3 * tp, 10)
        fine = gauss_newton(problem, m, samples, weights, rounds=4, width0=tp, width1=0.5 * tp)
        w = gain(fine)
        return (fine, w) if float(w) > float(v) - 0.01 else (m, v)

    free, value = sharpen(m)
    middle = (
        problem.surfels[0].points[samples[0]].mean(0)
        if len(samples[0])
        else free.apply(problem.surfels[1].points[samples[1]], True)[0].mean(0)
    )
    on_axis = snapped(problem, free, middle, axes, 15.0 if bool(free.turn) else 22.0)
    if len(on_axis):
        on_axis, v = pattern_search(gain, on_axis, 0.5 * tp, 10, tilt=False)
        best = int(v.argmax())
        if float(1 - v[best] / 2) < 1.12 * float(1 - value / 2) + 0.03:
            return on_axis[best : best + 1]
    return free


def settle_parts(
    problem: Problem, graphs: list[Graph], motions: Motions, axes: Tensor, rounds: int = 2
) -> tuple[Motions, Labelling]:
    """Labels and fits in turn. axes [D, 3]: directions of the static surfaces."""
    labelling = label(problem, motions, graphs)
    for _ in range(rounds):
        motions = (
            Motions.cat([fit_part(problem, labelling, motions, k, axes) for k in range(len(motions))])
            if len(motions)
            else motions
        )
        labelling = label(problem, motions, graphs)
    return motions, labelling
