"""Photographs and drawings before one grey, so that they can be compared."""

from __future__ import annotations

import torch

from p2gs.data.views import TargetImage, TrainingViews
from p2gs.gaussians.draw import render_gaussians
from p2gs.types import Camera, GaussianTensors, RenderOutput

GREY = 0.5  # what stands behind the object in every picture


def photograph(views: TrainingViews, index: int, size: int, device) -> TargetImage:
    """A photograph before grey, on ``device``."""
    shot = views.get(index, views.levels.index(size), torch.full((3,), GREY))
    return TargetImage(shot.image.to(device), shot.alpha.to(device), None, shot.key, shot.camera.to(device))


def drawing(g: GaussianTensors, camera: Camera, backend: str) -> RenderOutput:
    """The Gaussians before grey; differentiable."""
    return render_gaussians(g, camera, torch.full((3,), GREY).to(g.means), backend=backend)
