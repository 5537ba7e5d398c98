"""The room behind an opening: what nothing fixes in depth gives way to the walls behind it, where the photographs allow
it.

A dim, noisy inside tells photographs next to nothing of its depth. Training closes the opening with a lid, often as far
out as the free edges of the open doors, where the other state sees empty space: it cannot be the base's then, is
labelled a door's, and swings with it. Made things are hollow: unless pictures say otherwise, a view into an opening
ends at the inner side of the walls that are known from outside. Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Callable

import torch
from torch import Tensor

from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3
from p2gs.ops.knn import knn
from p2gs.parts.islands import SOLID, find_islands
from p2gs.parts.patches import patches
from p2gs.render.base import MAX_FEATURES
from p2gs.surface.boards import Rays, find_boards
from p2gs.surface.walls import DEEPEST, Backdrop, Walls, over_surface
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.evidence import render_depths
from p2gs.visibility.free_space import SURFACE, landed, out_of_sight

# share of the most Gaussians that any backdrop lets give way from which on backdrops are held against the photographs
ALIKE = 0.9
APART = 0.25  # share of a part's largest piece below which another one is apart from it
LEVEL = 1 / 255  # of a photograph's brightness: less than this it does not tell
COVER = 5.0  # pixels, all checked views together, that a patch must cover to be judged


@dataclass
class OpeningsConfig:
    """Options of the room behind openings.

    may_lose: patches of the base give way where the image error over each of them rises to no more than this times what
    it was; 0 = off.
    doors: the same for patches of turning parts, which hardly have insides that go with them, and for pieces that hang
    apart from their part. drawers: for patches of sliding parts, which have such insides. rest: at least this for
    patches most of whose neighbours gave way.
    boards: whether flat boards inside (shelves, partitions, bottoms of drawers) are looked for, before which walls are
    not seen.
    patch: Gaussians a patch. looks, checks: views of a state from which rays are cast, and by which patches are judged;
    size: their long edge in pixels. apart: surfaces of a part that the other state shows within this confirm it; cell:
    grid of the walls; wall: their thickness (all internal units).
    """

    may_lose: float = 1.25
    doors: float = 3.0
    drawers: float = 1.0
    rest: float = 1.6
    boards: bool = True
    patch: int = 15
    looks: int = 64
    checks: int = 12
    size: int = 200
    apart: float = 0.035
    cell: float = 0.02
    wall: float = 0.03


@dataclass
class Opening:
    """What becomes of a state: ``kept`` [N] of its Gaussians stay, and the walls' inner sides come after them."""

    kept: Tensor
    behind: GaussianTensors

    def of(self, state: StateGaussians) -> StateGaussians:
        """The state opened up, or the same Gaussians further trained."""
        return replace(state, gaussians=GaussianTensors.cat([state.gaussians[self.kept], self.behind]))


def unconfirmed(
    g: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    other: GaussianTensors,
    other_labels: Tensor,
    stack: DepthStack,
    apart: float,
) -> tuple[Tensor, Tensor]:
    """Which Gaussians of one state the other one says nothing of, [N] bool: carried there they are behind what its
    views see, and farther than ``apart`` from surfaces of their own part (what hangs where a door shuts is not the
    door's). And which of these are near another part's, [N] bool.

    transforms [K-1, 4, 4] to the other state; labels [N], other_labels [M]: of both; stack: the other one's rendered
    depth."""
    at, solid = landed(g.means, labels, transforms), torch.sigmoid(other.opacity_logits) > SOLID
    own = torch.full((len(g),), torch.inf)
    for part in labels.unique().tolist():
        mine, theirs = (labels == part).nonzero().squeeze(1), other.means[solid & (other_labels == part)]
        if len(theirs):
            own[mine] = knn(theirs, at[mine], 1, False)[0][:, 0]
    lids = out_of_sight(at, stack) & (own > apart)
    return lids, lids & (knn(other.means[solid], at, 1, False)[0][:, 0] <= apart)


