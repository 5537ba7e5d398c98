"""A rendered view against its photograph: colours over white and over black, silhouette, depth."""

from __future__ import annotations

import numpy as np
import torch

from p2gs.metrics.image import psnr, ssim
from p2gs.metrics.lpips import lpips
from p2gs.ops.planes import plane_depth
from p2gs.ops.rays import camera_rays
from p2gs.types import RenderOutput, View

NAMES = ("psnr_white", "psnr_black", "ssim_white", "ssim_black", "lpips", "psnr_masked", "alpha_error")
DEPTH_NAMES = ("depth_median", "depth_p90", "depth_bad")


@torch.no_grad()
def evaluate_view(render: RenderOutput, view: View, diagonal: float) -> dict[str, float]:
    """Scores by name; what the view has no truth for is left out.

    render: [H, W] pictures over black, on the CPU.  diagonal: of the object's box, in the view's units.  psnr in dB,
    ssim in [-1, 1], of the render composited over white and over black exactly as the photograph is; psnr_masked over
    the object's pixels alone; lpips over white, where its weights are at hand; alpha_error mean |alpha - mask|; depth_*
    of |depth - true| on the object: median and 90th percentile in the view's units, and the fraction off by more than
    1 % of the diagonal. Depth is where rays meet the Gaussians' planes, as for meshes, in a render with
    ``plane_features``; that of their middles where rays meet none, and in another render.
    """
    mask = view.alpha.float() / 255
    photo = view.image.float() / 255 * mask[..., None]
    black = render.colour.clamp(0, 1)
    white, photo_white = (render.colour + (1 - render.alpha)[..., None]).clamp(0, 1), photo + (1 - mask)[..., None]
    row = {"psnr_white": psnr(white, photo_white), "psnr_black": psnr(black, photo)}
    row |= {"ssim_white": ssim(white, photo_white), "ssim_black": ssim(black, photo)}
    perceived = lpips(white, photo_white)
    if perceived is not None:
        row["lpips"] = perceived
    inside = mask > 0.5
    if inside.any():
        row["psnr_masked"] = psnr(white[inside], photo_white[inside])
    row["alpha_error"] = float((render.alpha - mask).abs().mean())
    known = None if view.depth is None else inside & (view.depth > 0)
    if view.depth is not None and known is not None and known.any():
        off = (_depth(render, view) - view.depth)[known].abs().numpy()
        row["depth_median"], row["depth_p90"] = (float(np.quantile(off, q)) for q in (0.5, 0.9))
        row["depth_bad"] = float((off > 0.01 * diagonal).mean())
    return row


def _depth(render: RenderOutput, view: View) -> torch.Tensor:
    """What the render says of depth, [H, W]."""
    if render.features is None:
        return render.expected_depth
    met = plane_depth(render.features, camera_rays(view.camera))
    return torch.where(met > 0, met, render.expected_depth)
