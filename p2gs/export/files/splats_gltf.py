"""splats.glb: the Gaussians themselves, one animated node a part, by glTF's extension KHR_gaussian_splatting.

After the ratified text (github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting): scale is linear,
opacity between 0 and 1, rotation xyzw, coefficients of the spherical harmonics as 3DGS has them; a reader that does not
know it shows coloured points.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from p2gs.export.asset import Asset
from p2gs.export.files.glb import ARRAY_BUFFER, FLOAT, UBYTE, Buffer, animated_glb, linear_light
from p2gs.ops.sh import dc_to_rgb, degree_of
from p2gs.types import GaussianTensors

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # mode of a primitive


def write_splats(asset: Asset, out: Path) -> Path:
    """OUT/splats.glb. Nodes and animation are those of twin.glb."""
    buffer = Buffer()
    meshes = [
        _mesh(buffer, link.name, link.splats) for link in asset.links if link.splats is not None and len(link.splats)
    ]
    path = out / "splats.glb"
    path.write_bytes(animated_glb(asset, buffer, meshes, {"extensionsUsed": [EXTENSION]}))
    return path


def _mesh(buffer: Buffer, name: str, g: GaussianTensors) -> dict:
    means, scales, sh = (x.detach().float().numpy() for x in (g.means, g.log_scales.exp(), g.sh))
    opacity = torch.sigmoid(g.opacity_logits).float().numpy()
    turn = torch.nn.functional.normalize(g.quats.double(), dim=-1)[:, [1, 2, 3, 0]].float().numpy()
    colour = linear_light(dc_to_rgb(g.sh[:, 0]).clamp(0, 1).numpy())
    rgba = (np.c_[colour, opacity] * 255).round().astype(np.uint8)
    attributes = {
        "POSITION": buffer.add(means, "VEC3", FLOAT, ARRAY_BUFFER),
        "COLOR_0": buffer.add(rgba, "VEC4", UBYTE, ARRAY_BUFFER, normalized=True),
        f"{EXTENSION}:ROTATION": buffer.add(turn, "VEC4", FLOAT, ARRAY_BUFFER),
        f"{EXTENSION}:SCALE": buffer.add(scales, "VEC3", FLOAT, ARRAY_BUFFER),
        f"{EXTENSION}:OPACITY": buffer.add(opacity, "SCALAR", FLOAT, ARRAY_BUFFER),
    }
    for degree in range(degree_of(sh.shape[1]) + 1):
        for n in range(2 * degree + 1):
            values = np.ascontiguousarray(sh[:, degree * degree + n])
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = buffer.add(values, "VEC3", FLOAT, ARRAY_BUFFER)
    how = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    return {"name": name, "primitives": [{"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: how}}]}
