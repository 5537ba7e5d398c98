"""A coarse splat of the whole scene in one state, and which of its Gaussians are the object.

Gaussians start as a cloud around the point that the cameras look at, as a grid on the floor and on walls behind, and at
the points of the model. After a thousand steps what the cloud shows off floor and walls has an outline in every
photograph, and the body that the cameras look at in the hull of those is the object (``hull``). It needs no network
that would have to know what a cupboard is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from p2gs.data.capture.frame import fit_plane
from p2gs.ops.knn import knn
from p2gs.ops.sh import rgb_to_dc
from p2gs.render import rasterize_stored
from p2gs.types import Camera

STEPS = 1000
CLOUD = 14_000  # Gaussians about the object: one per 5 cm of a cupboard
GRID = 3_000  # per plane
REGION = 0.5  # the cloud's radius over the cameras' distance: what a 50 degree lens shows
OFF_PLANE = 0.012  # over the cameras' distance: nearer to floor or wall than this is floor or wall
SPARSE = 0.01  # weight of the mean opacity: empty space is the cheaper explanation
MIN_WALL = 60  # points


@dataclass(frozen=True)
class Picture:
    """A photograph at the coarse size. image: [H, W, 3] float32 0..1."""

    camera: Camera
    image: Tensor


@dataclass(frozen=True)
class Region:
    """Where to look for the object; z up, floor 0.

    centre: [3].  distance: of the cameras.  planes: [n, 4], normal towards the cameras and offset.  box: [2, 3] lowest
    and highest corner of what the object is within; None: a ball about the centre.  share: of the photographs' long
    edge, how much the pictures show of it: lengths that are pixels go with it.
    """

    centre: np.ndarray
    distance: float
    planes: np.ndarray
    box: np.ndarray | None = None
    share: float = 1.0

    @property
    def fine(self) -> float:
        """What a pixel of the pictures is worth of lengths over the cameras' distance in whole photographs."""
        return self.distance * self.share

    def free(self, points: np.ndarray) -> np.ndarray:
        """[N] bool: on the cameras' side of every plane and off it."""
        return (points @ self.planes[:, :3].T - self.planes[:, 3] > OFF_PLANE * self.fine).all(1)

    def holds(self, points: np.ndarray, margin: float = 1.0) -> np.ndarray:
        """[N] bool: within the box, else within ``margin`` times the ball."""
        if self.box is not None:
            return ((points >= self.box[0]) & (points <= self.box[1])).all(1)
        return np.linalg.norm(points - self.centre, axis=1) < margin * REGION * self.distance


def region_of(xyz: np.ndarray, cameras: np.ndarray, centre: np.ndarray, distance: float, seed: int = 0) -> Region:
    """The floor (z = 0) and the upright planes among points xyz [N, 3] that all cameras [M, 3] are in front of."""
    rng = np.random.default_rng(seed)
    planes, left = [[0.0, 0.0, 1.0, 0.0]], xyz[xyz[:, 2] > 0.03 * distance]
    for _ in range(2):
        best, most = None, MIN_WALL
        for _ in range(400 if len(left) > MIN_WALL else 0):
            a, b, c = left[rng.choice(len(left), 3, replace=False)]
            n = np.cross(b - a, c - a)
            if np.linalg.norm(n) < 1e-12 or abs(n[2]) > 0.05 * np.linalg.norm(n):
                continue
            n /= np.linalg.norm(n)
            n *= np.sign((np.median(cameras, axis=0) - a) @ n)
            behind = ((cameras - a) @ n < 0).mean() > 0.02 or (centre - a) @ n < 0.02 * distance
            near = np.abs((left - a) @ n) < 0.006 * distance
            # a wall is what nothing lies behind
            if not behind and near.sum() > most and ((left - a) @ n < -0.03 * distance).mean() < 0.05:
                best, most = near, near.sum()
        if best is None:
            break
        n, offset = fit_plane(left[best])
        sign = np.sign(np.median(cameras, axis=0) @ n - offset)
        planes.append([*(n * sign), offset * sign])
        left = left[~best]
    return Region(centre, distance, np.array(planes))


def _cloud(region: Region, generator: torch.Generator) -> np.ndarray:
    reach = REGION * region.distance
    low, high = (region.centre - reach, region.centre + reach) if region.box is None else region.box
    points = low + torch.rand(6 * CLOUD, 3, generator=generator).numpy() * (high - low)
    return points[region.holds(points) & region.free(points)][:CLOUD]


