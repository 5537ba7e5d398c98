"""Where a reconstruction starts: depth points, points on which photographs agree, random ones in the silhouettes."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import torch
from torch import Tensor

from p2gs.models.swept import swept_points
from p2gs.types import GaussianTensors, TwoStateScene, View

HULL_MARGIN = 0.02  # of the image's long edge: silhouettes grow by it
HULL_SHARE = 0.9  # share of the views that must see a point inside


class Start(NamedTuple):
    """Points [N, 3] with colours [N, 3] in 0..1; known [N] bool: they lie on surfaces, the others anywhere."""

    points: Tensor
    colours: Tensor
    known: Tensor


def initial_points(
    scene: TwoStateScene, state: int, counts: tuple[int, int], init: str, generator: torch.Generator
) -> Start:
    """What a state starts from. counts: how many points where there is no depth, how many depth points.

    init "auto": depth points where every training view has depth, else random ones. "agreed": depth points there, too,
    else points on which the photographs agree (``swept_points``), and random ones where these are too few. "random":
    random ones alone.
    """
    views, count = scene.select(state=state, split="train"), counts[0]
    if init != "random" and scene.has_depth:
        points, colours = depth_points(views, counts[1], generator)
        if len(points) > 100:
            return Start(points, colours, torch.ones(len(points), dtype=torch.bool))
    assert scene.box is not None  # every scene that is trained on has one
    points, colours = torch.zeros(2, 0, 3)
    if init == "agreed":
        points, colours = swept_points(views, scene.box)
        chosen = torch.randperm(len(points), generator=generator)[:count]
        points, colours = points[chosen], colours[chosen]
    rest = random_points(views, scene.box, count - len(points), generator)
    known = torch.arange(count) < len(points)
    return Start(torch.cat([points, rest]), torch.cat([colours, torch.full_like(rest, 0.5)]), known)


def random_points(views: Sequence[View], box: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Points [count, 3], uniform in the space that the (slightly grown) silhouettes enclose.

    Not on that hull's surface, which would seal concavities; not in the whole box either, since what no cropped view
    sees is never carved away.
    """
    low, high = box
    found, tries = [low.new_zeros(0, 3)], 0
    while sum(map(len, found)) < count and tries < 50:
        points = low + torch.rand(4 * count, 3, generator=generator) * (high - low)
        found.append(points[inside_masks(points, views)])
        tries += 1
    points = torch.cat(found)[:count]
    more = count - len(points)  # masks that enclose next to nothing
    return torch.cat([points, low + torch.rand(more, 3, generator=generator) * (high - low)])


def inside_masks(points: Tensor, views: Sequence[View], size: int = 100) -> Tensor:
    """Which points [N, 3] lie inside the grown masks of at least ``HULL_SHARE`` of the views that have them in the
    image, [N] bool."""
    seen, inside = torch.zeros(len(points)), torch.zeros(len(points))
    for view in views:
        factor = min(size / max(view.camera.width, view.camera.height), 1.0)
        width, height = max(round(view.camera.width * factor), 1), max(round(view.camera.height * factor), 1)
        camera = view.camera.scaled(width, height)
        mask = torch.nn.functional.adaptive_max_pool2d((view.alpha > 127).float()[None], (height, width))
        grow = max(round(HULL_MARGIN * max(width, height)), 1)
        mask = torch.nn.functional.max_pool2d(mask, 2 * grow + 1, 1, grow)[0]
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixel = local @ camera.K.T
        x, y = (pixel[:, 0] / pixel[:, 2]).floor().long(), (pixel[:, 1] / pixel[:, 2]).floor().long()
        valid = (local[:, 2] > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        seen += valid
        inside += valid & (mask[y.clamp(0, height - 1), x.clamp(0, width - 1)] > 0)
    return inside >= HULL_SHARE * seen.clamp_min(1)


def depth_points(views, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """``count`` pixels with known depth, back-projected: points [N, 3] and colours [N, 3]."""
    points, colours = [], []
    per_view = -(-count // max(len(views), 1))
    for view in views:
        rows, cols = ((view.depth > 0) & (view.alpha > 250)).nonzero(as_tuple=True)
        if rows.numel() == 0:
            continue
        pick = torch.randint(rows.numel(), (per_view,), generator=generator)
        rows, cols = rows[pick], cols[pick]
        pixels = torch.stack([cols + 0.5, rows + 0.5, torch.ones(per_view)], dim=1)
        rays = pixels @ torch.linalg.inv(view.camera.K).T
        local = rays * view.depth[rows, cols, None]
        R, t = view.camera.viewmat[:3, :3], view.camera.viewmat[:3, 3]
        points.append((local - t) @ R)
        colours.append(view.image[rows, cols].float() / 255)
    if not points:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    return torch.cat(points)[:count], torch.cat(colours)[:count]


def isotropic_gaussians(points: Tensor, colours: Tensor, opacity: Tensor, sh_degree: int) -> GaussianTensors:
    """Round Gaussians of opacities [N] at points [N, 3], as large as the mean distance to their three nearest
    neighbours."""
    from p2gs.ops.knn import knn
    from p2gs.ops.sh import rgb_to_dc

    n = len(points)
    distance, _ = knn(points, None, min(3, n - 1), True)
    log_scales = distance.mean(dim=1).clamp(1e-4, 0.2).log()[:, None].expand(n, 3).contiguous()
    sh = torch.zeros(n, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = rgb_to_dc(colours)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return GaussianTensors(points.contiguous(), quats, log_scales, torch.logit(opacity), sh)
