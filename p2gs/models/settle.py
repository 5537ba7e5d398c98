"""With refined motions: what each part's motion should be amid the others, and which Gaussians belong to it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from p2gs.models.discovery import Candidate, Discovery, instead_of, relabel
from p2gs.models.discovery.evidence import DepthStack
from p2gs.models.handover import PartMotions, StateGaussians
from p2gs.models.islands import settle_islands
from p2gs.models.joint_confidence import JointEvidence, common_level, measure_joints
from p2gs.models.part_choices import settle_types, without_part
from p2gs.models.part_split import FINE, splits, ways_disagree
from p2gs.models.refine_motions import energy, explanation_cost, refine
from p2gs.ops.sh import dc_to_rgb

if TYPE_CHECKING:
    from p2gs.models.part_motions import PartMotionsConfig

HOPELESS = 0.04  # share of image loss that refinement does not make good
SETTLED = 0.005  # a round of settling that lowers the image loss by less is the last


def label_gaussians(explanation: Candidate, states: list[StateGaussians]) -> tuple[list[Tensor], list[Tensor]]:
    """Label and margin [N] of every Gaussian (also the faint ones) of both states."""
    labels, margin = [], []
    for state, s in enumerate(states):
        lab, mar = explanation.label_points(s.gaussians.means, dc_to_rgb(s.gaussians.sh[:, 0]).clamp(0, 1), state)
        labels.append(torch.as_tensor(lab, dtype=torch.int64))
        margin.append(torch.as_tensor(mar, dtype=torch.float32))
    return labels, margin


def reconsider(
    found: Discovery,
    states,
    motions: PartMotions,
    views,
    config: PartMotionsConfig,
    stacks: list[DepthStack],
    limit: int,
    *,
    seed: int,
    backend: str,
    device="cpu",
) -> tuple[PartMotions, list[dict]]:
    """Exchange motions for others that explain what the refined rest leaves over, or add one, while the photographs agree.

    For each part, and below ``limit`` for one more, the search proposes motions (``instead_of``); with each every surfel chooses its
    part anew and the states are re-rendered. A part may also be two of nearly one motion (``splits``), as it is or with a doubtful part
    left out: what moved by another amount than its neighbour is easily explained by a wild motion. Two whose motions hardly differ save
    little, and so do errors of one state: both directions must tell the difference alike. The best of each
    kind is refined; the energy must fall, and with a further part the image loss as well, by ``part_penalty``: where surfaces alone gain
    it is junk. Junk lowers both by as much as a small door does: with labels chosen anew, a further part's surface must also be found in both states
    (discovery's confidence at least ``missing_confidence``) and the photographs must hold its joint where it is
    (``JointEvidence.confidence`` at least ``missing_evidence``).  Returns the motions and what was tried.
    """
    options = {"backend": backend, "device": device}
    level, log = config.coarse.levels[-1], []

    def cost_of(m: PartMotions) -> float:
        return explanation_cost(states, m, views, config.coarse, stacks, **options)

    cost = cost_of(motions)
    lowest = energy(found, motions, cost)
    for _ in range(limit if len(motions) else 0):
        tries = {"exchanged": [(k, m) for k in range(len(motions)) for m in _with_part(found, states, motions, k)]}
        tries["exchanged for a split"] = _split_without(found, states, motions, views, config, stacks, options)
        if len(motions) < limit:
            tries["added"] = [(len(motions), m) for m in _with_part(found, states, motions, None)]
            tries["split"] = splits(states, motions, views, config.split_reach, config.split, level=level, **options)
            tries["finely split"] = splits(
                states, motions, views, config.split_reach, config.split_fine, steps=FINE, level=level, **options
            )
        best = None
        for change, proposed in tries.items():
            if not proposed:
                continue
            costs = [cost_of(m) for _, m in proposed]
            part, tried = proposed[costs.index(min(costs))]
            entry = {"change": change, "part": part, "type": tried.types[part], "before": cost, "tried": min(costs), "after": None}
            log.append(entry)
            if min(costs) > cost * (1 + HOPELESS):
                continue
            refined = refine(states, tried, views, config.coarse, stacks, seed=seed, **options)
            reached, further = cost_of(refined), len(refined) > len(motions)
            if "split" in change:  # where the halves meet, geometry may know better once their motions are known
                anew = refine(states, _relabelled(found, states, refined), views, config.coarse, stacks, seed=seed, **options)
                reached, refined = min((reached, refined), (cost_of(anew), anew), key=lambda t: t[0])
            value = energy(found, refined, reached)
            entry |= {"after": reached, "energy": value - lowest}
            if value >= lowest or (further and reached > cost * (1 - config.part_penalty)):
                continue
            if change == "finely split":
                pair = (part, len(motions))
                entry["ways"] = ways_disagree(states, refined, pair, views, config.coarse, stacks, seed=seed, **options)
                if entry["ways"] >= config.split_ways:
                    continue
            if further:
                own = _relabelled(found, states, refined)
                evidence = _evidence(states, own, views, stacks, options)
                new = {part, len(motions)}
                entry |= {"confidence": min(float(own.confidence[k]) for k in new), "evidence": min(evidence[k].confidence for k in new)}
                if entry["confidence"] < config.missing_confidence or entry["evidence"] < config.missing_evidence:
                    continue
            if best is None or value < best[0]:
                best = (value, reached, refined)
        if best is None:
            break
        lowest, cost, motions = best
    return motions, log


def _with_part(found: Discovery, states, motions: PartMotions, part: int | None) -> list[PartMotions]:
    """The motions with another one for ``part`` (None: with one more), labels chosen anew."""
    k, out = len(motions) if part is None else part, []
    for transform, kind in instead_of(found, motions.transforms, motions.types, part):
        out.append(_relabelled(found, states, motions.with_motion(k, kind, transform)))
    return out


def _split_without(found: Discovery, states, motions: PartMotions, views, config: PartMotionsConfig, stacks, options: dict):
    """Without each part that the photographs do not hold where it is, labels chosen anew: which other part is two, and the motions so."""
    level, out = config.coarse.levels[-1], []
    if config.split_reach <= 0 or len(motions) < 2:  # of one part nothing would be left to be two
        return out
    evidence = _evidence(states, motions, views, stacks, options)
    for k in range(len(motions)):
        if evidence[k].confidence < config.doubtful:
            rest = _relabelled(found, states, without_part(motions, k, 0))
            out += splits(states, rest, views, config.split_reach, config.split, level=level, **options)
    return out


def _evidence(states, motions: PartMotions, views, stacks: list[DepthStack], options: dict) -> list[JointEvidence]:
    """What both states show of each joint (``measure_joints``)."""
    level = common_level(views)
    return measure_joints(states, motions.labels, motions.transforms, motions.types, views, stacks, level=level, **options)


def _relabelled(found: Discovery, states, motions: PartMotions) -> PartMotions:
    """The same motions with labels chosen anew, and discovery's confidence in them under these."""
    explanation = relabel(found, motions.transforms, motions.types)
    labels, margin = label_gaussians(explanation, states)
    return replace(motions, labels=labels, margin=margin, confidence=torch.tensor([m.confidence for m in explanation.motions]))


def settle_labels(
    found: Discovery, states, motions: PartMotions, views, config: PartMotionsConfig, stacks, *, seed: int, backend: str, device="cpu"
) -> tuple[PartMotions, list[dict]]:
    """With the refined motions every Gaussian chooses its part anew, islands are settled, motions refined again and types settled.

    For ``rounds`` rounds, while the images are explained better. Returns the motions and what each round measured.
    """
    options = {"seed": seed, "backend": backend, "device": device}
    rounds: list[dict] = []
    cost = explanation_cost(states, motions, views, config.coarse, stacks, backend=backend, device=device)
    for number in range(config.rounds if len(motions) else 0):
        best = None
        # amid a wrong explanation's labels the larger pieces need not be the right ones: islands are settled only from here on
        for name in ("kept", "anew"):
            tried = _relabelled(found, states, motions) if name == "anew" else motions
            labels, count = settle_islands([s.gaussians for s in states], tried.labels, tried.transforms, config.islands)
            tried = refine(states, replace(tried, labels=labels), views, config.coarse, stacks, **options)
            reached = explanation_cost(states, tried, views, config.coarse, stacks, backend=backend, device=device)
            rounds.append({"round": number, "labels": name, "islands": count, "before": cost, "after": reached})
            if best is None or reached < best[0]:
                best = (reached, tried)
        if best[0] >= cost:
            break
        motions = settle_types(states, best[1], views, config, stacks, **options)
        if best[0] > cost * (1 - SETTLED):
            break
        cost = explanation_cost(states, motions, views, config.coarse, stacks, backend=backend, device=device)
    return motions, rounds


def drop_unfounded(
    found: Discovery, states, motions: PartMotions, views, config: PartMotionsConfig, stacks, *, seed: int, backend: str, device="cpu"
) -> tuple[PartMotions, list[dict]]:
    """Without the parts whose confidence is below ``min_confidence``, the least first; labels are chosen anew and motions refined.

    A part that only one state shows has a motion that nothing was observed of: it may explain the other state's photographs a little better
    (by hiding junk), and is no finding. Returns the motions, and type and confidence of each that went.
    """
    gone: list[dict] = []
    while len(motions) and float(motions.confidence.min()) < config.min_confidence:
        k = int(motions.confidence.argmin())
        gone.append({"type": motions.types[k], "confidence": float(motions.confidence[k])})
        motions = _relabelled(found, states, without_part(motions, k, 0))
    if gone:
        motions = refine(states, motions, views, config.coarse, stacks, seed=seed, backend=backend, device=device)
    return motions, gone
