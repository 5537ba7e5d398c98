"""What part discovery looks at: each state's surface points and its rendered depth, from trained Gaussians."""

from __future__ import annotations

from typing import Sequence

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.gaussians.draw import render_gaussians
from p2gs.types import Camera, GaussianTensors, View
from p2gs.visibility.depth_stack import StateEvidence


@torch.no_grad()
def render_depths(
    g: GaussianTensors, cameras: list[Camera], backend: str = "auto", device: torch.device | str = "cpu"
) -> tuple[list[Tensor], list[Tensor]]:
    """Depth [H, W] (0 where the ray meets little) and alpha [H, W] of each camera.

    The median depth (where the ray's transmittance passes one half) does not mix a front with what shows behind its
    edge, as the mean does; where the rasterizer has none the mean is taken.
    """
    depths, alphas = [], []
    g = g.to(device)
    for camera in cameras:
        out = render_gaussians(g, camera.to(device), None, sh_degree=0, backend=backend)
        depth = out.expected_depth if out.median_depth is None else out.median_depth
        depths.append(torch.where(out.alpha > 0.5, depth, torch.zeros_like(depth)).cpu())
        alphas.append(out.alpha.cpu())
    return depths, alphas


def object_window(view: View, size: int, margin: float = 0.06) -> Camera:
    """The camera of a square window around the view's mask, ``size`` pixels wide: small objects get as many pixels as
    large ones."""
    rows, cols = view.alpha.amax(1).nonzero().squeeze(1), view.alpha.amax(0).nonzero().squeeze(1)
    if rows.numel() == 0:
        return view.camera.scaled(size, size)
    top, left = int(rows[0]), int(cols[0])
    height, width = int(rows[-1]) + 1 - top, int(cols[-1]) + 1 - left
    side = round(max(height, width) * (1 + 2 * margin)) + 2
    window = view.camera.cropped(left + (width - side) // 2, top + (height - side) // 2, side, side)
    return window.scaled(size, size)


def gather_evidence(
    g: GaussianTensors, views: Sequence[View], size: int, min_opacity: float, backend: str = "auto", device="cpu"
) -> StateEvidence:
    """Evidence of one state: centres and colours of its solid Gaussians, depth and alpha maps of its training views.

    size: side of the maps in pixels; each shows the object's window of its view. Gaussians below ``min_opacity`` are
    left out of the points.
    """
    from p2gs.ops.sh import dc_to_rgb

    cameras = [object_window(view, size) for view in views]
    depths, alphas = render_depths(g, cameras, backend, device)
    solid = torch.sigmoid(g.opacity_logits) > min_opacity
    return StateEvidence(
        points=g.means[solid].cpu(),
        colours=dc_to_rgb(g.sh[solid, 0]).clamp(0, 1).cpu(),
        normals=None,
        weights=torch.sigmoid(g.opacity_logits[solid]).cpu(),
        depths=depths,
        alphas=alphas,
        cameras=cameras,
    )


def evidence_of(run: RunContext, states) -> list[StateEvidence]:
    """What discovery looks at of each of the states (``StateGaussians``), with discovery's options."""
    found, options = run.config("discovery"), {"backend": run.rasterizer, "device": run.device}
    train = [run.scene.select(state=s.state, split="train") for s in states]
    size = (found.evidence_size, found.min_opacity)
    return [gather_evidence(s.gaussians, v, *size, **options) for s, v in zip(states, train, strict=True)]
