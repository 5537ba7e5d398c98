"""From a chosen set of motions to parts: labels, fits to the labelled points, splitting of parts that share a joint axis, scores."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.models.discovery.hypotheses import balanced
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


def fit_part(problem: Problem, labelling: Labelling, motions: Motions, k: int, n: int = 900) -> Motions:
    """Part k's motion fitted to its labelled points: evidence search, then point-to-plane where it is well determined."""
    samples = part_samples(problem, labelling, k, n, moved_only=False)
    if min(len(s) for s in samples) < 8:
        return motions[k : k + 1]
    weights = [torch.full((len(s),), 1.0 / len(s)) for s in samples]

    def gain(m: Motions) -> Tensor:
        out = []
        for s in (0, 1):
            c = problem.cost(m, s, samples[s])[0]
            out.append((1 - c).mean(1))
        return balanced(out[0], out[1])

    m = motions[k : k + 1]
    start = gain(m)
    m, v = pattern_search(gain, m, 0.3 * problem.scale.tp, 10, value=start)
    fine = gauss_newton(problem, m, samples, weights, rounds=4, width0=1.0 * problem.scale.tp, width1=0.5 * problem.scale.tp)
    return fine if float(gain(fine)) > float(v) - 0.01 else m


def split_amounts(problem: Problem, labelling: Labelling, graphs: list[Graph], motions: Motions, k: int, reach: float = 4.0, steps: int = 21):
    """Do two amounts about one axis explain part k better than one?  (improvement, amount a, amount b).

    Costs of every moved point of the part over amounts within ``reach`` tolerances, averaged over neighbours; the best pair against the
    best single amount, as the share of the single cost that the pair removes, the smaller of the two states'.
    """
    m = motions[k : k + 1]
    arm = 0.35 if bool(m.turn) else 1.0
    delta = torch.linspace(-reach, reach, steps) * problem.scale.tp / arm
    many = Motions(m.turn.expand(steps), m.axis.expand(steps, 3), m.centre.expand(steps, 3), m.amount + delta)
    single, pair = [], []
    for s in (0, 1):
        index = torch.nonzero((labelling.labels(s) == k + 1) & problem.moved[s])[:, 0]
        if len(index) < 20:
            return 0.0, float(m.amount), float(m.amount)
        c = problem.cost(many, s, index)[0].T  # [P, D]
        full = torch.zeros(len(problem.surfels[s]), steps)
        have = torch.zeros(len(problem.surfels[s]), 1)
        full[index], have[index] = c, 1.0
        for _ in range(6):
            full = graphs[s].average(full * have) / graphs[s].average(have).clamp_min(1e-3) * have
            full[index] = 0.5 * full[index] + 0.5 * c
        c = full[index]
        single.append(c.mean(0))
        pair.append(torch.minimum(c[:, :, None], c[:, None, :]).mean(0))
    best = int((single[0] + single[1]).argmin())
    total = pair[0] + pair[1]
    flat = int(total.argmin())
    a, b = flat // steps, flat % steps
    gains = [float((single[s][best] - pair[s][a, b]) / single[s][best].clamp_min(0.02)) for s in (0, 1)]
    return min(gains), float(many.amount[a]), float(many.amount[b])


def with_amounts(motions: Motions, k: int, a: float, b: float) -> Motions:
    """Part k takes amount a, a new last part the same axis and amount b."""
    amount = motions.amount.clone()
    amount[k] = a
    new = Motions(motions.turn[k : k + 1], motions.axis[k : k + 1], motions.centre[k : k + 1], torch.tensor([b]))
    return Motions.cat([Motions(motions.turn, motions.axis, motions.centre, amount), new])


def settle_parts(problem: Problem, graphs: list[Graph], motions: Motions, rounds: int = 2) -> tuple[Motions, Labelling]:
    """Labels and fits in turn."""
    labelling = label(problem, motions, graphs)
    for _ in range(rounds):
        motions = Motions.cat([fit_part(problem, labelling, motions, k) for k in range(len(motions))]) if len(motions) else motions
        labelling = label(problem, motions, graphs)
    return motions, labelling
