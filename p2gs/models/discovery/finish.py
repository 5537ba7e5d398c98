"""From a chosen set of motions to parts: labels, fits to the labelled points, splitting of parts that share a joint axis, scores."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.models.discovery.labels import Graph, Labelling, label
from p2gs.models.discovery.problem import Problem, spread_sample
from p2gs.models.discovery.refine import gauss_newton, pattern_search
from p2gs.models.discovery.rigid import Motions


@dataclass
class Explanation:
    """A complete explanation: motions, labelling, value of the set and image-space score (lower is better)."""

    motions: Motions
    labelling: Labelling
    value: float
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
    """``motion`` [1] with its axis turned (about the part's middle) onto each scene direction within ``within`` degrees: [0..]."""
    c = axes @ motion.axis[0]
    near = c.abs() > math.cos(math.radians(within))
    n = int(near.sum())
    a = motion.axis[0]
    centre = motion.centre[0] + a * ((middle - motion.centre[0]) @ a)
    return Motions(motion.turn.expand(n), axes[near] * c[near].sign()[:, None], centre.expand(n, 3), motion.amount.expand(n), motion.thick.expand(n))


def fit_part(problem: Problem, labelling: Labelling, motions: Motions, k: int, axes: Tensor, n: int = 900) -> Motions:
    """Part k's motion fitted to its labelled points: evidence search, then point-to-plane where it is well determined.

    axes [D, 3]: directions of the static surfaces; an axis near one is laid on it unless that costs evidence.
    """
    samples = part_samples(problem, labelling, k, n, moved_only=False)
    m = motions[k : k + 1]
    if max(len(s) for s in samples) < 8:
        return m
    weights = []
    for s, index in enumerate(samples):  # who is not known to have moved may be a neighbour's, and only seconds the others
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


def split_amounts(
    problem: Problem, labelling: Labelling, graphs: list[Graph], motions: Motions, k: int, steps: int = 25
) -> tuple[float, float, float]:
    """Do two amounts about one axis explain part k better than one?  (evidence, amount a, amount b).

    Costs of every moved point over amounts within four tolerances, averaged over neighbours. Of the best pair, the evidence is what
    the smaller half saves against the best single amount, relative to its cost, in the state where it saves less; nothing when the
    amounts differ by less than 0.9 tolerances: that is what noise does to one part.
    """
    m = motions[k : k + 1]
    tp = problem.scale.tp
    arm = 0.2 * problem.scale.diag if bool(m.turn) else 1.0
    delta = torch.linspace(-4, 4, steps) * tp / arm
    many = Motions(m.turn.expand(steps), m.axis.expand(steps, 3), m.centre.expand(steps, 3), m.amount + delta, m.thick.expand(steps))
    none = (0.0, float(m.amount), float(m.amount))
    costs = []
    for s in (0, 1):
        index = torch.nonzero((labelling.labels(s) == k + 1) & problem.moved[s])[:, 0]
        if len(index) < 20:
            return none
        c = problem.cost(many, s, index)[0].T  # [P, D]
        full = torch.zeros(len(problem.surfels[s]), steps)
        have = torch.zeros(len(problem.surfels[s]), 1)
        full[index], have[index] = c, 1.0
        for _ in range(8):
            full = graphs[s].average(full * have) / graphs[s].average(have).clamp_min(1e-3) * have
            full[index] = 0.5 * full[index] + 0.5 * c
        costs.append(full[index])
    single = sum(c.mean(0) for c in costs)
    pair = sum(torch.minimum(c[:, :, None], c[:, None, :]).mean(0) for c in costs)
    far = (delta[:, None] - delta[None]).abs() * arm >= 0.9 * tp
    pair = torch.where(far, pair, torch.full_like(pair, 9.0))
    a, b = divmod(int(pair.argmin()), steps)
    best = int(single.argmin())
    evidence = []
    for c in costs:
        second = c[:, b] < c[:, a]
        half = second if second.float().mean() < 0.5 else ~second
        if int(half.sum()) < 10:
            return none
        before, after = c[half, best].mean(), torch.minimum(c[half, a], c[half, b]).mean()
        evidence.append(float((before - after) / before.clamp_min(0.03)) * min(1.0, float(half.float().mean()) / 0.1))
    return min(evidence), float(many.amount[a]), float(many.amount[b])


def with_amounts(motions: Motions, k: int, a: float, b: float) -> Motions:
    """Part k takes amount a, a new last part the same axis and amount b."""
    amount = motions.amount.clone()
    amount[k] = a
    new = Motions(motions.turn[k : k + 1], motions.axis[k : k + 1], motions.centre[k : k + 1], torch.tensor([b]), motions.thick[k : k + 1])
    return Motions.cat([Motions(motions.turn, motions.axis, motions.centre, amount, motions.thick), new])


def settle_parts(problem: Problem, graphs: list[Graph], motions: Motions, axes: Tensor, rounds: int = 2) -> tuple[Motions, Labelling]:
    """Labels and fits in turn. axes [D, 3]: directions of the static surfaces."""
    labelling = label(problem, motions, graphs)
    for _ in range(rounds):
        motions = Motions.cat([fit_part(problem, labelling, motions, k, axes) for k in range(len(motions))]) if len(motions) else motions
        labelling = label(problem, motions, graphs)
    return motions, labelling
