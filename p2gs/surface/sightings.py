"""What cameras see of a twin's parts: depth, labels and how far to trust them; surfaces are made of that."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Optional, Sequence

import torch
from torch import Tensor

from p2gs.gaussians.paint import draw
from p2gs.gaussians.pose import part_transform, pose
from p2gs.gaussians.views import bounds
from p2gs.native import at_once
from p2gs.ops.blend import likeliest
from p2gs.ops.mesh import Mesh
from p2gs.ops.pixels import greatest_around
from p2gs.render.base import MAX_FEATURES
from p2gs.surface.bridges import without_crumbs
from p2gs.surface.depth_view import DepthView, add_normals
from p2gs.surface.surface_depth import surface_depth
from p2gs.surface.trays import Tray, find_tray
from p2gs.surface.tsdf import fuse
from p2gs.surface.unseen import eyes_of
from p2gs.types import ArticulatedObject, Camera, GaussianTensors

RESOLUTION = 160  # voxels along the longest side of the object's box
FIRM = 0.8  # opacity a ray must meet to count as a sighting of surface
FOG = 2.5  # times the usual spread of depth along a ray: what is more is fog
NEAR = 0.02  # of the object's longest side: see look and fog_limit
EDGE, TRUNCATION, BEHIND = 2.0, 4.0, 2.0  # voxels: see tsdf.add_normals and tsdf.fuse
FINEST = 2.0  # pixels a voxel, at the object's middle: a field of voxels holds no finer detail (two samples each)


def start_motion(obj: ArticulatedObject, part: int, t: float) -> Tensor:
    """Start state -> state t for the part, [4, 4] float64."""
    return part_transform(obj, part, t) @ torch.linalg.inv(part_transform(obj, part, 0.0))


@dataclass
class PartView:
    """What a camera sees of a twin. depth [H, W] along z, 0 where little is hit.  label [H, W] int16: the part that
    covers most of a pixel, -1 where little is hit.  colour [H, W, 3] uint8.  alpha [H, W].  spread [H, W]: see
    ``surface_depth``."""

    depth: Tensor
    label: Tensor
    colour: Tensor
    alpha: Tensor
    spread: Tensor


def look(g: GaussianTensors, part_index: Tensor, parts: int, camera: Camera, near: float) -> PartView:
    """Draw the parts. part_index [N] in 0..parts-1.

    near: where what a ray meets lies within this, as a standard deviation, it is one surface (``surface_depth``). Where
    it is not, the ray meets two, the mean of which lies on neither: the depth is then that at which transmittance
    passes one half.
    """
    onehot = torch.nn.functional.one_hot(part_index, parts).float()
    out = draw(g, camera, 0.0, features=onehot[:, :MAX_FEATURES])
    more = onehot[:, MAX_FEATURES:].split(MAX_FEATURES, 1) if parts > MAX_FEATURES else ()
    shares = [out.painted] + [draw(g, camera, 0.0, features=c).painted for c in more]
    median = out.expected_depth if out.median_depth is None else out.median_depth  # gsplat gives none
    depth, spread = surface_depth(g, camera)
    solid = (out.alpha > 0.5) & (median > 0)
    alpha = out.alpha.clamp_min(1e-3)
    return PartView(
        depth=torch.where(solid, torch.where((depth > 0) & (spread < near), depth, median), torch.zeros_like(depth)),
        label=torch.where(solid, likeliest(torch.cat(shares, -1).flatten(0, 1)).reshape(solid.shape), -1).short(),
        colour=(out.colour / alpha[..., None]).clamp(0, 1).mul(255).round().byte(),
        alpha=out.alpha,
        spread=spread,
    )


def fog_limit(looks: Sequence[PartView], size: float) -> float:
    """Spread beyond which a ray has met fog: ``FOG`` times what is usual in this twin, as a coarse one is loose
    everywhere; at least a fiftieth of its longest side ``size``."""
    solid = [v.spread[v.alpha > FIRM] for v in looks]
    spread = torch.cat(solid) if solid else torch.zeros(0)
    return max(FOG * float(spread.median()) if len(spread) else 0.0, NEAR * size)


def trust(seen: PartView, limit: float) -> Tensor:
    """[H, W] in 0..1, how much a pixel's depth says of a surface. limit: see ``fog_limit``.

    Fog covers a pixel poorly or is spread along its ray: no surface may come of it (it still hides nothing that others
    see before it).
    """
    firm = (seen.alpha > FIRM) & (seen.spread < limit)
    return firm / (1 + (2 * seen.spread / limit) ** 2)


def beside_others(label: Tensor) -> Tensor:
    """Pixels [H, W] bool beside those of another label: what they saw may be a mean of both."""
    x = label.float()
    return greatest_around(x) != -greatest_around(-x)


@dataclass
class Sightings:
    """What cameras see of a twin's parts. voxel: of what is made of it.  views: labelled by place in ``obj.parts``.
    motions: of each part, start state -> start and end.  poses: of each part, one a view."""

    voxel: float
    views: list[DepthView]
    motions: list[list[Tensor]]
    poses: list[list[Tensor]]

    def surface(self, k: int) -> Mesh:
        """What was seen of the k-th part, in the start state, without crumbs."""
        mesh = fuse(self.views, self.poses[k], k, self.voxel, trunc=TRUNCATION * self.voxel, behind=BEHIND * self.voxel)
        return without_crumbs(mesh, self.views, self.poses[k], self.voxel)

    def surfaces(self) -> list[Mesh]:
        """``surface`` of every part."""
        return at_once(self.surface, range(len(self.motions)))

    def tray(self, k: int, mesh: Mesh, body: Mesh) -> Optional[Tray]:
        """``find_tray`` for the k-th part, which slides, of which ``mesh`` was seen."""
        return find_tray(mesh, body, self.motions[k][1].numpy(), eyes_of(self.views, self.poses[k]), self.voxel)


def no_finer(cameras: Sequence[tuple[int, Camera]], middle: Tensor, voxel: float) -> list[tuple[int, Camera]]:
    """The cameras with smaller images, all by one factor, where most draw more than ``FINEST`` pixels a voxel at
    ``middle`` [3]: photographs of 800 pixels and more would take gigabytes."""
    spans = [float(c.K[:2, :2].diagonal().min() * voxel / (c.position - middle).norm()) for _, c in cameras]
    factor = FINEST / max(statistics.median(spans or [0.0]), FINEST)
    return [(s, c.scaled(max(round(factor * c.width), 1), max(round(factor * c.height), 1))) for s, c in cameras]


def sight(
    obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], resolution: int = RESOLUTION, fine: bool = False
) -> Sightings:
    """Look at the parts. obj and cameras ((state, camera) pairs) in one coordinate system. resolution: as in
    ``part_meshes``. fine: in all pixels of the cameras, even where a voxel has many."""
    lo, hi = bounds(obj, (0.0,))
    size = float((hi - lo).max())
    voxel = size / resolution
    index = torch.zeros(max(p.id for p in obj.parts) + 1, dtype=torch.int64)
    for k, part in enumerate(obj.parts):
        index[part.id] = k
    posed = [pose(obj, 0.0), pose(obj, 1.0)]
    if not fine:
        cameras = no_finer(cameras, (lo + hi) / 2, voxel)
    looks = [
        look(posed[state], index[obj.part_ids], len(obj.parts), camera, near=NEAR * size) for state, camera in cameras
    ]
    limit = fog_limit(looks, size)
    views: list[DepthView] = []
    looks.reverse()
    for _, camera in cameras:
        seen = looks.pop()  # not kept beside its view: together they are much of what a run has in memory
        view = add_normals(DepthView(camera, seen.depth, seen.label, seen.colour), edge=EDGE * voxel)
        assert view.cosine is not None  # of add_normals
        view.cosine = view.cosine * trust(seen, limit) * ~beside_others(seen.label)
        views.append(view)
    motions = [[start_motion(obj, k, 0.0), start_motion(obj, k, 1.0)] for k in range(len(obj.parts))]
    return Sightings(voxel, views, motions, [[motion[state] for state, _ in cameras] for motion in motions])
