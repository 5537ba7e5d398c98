"""Pictures of Gaussians: plain, part-coloured, and joints drawn over them (RGB uint8 images, numpy)."""

from __future__ import annotations

import math
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from pathlib import Path
from typing import Any, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.config.files import run_values
from p2gs.gaussians.pose import part_transform
from p2gs.ops.palette import part_colour, part_colours
from p2gs.ops.sh import dc_to_rgb, rgb_to_dc
from p2gs.render import rasterize
from p2gs.render.base import device_of
from p2gs.types import ArticulatedObject, Camera, GaussianTensors, Joint, RenderOutput

RASTERIZER: ContextVar[str] = ContextVar("rasterizer", default="auto")


@contextmanager
def drawing_with(rasterizer: str) -> Iterator[str]:
    """Inside, ``draw`` uses this rasterizer where none is named."""
    token = RASTERIZER.set(rasterizer)
    try:
        yield rasterizer
    finally:
        RASTERIZER.reset(token)


@contextmanager
def rasterizer_of(run_dir: Path | str) -> Iterator[str]:
    """Inside, ``draw`` uses the rasterizer that the run's config names, as training did; "auto" for a folder without a
    config."""
    with drawing_with(run_rasterizer(run_dir)) as name:
        yield name


def run_rasterizer(run_dir: Path | str) -> str:
    """``rasterizer`` of RUN/config.yaml. Raises UserError where that file is no readable YAML."""
    return str(run_values(run_dir).get("rasterizer", "auto"))


def draw(
    g: GaussianTensors,
    camera: Camera,
    background: float | Sequence[float] = 1.0,
    *,
    backend: str | None = None,
    **options: Any,
) -> RenderOutput:
    """One view of Gaussians that are in the camera's coordinates; background a grey value or RGB. No gradients; results
    on the CPU.

    The rasterizer, where none is named, is that of ``rasterizer_of``, if inside one; gsplat gets the tensors on the
    GPU.
    """
    backend = backend or RASTERIZER.get()
    device = device_of(backend, g.means)
    colour = torch.as_tensor(background, dtype=torch.float32, device=device).expand(3).contiguous()
    if device != g.means.device:
        g = g.to(device)
        options = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in options.items()}
    with torch.no_grad():
        out = rasterize(
            g.means, g.quats, g.log_scales.exp(), torch.sigmoid(g.opacity_logits), g.sh, camera.viewmat, camera.K,
            camera.width, camera.height, background=colour, backend=backend, **options,
        )  # fmt: skip
    values = ((f.name, getattr(out, f.name)) for f in fields(out))
    here: dict[str, Any] = {name: v.cpu() if isinstance(v, Tensor) else v for name, v in values}
    return RenderOutput(**here)


