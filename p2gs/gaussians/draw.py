"""Gaussians drawn by a camera, as every stage draws them."""

from __future__ import annotations

from torch import Tensor

from p2gs.gaussians.splats import SplitGaussians
from p2gs.ops.planes import plane_features
from p2gs.render import rasterize_stored
from p2gs.types import Camera, GaussianTensors, RenderOutput


def render_gaussians(
    g: GaussianTensors, camera: Camera, background: Tensor | None = None, *, planes: bool = False, **options
) -> RenderOutput:
    """``render.rasterize_stored`` of Gaussians; depth moments are taken about the distance of the origin (the box's
    centre).

    planes: its features are those of ``ops.planes.plane_features``.
    """
    if planes:
        options["features"] = plane_features(g.means, g.quats, g.log_scales, camera)
    sh, sh_rest = (g.sh0, g.sh_rest) if isinstance(g, SplitGaussians) else (g.sh, None)
    return rasterize_stored(
        g.means,
        g.quats,
        g.log_scales,
        g.opacity_logits,
        sh,
        sh_rest,
        camera.viewmat,
        camera.K,
        camera.width,
        camera.height,
        background=background,
        depth_ref=float(camera.viewmat[2, 3].detach()),
        **options,
    )
