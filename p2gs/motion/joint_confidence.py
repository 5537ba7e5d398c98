"""How far a joint can be trusted, measured on what both states show. No ground truth, no learning.

Each state's Gaussians are carried to the other state by the joint. There they should lie on surfaces, look like the
photographs, look worse after any small change of the joint, and the two directions should tell the same motion.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import StateGaussians
from p2gs.motion.motion_steps import apply_step
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops import se3
from p2gs.types import Camera
from p2gs.visibility.depth_stack import DepthStack, classify
from p2gs.visibility.evidence import render_depths

# displacement of a part by a change of its joint, internal units (the object's diagonal is 2): one per cent
STEP = 0.02
BRIGHT = 0.15  # |render - photo| that one sees
ON_SURFACE = 0.02  # tolerance along the ray of the free-space test, internal units
RISE = (0.003, 0.1)  # less tells nothing, more tells no more: how far the residual rises less how far it falls
# internal units: directions that differ by less agree; what counts where they were not told apart
APART, UNTOLD = (0.001, 0.01)
# How each feature counts, and the constant: fitted by bench/confidence.py to right and wrong joints of scenes of the
# zoo's tuning set
WEIGHTS = (3.8, 0.85, 0.31, 3.05)


@dataclass(frozen=True)
class JointEvidence:
    """What the images say of one joint.

    coverage: share of the part's Gaussians that land on a surface of the other state (the better of the two directions:
    a shut drawer hides its inside).  contradicted: share that lands where the other state's cameras see through (the
    worse direction).
    residual: mean |render - photo| over the part's pixels, as a multiple of the static part's there (nan where nothing
    static shows).
    rise: relative growth of that residual when the part is displaced by ``STEP``, mean of both signs, in the direction
    that matters least: the curvature of the photometric cost.  fall: how much it falls in the best of those directions:
    0 at a minimum.
    disagreement: mean distance between the points where the start -> end and the end -> start refinement put the part
    (internal units; None where there was no such refinement, 0 where neither pulled at all: nothing was told).
    views: how many photographs showed enough of the part to be measured.  saved: share of the image loss that the part
    saves in its own pixels (``own_shares``; None: not asked).
    """

    coverage: float
    contradicted: float
    residual: float
    rise: float
    fall: float
    disagreement: float | None
    views: int
    saved: float | None = None

    @property
    def confidence(self) -> float:
        """Probability that the joint is right (axis and turn within a degree, slide within 0.01, position x10 within
        0.15): a logistic function of ``features``. 0 where no view shows the part."""
        if self.views == 0:
            return 0.0
        return 1 / (1 + math.exp(-sum(w * x for w, x in zip(WEIGHTS, [*features(self), 1.0], strict=True))))

    def as_dict(self) -> dict:
        """For JSON."""
        return {**asdict(self), "confidence": self.confidence}


def features(e: JointEvidence) -> list[float]:
    """What speaks for a joint, each the more the better: that nothing contradicts it, that the residual rises where it
    is displaced and falls nowhere, that both directions agree. The last two as logarithms: they span decades. Coverage
    and residual got no weight."""
    least, most = RISE
    apart = max(e.disagreement, APART) if e.disagreement else UNTOLD
    return [-e.contradicted, math.log(min(max(e.rise - e.fall, least), most)), -math.log(apart)]


def landing(
    state: StateGaussians, labels: Tensor, transforms: Tensor, stack: DepthStack, min_opacity: float = 0.5
) -> list[tuple[float, float]]:
    """Per movable part (share on a surface, share seen through) of its solid Gaussians carried by ``transforms`` [K-1,
    4, 4] into the state whose rendered depth is ``stack``; the rest lands behind something. (0, 0) for an empty
    part."""
    solid = torch.sigmoid(state.gaussians.opacity_logits) > min_opacity
    out = []
    for k in range(len(transforms)):
        points = state.gaussians.means[solid & (labels == k + 1)]
        if not len(points):
            out.append((0.0, 0.0))
            continue
        free, on, _ = stack.counts(se3.apply(transforms[k].to(points), points), ON_SURFACE)
        through, there = classify(free, on)
        out.append((float(there.float().mean()), float(through.float().mean())))
    return out


def measuring_level(views: TrainingViews, size: int = 200) -> int:
    """The largest image size of ``views`` that is no larger than ``size``, else the smallest."""
    return max((n for n in views.levels if n <= size), default=min(views.levels))


def common_level(views: dict[int, TrainingViews]) -> int:
    """The smaller ``measuring_level`` of both states' photographs, by state: both measured alike."""
    return min(measuring_level(views[s]) for s in (0, 1))