def _plane_grid(plane: np.ndarray, region: Region) -> np.ndarray:
    n = plane[:3]
    foot = region.centre - (region.centre @ n - plane[3]) * n
    u = np.linalg.svd(n[None])[2][1:]
    side = int(np.sqrt(GRID))
    s = np.linspace(-1.3, 1.3, side) * region.distance
    return foot + np.stack(np.meshgrid(s, s), -1).reshape(-1, 2) @ u


@dataclass
class Splat:
    """means [N, 3] and so on as stored; cloud: how many at the front are the cloud's."""

    params: dict[str, Tensor]
    cloud: int

    def render(self, camera: Camera, background: Tensor | None = None, features: Tensor | None = None):
        p = self.params
        return rasterize_stored(
            p["means"],
            p["quats"],
            p["log_scales"],
            p["opacity_logits"],
            p["sh"],
            None,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            background=background,
            features=features,
            median_depth=False,
        )


def initial(region: Region, xyz: np.ndarray, rgb: np.ndarray, seed: int = 0, before: Splat | None = None) -> Splat:
    """The Gaussians to start from. xyz, rgb: the model's points, [M, 3].  before: an earlier fit, of whose cloud what
    the region does not hold stays where it is."""
    cloud = _cloud(region, torch.Generator().manual_seed(seed))
    grids = [g[region.free(g + 0.02 * region.distance * p[:3]) | (p[2] > 0.9)]
             for p in region.planes for g in [_plane_grid(p, region)]]  # fmt: skip
    far = np.linalg.norm(xyz - region.centre, axis=1) > REGION * region.distance
    points = torch.tensor(np.concatenate([cloud, *grids, xyz[far]])).float()
    colours = torch.full((len(points), 3), 0.5)
    if far.any():
        colours[len(points) - int(far.sum()) :] = torch.tensor(rgb[far] / 255).float()
    distance, _ = knn(points, None, 3, True)
    scale = (0.6 * distance.mean(1)).clamp(1e-4 * region.distance, 0.05 * region.distance)
    opacity = torch.full((len(points),), 2.0)
    opacity[: len(cloud)] = -2.2  # 0.1
    quats = torch.zeros(len(points), 4)
    quats[:, 0] = 1
    sh = rgb_to_dc(colours)[:, None].contiguous()
    params = {
        "means": points,
        "quats": quats,
        "log_scales": scale.log()[:, None].repeat(1, 3),
        "opacity_logits": opacity,
        "sh": sh,
    }
    if before is not None:
        old = {k: v.detach()[: before.cloud] for k, v in before.params.items()}
        beside = torch.from_numpy(~region.holds(old["means"].double().numpy(), margin=1.1))
        params = {k: torch.cat([v, old[k][beside]]) for k, v in params.items()}
    return Splat({k: v.clone().requires_grad_() for k, v in params.items()}, len(cloud))


def fit(splat: Splat, pictures: list[Picture], distance: float, steps: int = STEPS, seed: int = 0) -> Tensor:
    """Fit in place; returns the colour behind everything [3]."""
    sky = torch.full((3,), 0.8, requires_grad=True)
    rates = {"means": 2e-3 * distance, "quats": 2e-3, "log_scales": 1e-2, "opacity_logits": 8e-2, "sh": 2e-2}
    optimizer = torch.optim.Adam(
        [{"params": [splat.params[k]], "lr": r} for k, r in rates.items()] + [{"params": [sky], "lr": 1e-2}], eps=1e-12
    )
    order = np.random.default_rng(seed)
    for step in range(steps):
        for group in optimizer.param_groups[:1]:
            group["lr"] = rates["means"] * 0.05 ** (step / steps)
        picture = pictures[int(order.integers(len(pictures)))]
        out = splat.render(picture.camera, sky)
        opacity = torch.sigmoid(splat.params["opacity_logits"][: splat.cloud])
        loss = (out.colour - picture.image).abs().mean() + SPARSE * opacity.mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        splat.params["means"].grad[splat.cloud :] = 0  # floor, walls and measured points stay where they are
        optimizer.step()
    return sky.detach()


def object_rows(splat: Splat, region: Region) -> Tensor:
    """[N] bool: the cloud's Gaussians off floor and walls: the object, what stands about, fog before plain walls."""
    means = splat.params["means"].detach().double().numpy()
    return torch.from_numpy(
        (np.arange(len(means)) < splat.cloud) & region.holds(means, margin=1.1) & region.free(means)
    )
