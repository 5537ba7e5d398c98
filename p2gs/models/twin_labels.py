"""Labels of the last stage: of the twin's Gaussians and, by the twin, of each state's."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import Articulation, PartMotions, StateGaussians
from p2gs.gaussians.pose import carry, with_static
from p2gs.motion.directions import shared_axes
from p2gs.motion.discovery.rigid import one_way
from p2gs.ops import se3
from p2gs.ops.knn import knn
from p2gs.parts.islands import settle_twin_islands
from p2gs.surface.contents import in_trays
from p2gs.types import ArticulatedObject, GaussianTensors
from p2gs.visibility.depth_stack import DepthStack

UNKNOWN = 4.0  # a state's Gaussian farther than this from the twin, in the median's units, is none of the twin's


def majority(labels: Tensor, neighbours: Tensor, weights: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Weighted majority of labels [M] over neighbours [N, k] (indices into labels), weights [N, k]: label [N] and its
    share [N]."""
    votes = torch.zeros(len(neighbours), parts)
    votes.scatter_add_(1, labels[neighbours], weights)
    share, label = votes.max(1)
    return label, share / votes.sum(1).clamp_min(1e-9)


def clean_labels(g: GaussianTensors, labels: Tensor, parts: int, k: int) -> Tensor:
    """Labels [N] by the opacity-weighted majority of the k nearest Gaussians, each counting itself twice."""
    if k <= 0 or len(labels) <= k:
        return labels
    _, index = knn(g.means, None, k, True)
    own = torch.arange(len(labels))[:, None]
    index = torch.cat([own, own, index], dim=1)
    return majority(labels, index, torch.sigmoid(g.opacity_logits)[index], parts)[0]


def rows_as_found(
    learned: Articulation, labels: Tensor, states: list[StateGaussians], discovered: PartMotions, tau: float
) -> Tensor:
    """Labels [N] in which drawers of a row (``shared_axes``) that put a Gaussian at one place in either state, to
    within ``tau`` (internal units), have it as discovery had what is next to it: photographs do not tell them apart,
    and while labels are learned the border that fronts told frays. tau: 0 = off."""
    ways = shared_axes(discovered.transforms, discovered.types)
    row = torch.zeros(len(ways) + 1, len(ways) + 1, dtype=torch.bool)  # is a slot of one row with another? 0 is of none
    for k, way in enumerate(ways):
        row[k + 1, 1:] = one_way(ways, way)
    if not bool(row.any()):
        return labels
    ends = torch.stack([_at(learned, s) for s in (0, 1)], 1)  # [K, 2, N, 3]
    own = torch.arange(len(labels))
    here = ends[labels, :, own]  # [N, 2, 3]
    nearest, found = torch.full((len(labels),), torch.inf), labels.clone()
    for s, state in enumerate(states):
        solid = state.gaussians.solid
        means = state.gaussians.means.detach()[solid].cpu()
        d, j = knn(means.contiguous(), here[:, s].float().contiguous(), 1, False)
        closer = d[:, 0] < nearest
        nearest = torch.where(closer, d[:, 0], nearest)
        found = torch.where(closer, discovered.labels[s].cpu()[solid.cpu()][j[:, 0]], found)
    same = (ends[found, :, own] - here).norm(dim=2).amax(1) < tau
    return torch.where(row[labels, found] & same, found, labels)


def _at(learned: Articulation, state: int) -> Tensor:
    """Where every Gaussian is in a state under each slot's motion [K, N, 3], float64; slot 0 stays."""
    means = learned.gaussians.means.detach().cpu().double()
    T = with_static(se3.screw_at(learned.transforms.cpu().double(), state - learned.canonical_time))
    return torch.stack([se3.apply(one, means) for one in T])