def to_image(colour: Tensor) -> np.ndarray:
    """[H, W, 3] float in 0..1 -> uint8."""
    return (colour.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def part_coloured(g: GaussianTensors, part_ids: Tensor, shading: float = 0.6) -> GaussianTensors:
    """The same Gaussians in the colours of their parts (part_ids [N]), keeping some of their own lightness so that
    shape stays readable."""
    luma = dc_to_rgb(g.sh[:, 0]).clamp(0, 1) @ g.sh.new_tensor([0.299, 0.587, 0.114])
    palette = part_colours(int(part_ids.max()) + 1 if len(part_ids) else 1).to(g.sh)
    colour = palette[part_ids] * (1 - shading + shading * luma.clamp_min(0.15).sqrt()[:, None] * 1.15)
    return GaussianTensors(g.means, g.quats, g.log_scales, g.opacity_logits, rgb_to_dc(colour.clamp(0, 1))[:, None])


def joint_strokes(obj: ArticulatedObject, part: int, t: float, extent: float) -> list[tuple[np.ndarray, bool]]:
    """World polylines that tell a joint: (points [n, 3], ends in an arrow head).

    Revolute: the axis, and the arc that the part's outer rim runs through from state 0 to 1. Prismatic: an arrow along
    the motion, off the part's leading end.
    """
    joint = obj.parts[part].joint
    assert joint is not None  # the base has no strokes
    mine = (obj.part_ids == obj.parts[part].id) & (torch.sigmoid(obj.gaussians.opacity_logits) > 0.3)
    means = obj.gaussians.means[mine].double()
    if not len(means):
        means = joint.origin.double()[None]
    center = means.mean(0)
    if joint.type == "prismatic":
        # lifted off the front so that the arrow is not buried in the drawer it moves with
        here = _apply(part_transform(obj, part, t), means)
        lead = joint.axis.double() * math.copysign(1.0, joint.motion)
        lift = float((here @ lead).max() - _apply(part_transform(obj, part, t), center) @ lead)
        tail = _apply(part_transform(obj, part, t), center) + lead * lift
        arrow = torch.stack([tail + lead * s for s in np.linspace(0, max(abs(joint.motion), 0.12 * extent), 24)])
        return [(arrow.numpy(), True)]
    axis, origin = joint.axis.double(), joint.origin.double()
    along = (means - origin) @ axis
    lo, hi = float(along.min()) - 0.06 * extent, float(along.max()) + 0.10 * extent
    line = torch.stack([origin + axis * s for s in np.linspace(lo, hi, 48)])
    # the arc at the part's outer end, above its rim, where it is not hidden in the part
    radial = means - origin - along[:, None] * axis
    reach = radial.norm(dim=1)
    rim = radial[reach >= torch.quantile(reach, 0.9)].mean(0) if len(reach) > 1 else radial[0]
    top = origin + axis * (float(along.max()) + 0.02 * extent) + rim * 0.9
    arc = torch.stack([_apply(part_transform(obj, part, float(s)), top) for s in np.linspace(0, 1, 33)])
    return [(line.numpy(), True), (arc.numpy(), True)]


def draw_joints(
    image: np.ndarray, obj: ArticulatedObject, camera: Camera, t: float, depth: Tensor, alpha: Tensor
) -> np.ndarray:
    """The image with every joint drawn over it; strokes behind the surface (depth [H, W]) are thin and pale. ``obj`` as
    the camera."""
    import cv2

    out = image.copy()
    points = obj.gaussians.means
    extent = float((points.quantile(0.98, dim=0) - points.quantile(0.02, dim=0)).norm()) if len(points) else 1.0
    thick = max(2, round(camera.width / 200))
    surface = torch.where(alpha > 0.5, depth, torch.full_like(depth, math.inf)).numpy()
    for k, part in enumerate(obj.parts):
        if part.joint is None:
            continue
        colour = tuple(int(255 * 0.72 * c) for c in part_colour(part.id))
        for stroke, arrow in joint_strokes(obj, k, t, extent):
            uv, z = _project(stroke, camera)
            hidden = _hidden(uv, z, surface, 0.02 * extent)
            # hidden pieces first, pale; then what is in front, on a white rim so that it stands out from a part of its
            # colour
            faint = _polyline(out, uv, hidden, z, colour, max(1, thick - 1))
            out = cv2.addWeighted(faint, 0.45, out, 0.55, 0)
            if arrow and z[-2:].min() > 1e-3:
                _arrow_head(out, uv[-4], uv[-1], (255, 255, 255), 6.5 * thick)
            out = _polyline(out, uv, ~hidden, z, (255, 255, 255), thick + 2)
            out = _polyline(out, uv, ~hidden, z, colour, thick)
            if arrow and z[-2:].min() > 1e-3:
                _arrow_head(out, uv[-4], uv[-1], colour, 5.0 * thick)
    return out


def _polyline(image, uv, chosen, z, colour, thick) -> np.ndarray:
    """A copy of the image with the segments drawn whose first point is chosen (sub-pixel: cv2 takes eighths)."""
    import cv2

    out = image.copy()
    for i in range(len(uv) - 1):
        if chosen[i] and min(z[i], z[i + 1]) > 1e-3:
            a, b = (tuple(int(round(c * 8)) for c in p) for p in (uv[i], uv[i + 1]))
            cv2.line(out, a, b, colour, thick, cv2.LINE_AA, 3)
    return out


def _arrow_head(image, tail, tip, colour, size) -> None:
    import cv2

    d = tip - tail
    norm = float(np.linalg.norm(d))
    if norm < 1e-6 or not np.isfinite(tip).all():
        return
    d, n = d / norm, np.array([-d[1], d[0]]) / norm
    corners = np.stack(
        [tip + 0.5 * size * d, tip - 0.5 * size * d + 0.45 * size * n, tip - 0.5 * size * d - 0.45 * size * n]
    )
    cv2.fillConvexPoly(image, np.round(corners * 8).astype(np.int32), colour, cv2.LINE_AA, 3)


def _project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, 2] as cv2 counts them (centre of the first pixel at 0) and depth [n]."""
    V, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    p = points @ V[:3, :3].T + V[:3, 3]
    z = p[:, 2]
    q = p @ K.T
    return np.clip(q[:, :2] / np.maximum(z, 1e-6)[:, None] - 0.5, -1e4, 1e4), z


def _hidden(uv, z, surface, margin) -> np.ndarray:
    """[n] bool: the point lies behind the surface; a majority over neighbours, so that a stroke along a surface does
    not flicker."""
    h, w = surface.shape
    u, v = (np.clip(np.round(uv[:, i]).astype(int), 0, n - 1) for i, n in ((0, w), (1, h)))
    behind = (z > surface[v, u] + margin).astype(float)
    return np.convolve(np.pad(behind, 3, mode="edge"), np.full(7, 1 / 7), mode="valid") > 0.5


def _apply(T: Tensor, x: Tensor) -> Tensor:
    return x @ T[:3, :3].T + T[:3, 3]


def joint_text(joint: Joint) -> str:
    """``revolute 60.0 deg`` or ``prismatic 0.367``."""
    return (
        f"{joint.type} {abs(joint.motion):.1f} deg"
        if joint.type == "revolute"
        else f"{joint.type} {abs(joint.motion):.3f}"
    )