def state_depth(
    state: StateGaussians, views: TrainingViews, level: int, count: int = 24, backend: str = "auto", device="cpu"
) -> DepthStack:
    """Rendered depth of a state in ``count`` of its views, a quarter wider on each side than the photographs' crops."""
    cameras = []
    for i in views.spread(count):
        camera = views.camera(i, views.levels.index(level))
        x, y = camera.width // 4, camera.height // 4
        cameras.append(camera.cropped(-x, -y, camera.width + 2 * x, camera.height + 2 * y))
    return DepthStack(*render_depths(state.gaussians, cameras, backend, device), cameras)


def nudges(kind: str, T: Tensor, centre: Tensor, radius: float, size: float = STEP) -> list[tuple[Tensor, Tensor]]:
    """Small changes of a joint, each as the pair (forth, back) of changed motions [4, 4]: every degree of freedom of
    its type.

    Revolute: about the axis, two tilts, two shifts across the axis; prismatic: along three directions; displacing
    points at ``radius`` from ``centre`` (the moved part's middle) by ``size``.
    """
    turn = kind != "prismatic"
    axis = se3.screw_parameters(T).axis if turn else torch.nn.functional.normalize(T[:3, 3], dim=0)
    other = torch.linalg.cross(axis, torch.eye(3, dtype=T.dtype)[int(axis.abs().argmin())])
    u = other / other.norm()
    frame = [axis, u, torch.linalg.cross(axis, u)]
    zero = torch.zeros(3, dtype=T.dtype)
    steps = [torch.cat([zero, e]) for e in (frame[1:] if turn else frame)]
    if turn:
        steps += [torch.cat([e, zero]) for e in frame]
    pairs = []
    for step in steps:
        pair = [apply_step(T, centre, radius, sign * size * step) for sign in (1.0, -1.0)]
        pairs.append(tuple(se3.project_revolute(p) for p in pair) if turn else tuple(pair))
    return pairs


class CrossViews:
    """One state's Gaussians carried into the other state's photographs: residuals of a part in its own pixels.

    labels [N]: part of each Gaussian, 0 static.  transforms [K-1, 4, 4] carry this state to the photographs'.
    Photographs: ``looks`` of them at size ``level``, spread over ``views``; each part is measured on the ``count`` that
    show most of it.

    static_error: mean |render - photo| where the static part shows, nan where it shows nowhere.  bright_static: share
    of the object's pixels where the static part shows and is off by more than ``BRIGHT``.
    """

    def __init__(
        self,
        state: StateGaussians,
        labels: Tensor,
        transforms: Tensor,
        views: TrainingViews,
        *,
        level: int,
        looks: int = 16,
        count: int = 5,
        min_opacity: float = 0.05,
        backend: str = "auto",
        device="cpu",
    ):
        solid = torch.sigmoid(state.gaussians.opacity_logits) > min_opacity
        self.body = MovedGaussians(state.gaussians, torch.where(solid, labels, -1), device)
        self.transforms, self.backend = transforms.double(), backend
        self.background = torch.full((3,), 0.5)
        picked = views.spread(looks)
        self.shots = [views.get(i, views.levels.index(level), self.background) for i in picked]
        self.shares, self.errors = [], []
        for shot in self.shots:
            colour, share = self.draw(self.transforms, shot.camera, features=True)
            self.shares.append(share)
            self.errors.append((colour - shot.image).abs().mean(-1))
        parts = len(transforms) + 1
        areas = (
            torch.stack([(s[..., 1:] > 0.3).float().mean((0, 1)) for s in self.shares])
            if parts > 1
            else torch.zeros(len(picked), 0)
        )
        order = areas.argsort(dim=0, descending=True, stable=True)
        self.chosen = [[int(i) for i in order[:count, k] if areas[int(i), k] > 1e-3] for k in range(parts - 1)]
        near = [torch.nn.functional.max_pool2d(s.permute(2, 0, 1)[None], 7, 1, 3)[0] > 0.3 for s in self.shares]
        self.windows = [[self.window(i, near[i][k + 1]) for i in rows] for k, rows in enumerate(self.chosen)]
        still = [(s[..., 0] > 0.5) & ~n[1:].any(0) for s, n in zip(self.shares, near, strict=True)]
        total = sum(int(m.sum()) for m in still)
        wrong = sum(float(e[m].sum()) for e, m in zip(self.errors, still, strict=True))
        self.static_error = wrong / total if total else float("nan")
        bright = sum(int((e[m] > BRIGHT).sum()) for e, m in zip(self.errors, still, strict=True))
        self.bright_static = bright / max(sum(int((shot.alpha > 0.5).sum()) for shot in self.shots), 1)

    def draw(self, transforms: Tensor, camera: Camera, features: bool = False) -> tuple[Tensor, Tensor | None]:
        """Colour [H, W, 3] and, if asked for, how much of each pixel each part covers [H, W, K]."""
        means, quats, sh = self.body.moved(transforms)
        parts = len(self.transforms) + 1
        if not features:
            return self.body.render(means, quats, sh, camera, self.background, self.backend).colour.cpu(), None
        onehot = torch.nn.functional.one_hot(self.body.labels, parts).float()
        first = self.body.render(means, quats, sh, camera, self.background, self.backend, features=onehot[:, :16])
        shares = [first.painted]
        for columns in onehot[:, 16:].split(16, 1) if parts > 16 else ():
            shares.append(
                self.body.render(means, quats, sh, camera, self.background, self.backend, features=columns).painted
            )
        return first.colour.cpu(), torch.cat(shares, -1).cpu()

    def window(self, shot: int, region: Tensor) -> tuple[Camera, Tensor, Tensor]:
        """The part of a photograph around ``region`` [H, W]: its camera, its pixels [h, w, 3] and the region in it [h,
        w]."""
        rows, cols = region.any(1).nonzero().squeeze(1), region.any(0).nonzero().squeeze(1)
        y, x, bottom, right = int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1
        camera = self.shots[shot].camera.cropped(x, y, right - x, bottom - y)
        return camera, self.shots[shot].image[y:bottom, x:right], region[y:bottom, x:right]

    def part_error(self, part: int, transform: Tensor) -> float:
        """Mean |render - photo| over the pixels that movable part ``part`` (0-based) covers, when its motion is
        ``transform`` [4, 4]."""
        motions = self.transforms.clone()
        motions[part] = transform
        total = pixels = 0.0
        for camera, photo, region in self.windows[part]:
            error = (self.draw(motions, camera)[0] - photo).abs().mean(-1)
            total, pixels = total + float(error[region].sum()), pixels + int(region.sum())
        return total / pixels if pixels else float("nan")


