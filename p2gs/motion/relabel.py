"""Labels chosen anew: under other motions every Gaussian of both states goes to the part that explains it best."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.discovery import Candidate, Discovery, Near, relabel
from p2gs.ops.sh import dc_to_rgb
from p2gs.types import GaussianTensors
from p2gs.visibility.surfels import Surfels

# what ``nearest_surfels`` found last: Gaussians, result
_NEAR: WeakKeyDictionary[Surfels, tuple[GaussianTensors, Near]] = WeakKeyDictionary()


def label_gaussians(explanation: Candidate, states: list[StateGaussians]) -> tuple[list[Tensor], list[Tensor]]:
    """Label and margin [N] of every Gaussian (also the faint ones) of both states."""
    labels, margin = [], []
    for state, (surfels, s) in enumerate(zip(explanation.surfels, states, strict=True)):
        lab, mar = explanation.label_by(nearest_surfels(surfels, s.gaussians), state)
        labels.append(lab)
        margin.append(mar)
    return labels, margin


def nearest_surfels(surfels: Surfels, g: GaussianTensors) -> Near:
    """The surfels by which a state's Gaussians are labelled. Found once for these: no motion changes them."""
    known = _NEAR.get(surfels)
    if known is None or known[0] is not g:
        known = _NEAR[surfels] = (g, Near.surfels(surfels, g.means, dc_to_rgb(g.sh[:, 0]).clamp(0, 1)))
    return known[1]


def relabelled(found: Discovery, states, motions: PartMotions) -> PartMotions:
    """The same motions with labels chosen anew, and discovery's confidence in them under these."""
    explanation = relabel(found, motions.transforms, motions.types)
    labels, margin = label_gaussians(explanation, states)
    return replace(
        motions, labels=labels, margin=margin, confidence=torch.tensor([m.confidence for m in explanation.motions])
    )
