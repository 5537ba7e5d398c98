"""Where each of a twin's Gaussians is kept: at the start or at the end, whichever shows it in more pixels.

A part's front may be seen in the one state and its back in the other. What the end alone shows is where it is by the
end's photographs, whatever the motion; so when a motion is put right after Gaussians were learned under another, each
keeps its place in its own state, and the motion says where it is in the other one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.pose import carry, with_static
from p2gs.ops import se3
from p2gs.types import GaussianTensors
from p2gs.visibility.share import seen_pixels


@dataclass(frozen=True)
class Homes:
    """labels [N]: part of each Gaussian (0 static).  at_end [N]: the part of those that are kept at the end, else 0."""

    labels: Tensor
    at_end: Tensor

    @property
    def at_start(self) -> Tensor:
        """[N] the part of those that are kept at the start, else 0."""
        return torch.where(self.at_end > 0, 0, self.labels)

    def kept(self, g: GaussianTensors, transforms: Tensor, time: float) -> GaussianTensors:
        """Each Gaussian in its own state; g: at ``time`` under the motions transforms [K, 4, 4], start -> end."""
        return self._moved(g, transforms, -time, 1 - time)

    def posed(self, kept: GaussianTensors, transforms: Tensor, time: float) -> GaussianTensors:
        """All Gaussians at ``time`` under the motions; kept: each in its own state."""
        return self._moved(kept, transforms, time, time - 1)

    def _moved(self, g: GaussianTensors, transforms: Tensor, from_start: float, from_end: float) -> GaussianTensors:
        g = carry(g, self.at_start, with_static(se3.screw_at(transforms, from_start)))
        return carry(g, self.at_end, with_static(se3.screw_at(transforms, from_end)))


def homes_of(
    g: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    time: float,
    views: dict[int, TrainingViews],
    backend: str = "auto",
) -> Homes:
    """By all photographs of both states, at their smallest size; g: at ``time`` under the motions transforms [K, 4, 4]
    of the parts ``labels`` [N]."""
    pixels = []
    for state in (0, 1):
        cameras = [views[state].camera(i, 0) for i in range(len(views[state]))]
        posed = carry(g, labels, with_static(se3.screw_at(transforms, state - time)))
        pixels.append(seen_pixels(posed, cameras, backend))
    return Homes(labels, torch.where(pixels[1] > pixels[0], labels, 0))