def on_parts(means: Tensor, labels: Tensor, lids: Tensor, solid: Tensor, apart: float) -> Tensor:
    """Labels [N], where ``lids`` [N] bool of the base that lie on a moving part's ``solid`` [N] bool Gaussians in their
    own state, nearer than ``apart``, are that part's: a lid has air on both sides, and these are seams of a shut front,
    or its haze. means [N, 3]; labels [N]: as they were."""
    moving = (solid & (labels > 0)).nonzero().squeeze(1)
    rows, given = (lids & (labels == 0)).nonzero().squeeze(1), labels.clone()
    if len(moving) and len(rows):
        distance, nearest = knn(means[moving], means[rows], 1, False)
        given[rows] = torch.where(distance[:, 0] <= apart, labels[moving[nearest[:, 0]]], 0)
    return given


BASE, DOOR, DRAWER = range(3)


def kinds(g: GaussianTensors, labels: Tensor, types: list[str]) -> Tensor:
    """What each Gaussian is taken for, [N]: the BASE's, a DOOR's (as pieces apart from their part are) or a DRAWER's.
    labels [N]."""
    kind = torch.tensor([BASE] + [DRAWER if t == "prismatic" else DOOR for t in types])[labels]
    solid = (torch.sigmoid(g.opacity_logits) > SOLID).nonzero().squeeze(1)
    apart = find_islands(g.means[solid], labels[solid], APART) >= 0
    kind[solid[apart]] = DOOR
    return kind


