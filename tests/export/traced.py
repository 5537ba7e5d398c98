"""Bodies of boards and what cameras see of them, traced exactly."""

from __future__ import annotations

import numpy as np
import torch

from p2gs.data.generated.furniture import box
from p2gs.data.generated.raytrace import trace
from p2gs.data.generated.textures import Texture
from p2gs.surface.depth_view import DepthView, add_normals

PLAIN = Texture("noise", (0.6, 0.6, 0.6), (0.5, 0.5, 0.5), 0.2, 1)


def boards(*corners):
    return [box(a, b, PLAIN) for a, b in corners]


# a body open to +x
CRATE = boards(
    ((-0.5, -0.4, -0.3), (-0.46, 0.4, 0.3)),
    ((-0.5, -0.4, -0.3), (0.5, -0.36, 0.3)),
    ((-0.5, 0.36, -0.3), (0.5, 0.4, 0.3)),
    ((-0.5, -0.4, -0.3), (0.5, 0.4, -0.26)),
    ((-0.5, -0.4, 0.26), (0.5, 0.4, 0.3)),
)


def seen(primitives, first, camera, edge) -> DepthView:
    """What a camera sees of boards: label 1 is those from ``first`` on, 0 the others."""
    axis = (np.arange(camera.width) + 0.5 - camera.width / 2) / float(camera.K[0, 0])
    z, which = trace(primitives, camera.viewmat.double().numpy(), camera.K.double().numpy(), axis, axis)
    hit = torch.from_numpy(np.isfinite(z))
    labels = torch.where(hit, torch.from_numpy(which >= first).long(), -1)
    depth = torch.where(hit, torch.from_numpy(z), torch.zeros(z.shape))
    return add_normals(DepthView(camera, depth, labels, torch.full((*z.shape, 3), 128, dtype=torch.uint8)), edge)
