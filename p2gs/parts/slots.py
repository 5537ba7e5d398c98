"""As many part slots as were asked for: found parts merged where there are more, spare slots beside them where there
are fewer.

The paper sets K, the number of slots, and asks what a wrong K does (tab:k_ablation, tab:k_sensitivity). Part discovery
finds the number by itself, so that K would only ever cut its list; ``exact_parts: true`` makes K what it is in the
paper.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.gaussians.handover import Articulation, PartMotions, StateGaussians
from p2gs.motion.screws import initial_screws
from p2gs.ops import se3, so3
from p2gs.types import ArticulatedObject


def merge_to(motions: PartMotions, states: list[StateGaussians], parts: int) -> tuple[PartMotions, list[str]]:
    """The motions with at most ``parts`` - 1 movable parts, and one line for each two that became one.

    Again and again the two parts become one whose joint refit costs least: the squared distance, summed over their
    solid Gaussians, between where one motion carries them and where their own do. The pair's motion and type are that
    fit's.
    """
    notes = []
    while len(motions) > max(parts - 1, 1):
        points = [_own_motion(motions, states, k) for k in range(len(motions))]
        fits = {
            (a, b): joint_refit(points[a], points[b]) for a in range(len(motions)) for b in range(a + 1, len(motions))
        }
        (a, b), (cost, kind, T) = min(fits.items(), key=lambda item: item[1][0])
        count = len(points[a][0]) + len(points[b][0])
        notes.append(
            f"exact_parts: parts {a + 1} and {b + 1} became one {kind} part; its points are "
            f"{(cost / count) ** 0.5:.4f} off (rms)"
        )
        motions = _merged(motions, a, b, kind, T)
    return motions, notes


def _own_motion(motions: PartMotions, states: list[StateGaussians], k: int) -> tuple[Tensor, Tensor]:
    """Where part k's solid Gaussians of both states are at the start and at the end by its own motion, [N, 3] each."""
    T, ends = motions.transforms[k], []
    for state, labels in zip(states, motions.labels, strict=True):
        g = state.gaussians
        own = g.means[(labels == k + 1) & (g.opacity_logits > 0)].double()
        ends.append((own, se3.apply(T, own)) if state.state == 0 else (se3.apply(se3.inverse(T), own), own))
    return torch.cat([e[0] for e in ends]), torch.cat([e[1] for e in ends])


def joint_refit(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> tuple[float, str, Tensor]:
    """One joint for two parts: summed squared residual, type, motion [4, 4]. a, b: points [N, 3] at the start and at
    the end."""
    start, end = torch.cat([a[0], b[0]]), torch.cat([a[1], b[1]])
    if len(start) == 0:
        return 0.0, "prismatic", torch.eye(4).double()
    slide = torch.eye(4).double()
    slide[:3, 3] = (end - start).mean(0)
    turn = se3.project_revolute(se3.make(*so3.kabsch(start, end)))
    fits = [
        (float((se3.apply(T, start) - end).square().sum()), kind, T)
        for kind, T in (("prismatic", slide), ("revolute", turn))
    ]
    return min(fits, key=lambda fit: fit[0])


def _merged(motions: PartMotions, a: int, b: int, kind: str, T: Tensor) -> PartMotions:
    """Parts a < b as one, at a's place."""
    keep = [k for k in range(len(motions)) if k != b]
    number = torch.arange(len(motions) + 1)
    number[b + 1] = a + 1
    number[b + 2 :] -= 1
    confidence = motions.confidence.clone()
    confidence[a] = torch.minimum(confidence[a], confidence[b])
    both = motions.with_motion(a, kind, T)
    labels = [number[of] for of in motions.labels]
    return replace(
        both,
        types=[both.types[k] for k in keep],
        transforms=both.transforms[keep],
        confidence=confidence[keep],
        labels=labels,
    )


def add_spare(labels: Tensor, transforms: Tensor, spare: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Labels [N] and transforms [K - 1, 4, 4] with ``spare`` slots more: each begins with an equal share of all
    Gaussians (N / K of them, drawn at random) and a random screw, as every slot of the paper's own start does."""
    if spare <= 0:
        return labels, transforms
    known, labels = len(transforms), labels.clone()
    share = len(labels) // (1 + known + spare)
    drawn = torch.randperm(len(labels), generator=generator)
    for i in range(spare):
        labels[drawn[i * share : (i + 1) * share]] = 1 + known + i
    return labels, torch.cat([transforms, initial_screws("random", spare + 1, generator).to(transforms)])


def slot_report(learned: Articulation, obj: ArticulatedObject, alive: list[int], found: int) -> list[dict]:
    """What became of every slot: {slot, spare, share of the Gaussians by argmax, mean probability, part: its id in the
    twin or null}.

    alive: the slot of each movable part of the twin, in order.  found: movable slots that discovery filled; those after
    them are spare.
    """
    labels, total = learned.part_ids, max(len(learned.probs), 1)
    part = {0: 0, **{slot: obj.parts[i + 1].id for i, slot in enumerate(alive)}}
    return [
        {
            "slot": k,
            "spare": k > found,
            "share": float((labels == k).sum()) / total,
            "probability": float(learned.probs[:, k].mean()),
            "part": part.get(k),
        }
        for k in range(learned.probs.shape[1])
    ]