class OneState:
    """One state's lids and what is behind them: g its Gaussians; lids, and those ``beside`` another part's surface [N]
    bool; kind [N]: see ``kinds``."""

    def __init__(
        self,
        g: GaussianTensors,
        lids: Tensor,
        beside: Tensor,
        kind: Tensor,
        views,
        config: OpeningsConfig,
        backend: str,
        device,
    ):
        self.g, self.views, self.config, self.backend, self.device = g, views, config, backend, device
        self.rows = lids.nonzero().squeeze(1)
        self.patch = patches(g[self.rows], config.patch)
        self.count = int(self.patch.max()) + 1
        votes = torch.zeros(self.count, 3).index_put_(
            (self.patch, kind[self.rows]), torch.ones(len(self.rows)), accumulate=True
        )
        self.allowed = torch.tensor([config.may_lose, config.doors, config.drawers])[votes.argmax(1)]
        close = torch.zeros(self.count).index_add_(0, self.patch, beside[self.rows].float())
        # a bar between two doors is beside them when they are shut: it must not be explained worse
        self.allowed = torch.where(close > votes.sum(1) / 2, self.allowed.clamp_max(1.0), self.allowed)
        self.level = min(range(len(views.levels)), key=lambda i: abs(views.levels[i] - config.size))

    def render(self, g: GaussianTensors, camera, background: Tensor, features: Tensor | None = None):
        features = None if features is None else features.to(self.device)
        g, camera, background = g.to(self.device), camera.to(self.device), background.to(self.device)
        return render_gaussians(g, camera, background, features=features, backend=self.backend)

    def rays(self, walls: Walls) -> Rays:
        """Rays of the photographs through lids, from there to the wall behind; those that meet none are left out."""
        lids = torch.zeros(len(self.g), 1)
        lids[self.rows] = 1
        found = []
        for i in self.views.spread(self.config.looks):
            shot = self.views.get(i, self.level, torch.zeros(3))
            out = self.render(self.g, shot.camera, torch.zeros(3), lids)
            depth = (out.expected_depth if out.median_depth is None else out.median_depth).cpu()
            y, x = ((out.painted[..., 0].cpu() > 0.5) & (shot.alpha > 0.9) & (depth > 0)).nonzero().unbind(1)
            K, W = shot.camera.K.double(), shot.camera.viewmat.double()
            ray = torch.stack(
                [(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], torch.ones(len(x), dtype=torch.float64)],
                1,
            )
            start = (ray * depth[y, x, None].double() - W[:3, 3]) @ W[:3, :3]
            way = torch.nn.functional.normalize(ray @ W[:3, :3], dim=1)
            patch = self.patch[knn(self.g.means[self.rows], start.float(), 1, False)[1][:, 0]]
            found.append((start, way, walls.meet(start, way), shot.image[y, x], patch))
        rays = Rays(*(torch.cat(x) for x in zip(*found, strict=True)))
        return rays[rays.far.isfinite()]

    def backdrops(self, walls: Walls, stacks: list[DepthStack]) -> list[Backdrop]:
        """What rays that meet a lid may meet behind it: walls alone; boards before them, where photographs agree on
        these more than on the lid; and where they do more than on the walls."""
        rays, near = self.rays(walls), 2 * self.config.cell
        wall, unseen = self.inner_side(rays.start + rays.far.clamp_max(DEEPEST)[:, None] * rays.way, rays.way, stacks)
        out = [self.backdrop(rays, wall, unseen, 0)]
        for stay in (True, False) if self.config.boards else ():
            boards = find_boards(rays, walls.lo, walls.lo + walls.size * walls.cell, near, stay)
            if boards:
                t = torch.stack([b.meet(rays, near) for b in boards]).amin(0)
                stopped = t.isfinite()
                place = (rays.start + torch.where(stopped, t, 0.0)[:, None] * rays.way).float()
                found = torch.where(stopped, self.unseen(place, stacks), unseen)
                out.append(self.backdrop(rays, torch.where(stopped[:, None], place, wall), found, len(boards)))
        return out

    def backdrop(self, rays: Rays, place: Tensor, found: Tensor, boards: int) -> Backdrop:
        """Points where the rays that ``found`` [R] one end, at ``place`` [R, 3], and the photographs' colours there."""
        place, rays, cell = place[found], rays[found], self.config.cell
        voxels, where = torch.unique((place / cell).floor().long(), dim=0, return_inverse=True)
        n = torch.bincount(where, minlength=len(voxels))
        points = torch.zeros(len(voxels), 3).index_add_(0, where, place) / n.clamp_min(1)[:, None]
        return Backdrop(points, where, rays.colour, rays.patch, cell, boards)

    def inner_side(self, met: Tensor, way: Tensor, stacks: list[DepthStack]) -> tuple[Tensor, Tensor]:
        """Points [R, 3] before the walls that rays along ``way`` [R, 3] ``met`` [R, 3], at the first of a few depths
        that no view of either state sees; and whether there is one [R]."""
        place, found = met.float(), torch.zeros(len(met), dtype=torch.bool)
        for factor in (1.0, 1.5, 2.0, 2.7):
            tried = (met - factor * self.config.wall * way).float()
            unseen = self.unseen(tried, stacks)
            place = torch.where((unseen & ~found)[:, None], tried, place)
            found |= unseen
        return place, found

    @staticmethod
    def unseen(points: Tensor, stacks: list[DepthStack]) -> Tensor:
        """Which points [R, 3] are behind something in each state, and in no view before it or on it, [R] bool."""
        out = torch.ones(len(points), dtype=torch.bool)
        for stack in stacks:
            free, on, behind = stack.counts(points, SURFACE)
            out &= (free + on == 0) & (behind > 0)
        return out

    def choose(self, backdrops: list[Backdrop]) -> tuple[Tensor, Backdrop]:
        """Patches [K] bool that give way together, and their backdrop: the one with the least image error of those that
        let most of the patches' Gaussians do so."""
        grey = torch.full((3,), 0.5)
        shots = [self.views.get(i, self.level, grey) for i in self.views.spread(self.config.checks)]
        onehot = torch.zeros(len(self.g), self.count)
        onehot[self.rows, self.patch] = 1
        chunks = onehot.split(MAX_FEATURES, 1)
        weight = [torch.cat([self.render(self.g, s.camera, grey, c).painted.cpu() for c in chunks], -1) for s in shots]
        pixels = [w.sum(-1) > 0.01 for w in weight]
        weight = torch.cat(
            [w[p] for w, p in zip(weight, pixels, strict=True)]
        ).T.contiguous()  # [K, pixels that any patch covers]

        def over_patches(g: GaussianTensors) -> Tensor:
            pictures = [self.render(g, s.camera, grey).colour.cpu() for s in shots]
            return weight @ torch.cat(
                [(x - s.image).abs().sum(-1)[p] for x, s, p in zip(pictures, shots, pixels, strict=True)]
            )

        cover = weight.sum(1)
        was = over_patches(self.g).clamp_min(3 * LEVEL * cover)

        def giving_way(backdrop: Backdrop) -> Tensor:
            def worse(chosen: Tensor, allowed: Tensor) -> Tensor:
                ratio = over_patches(self.without(chosen, backdrop)[0]) / (was * allowed).clamp_min(1e-9)
                return torch.where(chosen, ratio, 0.0)

            return self.give_way(cover > COVER, torch.bincount(backdrop.patch, minlength=self.count) > 0, worse)

        tried = [(giving_way(b), b) for b in backdrops]
        gone = [int(chosen[self.patch].sum()) for chosen, _ in tried]
        good = [outcome for outcome, n in zip(tried, gone, strict=True) if n >= ALIKE * max(gone)]
        return min(good, key=lambda outcome: float(over_patches(self.without(*outcome)[0]).sum()))

    def give_way(self, judged: Tensor, met: Tensor, worse: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Patches [K] bool that give way together, of those ``judged`` [K] bool.

        All behind which rays ``met`` [K] bool something go at first; while pixels of some are explained too much
        ``worse``, the worst stays, or the worse half of those that fail by far. What stayed because of others is tried
        once more, one by one, and at last what is left amid those that went: a lid is one surface.
        """
        chosen, allowed = judged & met, self.allowed
        while chosen.any():
            ratio = worse(chosen, allowed)
            if float(ratio.max()) <= 1:
                break
            failed = int((ratio > 2).sum())
            chosen[ratio.topk(max(1, failed // 2)).indices] = False
        if not chosen.any():
            return chosen
        for k in (judged & ~chosen).nonzero().squeeze(1).tolist():
            chosen = self.with_one_more(chosen, k, lambda c: worse(c, allowed))
        amid = judged & ~chosen & self.surrounded(chosen)
        allowed = torch.where(amid, allowed.clamp_min(self.config.rest), allowed)
        for k in amid.nonzero().squeeze(1).tolist():
            chosen = self.with_one_more(chosen, k, lambda c: worse(c, allowed))
        return chosen

    @staticmethod
    def with_one_more(chosen: Tensor, k: int, worse: Callable[[Tensor], Tensor]) -> Tensor:
        """``chosen`` [K] bool with patch k, if none of them is explained too much worse then."""
        more = chosen.clone()
        more[k] = True
        return more if float(worse(more).max()) <= 1 else chosen

    def surrounded(self, chosen: Tensor) -> Tensor:
        """Which patches [K] have most of their neighbours among the patches ``chosen`` [K] bool."""
        index = knn(self.g.means[self.rows], None, min(8, len(self.rows) - 1), True)[1]
        beside = self.patch[index] != self.patch[:, None]
        count = torch.zeros(2, self.count)
        count[0].index_add_(0, self.patch, beside.sum(1).float())
        count[1].index_add_(0, self.patch, (beside & chosen[self.patch[index]]).sum(1).float())
        return count[1] > 0.5 * count[0].clamp_min(1)

    def without(self, chosen: Tensor, backdrop: Backdrop) -> tuple[GaussianTensors, Tensor, Tensor]:
        """The state with the backdrop, at its end, instead of the patches ``chosen`` [K] bool; which of its own it
        keeps [N] bool; which of the backdrop's a ray fell on or beside."""
        keep = torch.ones(len(self.g), dtype=torch.bool)
        keep[self.rows[chosen[self.patch]]] = False
        behind, near = backdrop.gaussians(chosen, self.g.sh.shape[1])
        return GaussianTensors.cat([self.g[keep], behind]), keep, near


@torch.no_grad()
def open_up(
    states: list[StateGaussians],
    motions: PartMotions,
    views,
    stacks: list[DepthStack],
    config: OpeningsConfig,
    *,
    backend: str,
    device="cpu",
) -> tuple[list[Opening], PartMotions, list[DepthStack], list[dict]]:
    """By state, which lids give way to the inner sides of the walls behind them; the motions with labels of these (the
    base's) and of what lies ``on_parts``, the depth of both states so opened, and what was counted, by state.

    views: ``TrainingViews`` by state; stacks: rendered depth of both states.
    """
    away = (motions.transforms, se3.inverse(motions.transforms))
    g = [s.gaussians for s in states]
    solid = [torch.sigmoid(x.opacity_logits) > SOLID for x in g]
    counted = [{"unconfirmed": 0, "patches": 0, "boards": 0, "gave_way": 0, "removed": 0, "added": 0} for _ in states]
    out = [Opening(torch.ones(len(x), dtype=torch.bool), x[:0]) for x in g]
    if min(int(k.sum()) for k in solid) < config.patch:  # no object: fusion says so
        return out, motions, stacks, counted
    found = (
        unconfirmed(g[s], motions.labels[s], away[s], g[1 - s], motions.labels[1 - s], stacks[1 - s], config.apart)
        for s in (0, 1)
    )
    lids, beside = zip(*found, strict=True)
    labels = [on_parts(g[s].means, motions.labels[s], lids[s], solid[s], config.apart) for s in (0, 1)]
    lids = [of & (new == old) for of, new, old in zip(lids, labels, motions.labels, strict=True)]
    motions = replace(motions, labels=labels)
    base = [solid[s] & ~lids[s] & (motions.labels[s] == 0) for s in (0, 1)]
    box = torch.quantile(
        torch.cat([x.means[k] for x, k in zip(g, solid, strict=True)]), torch.tensor([0.002, 0.998]), 0
    )
    walls = Walls(torch.cat([over_surface(x[k]) for x, k in zip(g, base, strict=True)]), box[0], box[1], config.cell)
    labels, margin, depth = list(motions.labels), list(motions.margin), list(stacks)
    for s in (0, 1):
        counted[s]["unconfirmed"] = int(lids[s].sum())
        if int((lids[s] & solid[s]).sum()) < config.patch:
            continue
        kind = kinds(g[s], motions.labels[s], motions.types)
        state = OneState(g[s], lids[s], beside[s], kind, views[s], config, backend, device)
        chosen, backdrop = state.choose(state.backdrops(walls, stacks))
        counted[s] |= {"patches": state.count, "boards": backdrop.boards, "gave_way": int(chosen.sum())}
        if not chosen.any():
            continue
        new, kept, near = state.without(chosen, backdrop)
        cameras = stacks[s].cameras
        depth[s] = DepthStack(*render_depths(new, cameras, backend, device), cameras)
        seen = torch.ones(len(new), dtype=torch.bool)
        n = int(kept.sum())
        seen[n:] = near | (depth[s].counts(new.means[n:], SURFACE)[1] > 0)
        extra = int(seen.sum() - kept.sum())
        counted[s] |= {"removed": int((~kept).sum()), "added": extra}
        out[s] = Opening(kept, new[n:][seen[n:]])
        labels[s] = torch.cat([labels[s][kept], torch.zeros(extra, dtype=torch.int64)])
        margin[s] = torch.cat([margin[s][kept], torch.ones(extra)])
    return out, replace(motions, labels=labels, margin=margin), depth, counted
