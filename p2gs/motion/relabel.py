"""Labels chosen anew: under other motions every Gaussian of both states goes to the part that explains it best."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.discovery import Candidate, Discovery, relabel
from p2gs.ops.sh import dc_to_rgb


def label_gaussians(explanation: Candidate, states: list[StateGaussians]) -> tuple[list[Tensor], list[Tensor]]:
    """Label and margin [N] of every Gaussian (also the faint ones) of both states."""
    labels, margin = [], []
    for state, s in enumerate(states):
        lab, mar = explanation.label_points(s.gaussians.means, dc_to_rgb(s.gaussians.sh[:, 0]).clamp(0, 1), state)
        labels.append(torch.as_tensor(lab, dtype=torch.int64))
        margin.append(torch.as_tensor(mar, dtype=torch.float32))
    return labels, margin


def relabelled(found: Discovery, states, motions: PartMotions) -> PartMotions:
    """The same motions with labels chosen anew, and discovery's confidence in them under these."""
    explanation = relabel(found, motions.transforms, motions.types)
    labels, margin = label_gaussians(explanation, states)
    return replace(
        motions, labels=labels, margin=margin, confidence=torch.tensor([m.confidence for m in explanation.motions])
    )