def surviving_slots(learned: Articulation, labels: Tensor, min_mass: float, min_motion: float) -> list[int]:
    """Movable slots with mass and motion (``FinishConfig``), as slot numbers; labels [N]."""
    solid = learned.gaussians.solid
    alive = []
    for k in with_mass(learned.gaussians, labels, len(learned.types), min_mass):
        points = learned.gaussians.means[solid & (labels == k)].double()
        at = [
            se3.apply(se3.screw_at(learned.transforms[k - 1], s - learned.canonical_time), points) for s in (0.0, 1.0)
        ]
        if float((at[1] - at[0]).norm(dim=1).mean()) >= min_motion:
            alive.append(k)
    return alive


def with_mass(g: GaussianTensors, labels: Tensor, count: int, least: float) -> list[int]:
    """Of the labels 1 to ``count`` those that at least the share ``least`` of the solid Gaussians has; labels [N]."""
    held = torch.bincount(labels[g.solid], minlength=count + 1).tolist()
    return [k for k in range(1, count + 1) if held[k] / max(sum(held), 1) >= least]


def only(labels: Tensor, stay: list[int], count: int) -> Tensor:
    """Labels [N] of 0 to ``count`` numbered anew: those of ``stay`` 1, 2, ... in its order, all others the base's."""
    remap = torch.zeros(count + 1, dtype=torch.int64)
    remap[torch.tensor(stay, dtype=torch.int64)] = torch.arange(len(stay)) + 1
    return remap[labels]


def state_labels(
    learned: Articulation, labels: Tensor, state: StateGaussians, transforms: Tensor, k: int = 6
) -> tuple[Tensor, Tensor]:
    """Labels [M] of a single-state reconstruction by the twin posed in that state; margin = how far the majority
    exceeds the rest, 0..1, or -1 for what the twin has nothing near of (lids that gave way to walls): the polish leaves
    that out."""
    posed = carry(
        learned.gaussians, labels, se3.screw_at(with_static(transforms), state.state - learned.canonical_time)
    )
    solid = (torch.sigmoid(posed.opacity_logits) > 0.1).nonzero().squeeze(1)
    distance, index = knn(posed.means[solid], state.gaussians.means, k, False)
    spacing = distance[:, 0].median().clamp_min(1e-4)
    weights = torch.exp(-(distance / (2 * spacing)).square()) + 1e-9
    label, share = majority(labels[solid], index, weights, len(transforms) + 1)
    margin = torch.where(distance[:, 0] > UNKNOWN * spacing, -1.0, 2 * share - 1)
    return label, margin


def settle_labels(
    twin: ArticulatedObject,
    views: dict[int, TrainingViews],
    stacks: list[DepthStack],
    *,
    islands: float,
    trays: int,
    tau: float,
    backend: str,
) -> tuple[Tensor, int]:
    """Labels [N] without islands, what is in drawers with these; and to how many Gaussians the latter happened.

    twin: as learned, internal coordinates; views: photographs by state; stacks: rendered depth of both states; islands,
    trays: see ``FinishConfig``; tau: tolerance of depth, internal units; backend: draws the twin for what is in
    drawers.
    """
    fuller = round(twin.canonical_time)  # the state that shows more
    T = torch.stack(
        [torch.eye(4, dtype=torch.float64)] + [p.joint.transform for p in twin.parts[1:] if p.joint is not None]
    )
    away = se3.inverse(T) if fuller else T

    def without_islands(labels: Tensor, held: Tensor | None = None) -> Tensor:
        posed = carry(twin.gaussians, labels, se3.screw_at(T, fuller - twin.canonical_time))
        return settle_twin_islands(posed, labels, islands, away, stacks[1 - fuller], tau, held)

    labels = without_islands(twin.part_ids)
    if trays <= 0:
        return labels, 0
    cameras = [(s, views[s].camera(i, -1)) for s in (0, 1) for i in views[s].spread(trays)]
    settled, held = in_trays(replace(twin, part_ids=labels), cameras, backend)
    count = int((settled != labels).sum())
    return without_islands(settled, held) if count else labels, count