@torch.no_grad()
def measure_joints(
    states: list[StateGaussians],
    labels: list[Tensor],
    transforms: Tensor,
    types: list[str],
    views: dict[int, TrainingViews],
    stacks: list[DepthStack],
    *,
    level: int,
    both: list[Tensor] | None = None,
    looks: int = 16,
    count: int = 5,
    backend: str = "auto",
    device="cpu",
) -> list[JointEvidence]:
    """The evidence for every joint.

    labels: part ids of each state's Gaussians.  transforms [K-1, 4, 4] start -> end.  views: photographs by state.
    stacks: rendered depth of both states.  level: image size.  both: the motions that the start -> end and the end ->
    start refinement found (both start -> end), where there were two.  looks, count: as in ``CrossViews``.
    """
    ways = [transforms.double(), se3.inverse(transforms.double())]
    options = {"level": level, "looks": looks, "count": count, "backend": backend, "device": device}
    crossed = [CrossViews(states[s], labels[s], ways[s], views[1 - s], **options) for s in (0, 1)]
    landed = [landing(states[s], labels[s], ways[s], stacks[1 - s]) for s in (0, 1)]
    out = []
    for k, kind in enumerate(types):
        here = [c for c in crossed if c.windows[k]]
        base = sum(c.part_error(k, c.transforms[k]) for c in here) / max(len(here), 1)
        told = [c.static_error for c in here if not math.isnan(c.static_error)]
        rises, falls = [], [0.0]
        if here:
            changed = [changes(c, k, kind) for c in here]
            for pairs in zip(*changed, strict=True):  # one degree of freedom, all directions
                forth, back = (sum(p[i] for p in pairs) / len(pairs) for i in (0, 1))
                rises.append((forth + back) / (2 * base) - 1)
                falls.append(1 - min(forth, back) / base)
        out.append(
            JointEvidence(
                coverage=max(way[k][0] for way in landed),
                contradicted=max(way[k][1] for way in landed),
                residual=base / max(sum(told) / len(told), 1e-3) if told else float("nan"),
                rise=min(rises, default=0.0),
                fall=max(falls),
                disagreement=parted(states[0], labels[0], k, *both) if both is not None else None,
                views=sum(len(c.windows[k]) for c in here),
            )
        )
    return out


def changes(crossed: CrossViews, part: int, kind: str) -> list[tuple[float, float]]:
    """The part's residual for every nudge of its joint, (forth, back)."""
    body, T = crossed.body, crossed.transforms[part]
    points = body.g.means[body.rows(part + 1)].double().cpu()
    radius = max(float((points - points.mean(0)).square().sum(1).mean().sqrt()), 1e-3)
    pairs = nudges(kind, T, se3.apply(T, points.mean(0)[None])[0], radius)
    return [(crossed.part_error(part, forth), crossed.part_error(part, back)) for forth, back in pairs]


def parted(state: StateGaussians, labels: Tensor, part: int, forward: Tensor, backward: Tensor) -> float:
    """Mean distance between the places of a part's Gaussians under two motions [K-1, 4, 4]; 0 for an empty part."""
    points = state.gaussians.means[labels == part + 1].double()
    if not len(points):
        return 0.0
    return float(se3.mean_gap(forward[part], backward[part], points))
