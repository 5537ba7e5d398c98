"""Is one part two of nearly the same motion? Where its surface prefers which amount, as the photographs tell.

Two drawers side by side that slide by lengths closer than the surfaces are exact look like one to geometry (``split_amounts`` asks it).
In the photographs each has its edges in its own place.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.models.discovery.evidence import DepthStack
from p2gs.models.discovery.labels import Graph, smooth_labels
from p2gs.models.handover import PartMotions
from p2gs.models.refine_motions import sides_of
from p2gs.models.screw_polish import MovedGaussians, PolishConfig, polish
from p2gs.ops import se3
from p2gs.ops.knn import knn
from p2gs.ops.sh import dc_to_rgb
from p2gs.types import GaussianTensors

FEWEST = 10  # solid Gaussians in each state that a half must have
COARSE = tuple(i / 4 for i in range(-4, 5))  # amounts tried, in shares of the reach
FINE = (-1.0, -0.64, -0.32, -0.16, -0.08, 0.0, 0.08, 0.16, 0.32, 0.64, 1.0)  # and near the one that is known
SPREAD = 12  # rounds of averaging over neighbours


def with_amount(T: Tensor, kind: str, shift: float, arm: float) -> Tensor:
    """The motion [4, 4] with ``shift`` (internal units) more displacement at ``arm`` from its axis; a slide: along it."""
    if kind == "prismatic":
        out = T.clone()
        out[:3, 3] += shift * torch.nn.functional.normalize(T[:3, 3], dim=0)
        return out
    screw = se3.screw_parameters(T)
    return se3.from_screw(screw.axis, screw.origin, screw.angle + shift / arm).to(T)


def residuals_by_gaussian(
    gaussians: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    views: TrainingViews,
    *,
    level: int,
    count: int,
    backend: str,
    device="cpu",
) -> tuple[Tensor, Tensor]:
    """Mean |render - photo| [N] of the pixels that each moved Gaussian shows in, weighted by how much it shows, and those weights' sum [N].

    Labels of -1 are left out (0 in both). A Gaussian's weight in a pixel is the derivative of a feature channel by its feature.
    """
    body = MovedGaussians(gaussians, labels, device)
    means, quats, sh = body.moved(transforms)
    features = torch.zeros(len(means), 2, device=body.device, requires_grad=True)
    background = torch.full((3,), 0.5)
    total = torch.zeros(len(means), 2, device=body.device)
    for index in views.spread(count):
        shot = views.get(index, views.levels.index(level), background)
        out = body.render(means, quats, sh, shot.camera, background, backend, features=features)
        off = (out.colour.detach() - shot.image.to(body.device)).abs().mean(-1)
        (grad,) = torch.autograd.grad((out.features * torch.stack([off, torch.ones_like(off)], -1)).sum(), features)
        total += grad
    found = torch.zeros(2, len(labels))
    found[:, labels >= 0] = total.T.cpu()
    return found[0] / found[1].clamp_min(1e-6), found[1]


def amount_costs(
    states,
    motions: PartMotions,
    views,
    shifts: list[float],
    *,
    level: int,
    count: int = 8,
    min_opacity: float = 0.5,
    backend: str,
    device="cpu",
) -> list[tuple[Tensor, Tensor]]:
    """Per state residuals [N, S] of its solid Gaussians in the other state's photographs with every part's motion ``shifts`` [S] longer
    (internal units at the part's rim), and how much each shows [N, S].

    views: photographs by state, ``count`` of which are looked at in size ``level``.  min_opacity: fainter ones are not solid (0 in both).
    """
    arms = [rim(states, motions, k) for k in range(len(motions))]
    out = []
    for s in (0, 1):
        labels = torch.where(torch.sigmoid(states[s].gaussians.opacity_logits) > min_opacity, motions.labels[s], -1)
        found = []
        for shift in shifts:
            T = torch.stack([with_amount(motions.transforms[k], kind, shift, arms[k]) for k, kind in enumerate(motions.types)])
            T = se3.inverse(T) if s else T
            found.append(
                residuals_by_gaussian(
                    states[s].gaussians, labels, T, views[1 - s], level=level, count=count, backend=backend, device=device
                )
            )
        out.append(tuple(torch.stack(column, 1) for column in zip(*found, strict=True)))
    return out


def rim(states, motions: PartMotions, part: int) -> float:
    """Mean distance of a part's Gaussians from its axis (1 for a slide)."""
    if motions.types[part] == "prismatic":
        return 1.0
    screw = se3.screw_parameters(motions.transforms[part])
    away = []
    for s in (0, 1):
        d = states[s].gaussians.means[motions.labels[s] == part + 1].double().cpu() - screw.origin
        away.append((d - (d @ screw.axis)[:, None] * screw.axis).norm(dim=1))
    away = torch.cat(away)
    return max(float(away.mean()), 1e-2) if len(away) else 1.0


def split_part(
    states, motions: PartMotions, part: int, costs: list[tuple[Tensor, Tensor]], shifts: list[float]
) -> tuple[float, PartMotions] | None:
    """The part as two by the best pair of amounts, and the share of its residual that this saves against the best single amount.

    costs: of ``amount_costs``.  None where a half would have next to nothing in a state.
    """
    rows = [((motions.labels[s] == part + 1) & (costs[s][1].amax(1) > 0)).nonzero().squeeze(1) for s in (0, 1)]
    if min(map(len, rows)) < 2 * FEWEST:
        return None
    T, kind = motions.transforms[part], motions.types[part]
    points = torch.cat(
        [states[0].gaussians.means[rows[0]].cpu(), se3.apply(se3.inverse(T), states[1].gaussians.means[rows[1]].cpu().double()).float()]
    )
    colours = torch.cat([dc_to_rgb(states[s].gaussians.sh[rows[s], 0]).clamp(0, 1).cpu() for s in (0, 1)])
    graph = Graph(points, torch.zeros_like(points), colours)  # both states' in one place: what one hides the other tells
    cost = torch.cat([costs[s][0][rows[s]] for s in (0, 1)])
    weight = torch.cat([costs[s][1][rows[s]] for s in (0, 1)]).amin(1, keepdim=True).clamp_max(20.0) + 1e-3
    cost = cost * weight
    mass = weight
    for _ in range(SPREAD):
        cost, mass = 0.5 * cost + 0.5 * graph.average(cost), 0.5 * mass + 0.5 * graph.average(mass)
    cost = cost / mass
    w = (weight / weight.sum())[:, 0]
    single = (w @ cost).min()
    pairs = torch.stack([w @ torch.minimum(cost, cost[:, i : i + 1]) for i in range(len(shifts))])
    a, b = divmod(int(pairs.fill_diagonal_(torch.inf).argmin()), len(shifts))  # two different amounts
    scale = float((w * (cost[:, a] - cost[:, b]).abs()).sum().clamp_min(1e-6))
    second = smooth_labels(cost[:, [a, b]] / (3 * scale), graph).argmax(1) == 1
    halves = second.split([len(r) for r in rows])
    if any(min(int(h.sum()), int((~h).sum())) < FEWEST for h in halves):
        return None
    arm = rim(states, motions, part)
    labels = [of.clone() for of in motions.labels]
    for s in (0, 1):
        means = states[s].gaussians.means
        every = (motions.labels[s] == part + 1).nonzero().squeeze(1)  # also the faint and the unseen, by their nearest
        nearest = knn(means[rows[s]], means[every], 1, False)[1][:, 0]
        labels[s][every[halves[s][nearest.cpu()]]] = len(motions) + 1
    parted = motions.with_motion(part, kind, with_amount(T, kind, shifts[a], arm))
    parted = parted.with_motion(len(motions), kind, with_amount(T, kind, shifts[b], arm))
    confidence = torch.cat([motions.confidence, motions.confidence[part : part + 1]])
    return float((single - pairs[a, b]) / single.clamp_min(1e-9)), replace(parted, labels=labels, confidence=confidence)


def splits(
    states,
    motions: PartMotions,
    views,
    reach: float,
    least: float,
    *,
    steps: tuple[float, ...] = COARSE,
    level: int,
    backend: str,
    device="cpu",
) -> list[tuple[int, PartMotions]]:
    """Each part that is better explained as two, with the motions so.

    reach: how far the two amounts may be from the one (internal units at the part's rim; 0: nothing is tried); steps: the amounts in
    shares of it.  least: share of the part's residual that this must save.
    """
    if reach <= 0 or not len(motions):
        return []
    shifts = [reach * step for step in steps]
    costs = amount_costs(states, motions, views, shifts, level=level, backend=backend, device=device)
    found = ((k, split_part(states, motions, k, costs, shifts)) for k in range(len(motions)))
    return [(k, f[1]) for k, f in found if f is not None and f[0] >= least]


def ways_disagree(
    states, motions: PartMotions, pair: tuple[int, int], views, config: PolishConfig, stacks: list[DepthStack], *, seed: int, backend: str,
    device="cpu",
) -> float:  # fmt: skip
    """How far the two directions, refined alone, are from telling one difference between the motions of two parts, 0 (they do) and up.

    |f - b| / |f + b| with f, b the mean displacement of one part's motion against the other's over both parts' points. What a surface's
    error in its own state makes look like a second motion, the other direction does not confirm: that state's surfaces err otherwise.
    """
    told, (a, b) = [], pair
    points = torch.cat([states[0].gaussians.means[motions.labels[0] == k + 1] for k in pair]).double().cpu()
    for side in sides_of(states, motions, views, config, stacks, backend=backend, device=device):
        T, _ = polish([side], motions.transforms, motions.types, config, seed=seed, backend=backend, device=device)
        told.append((se3.apply(T[b], points) - se3.apply(T[a], points)).mean(0))
    return float((told[0] - told[1]).norm() / (told[0] + told[1]).norm().clamp_min(1e-12))
