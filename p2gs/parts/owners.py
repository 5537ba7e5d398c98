"""Whose is what a part hides while it is shut: what comes out of a body behind a front belongs to that front.

The inside of a drawer is seen when the drawer is open. Shut, its own front hides it, under any motion that carries it
back, so the other state cannot tell whether it went with this drawer, the one below or a door. But it can tell what it
lies behind. Doors hardly have insides that go with them: what lies behind a door stays whose it was. What its part
hides from no view, and what is as hidden where it is, need not have moved.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import with_static
from p2gs.ops import se3
from p2gs.ops.blend import likeliest
from p2gs.parts.patches import patches
from p2gs.render.base import MAX_FEATURES
from p2gs.types import Camera, GaussianTensors, RenderOutput
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.free_space import SEEN, SURFACE, landed, out_of_sight

CLEARLY = 2.0  # times as often as the part it was given to must another hide it
NEVER = 0.01  # share of the views below which a part hides a thing in none
PATCH = 15  # Gaussians that change together, in the mean
LEAST = 0.1  # share of the views in which that one must


@torch.no_grad()
def label_maps(g: GaussianTensors, labels: Tensor, count: int, stack: DepthStack, backend: str, device) -> Tensor:
    """What part covers most of each pixel of the stack's views, [V, H, W] int64. labels [N] in 0..count-1."""
    g, shares = g.to(device), torch.nn.functional.one_hot(labels, count).float().to(device)
    maps = torch.zeros(stack.depth.shape, dtype=torch.int64)
    for out, camera in zip(maps, stack.cameras, strict=True):
        out[: camera.height, : camera.width] = label_map(g, shares, camera.to(device), backend)[0]
    return maps


@torch.no_grad()
def label_map(g: GaussianTensors, shares: Tensor, camera: Camera, backend: str) -> tuple[Tensor, RenderOutput]:
    """What part covers most of each pixel of a view, [H, W] int64 on the CPU, and the view. shares [N, K]: of each part
    in each Gaussian, on the same device."""
    drawn = [render_gaussians(g, camera, features=c, backend=backend) for c in shares.split(MAX_FEATURES, 1)]
    share = torch.cat([out.painted.cpu() for out in drawn], -1)
    return likeliest(share.flatten(0, 1)).reshape(share.shape[:2]), drawn[0]


def hiders(points: Tensor, stack: DepthStack, maps: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """How often each part is what a view sees before each point, [N, count]; and how many views see the point or past
    it, [N].

    maps [V, H, W]: what part the stack's first views see.
    """
    z, pixel, inside = stack.project(points, torch.arange(len(maps)))
    behind = inside & stack.valid.reshape(-1)[pixel] & (stack.far.reshape(-1)[pixel] < z - SURFACE)
    hidden = torch.zeros(len(points), count).scatter_add_(1, maps.reshape(-1)[pixel], behind.float())
    return hidden, (inside & ~behind).float().sum(1)


def owners(
    g: GaussianTensors,
    labels: Tensor,
    transforms: Tensor,
    stack: DepthStack,
    maps: Tensor,
    groups: Tensor,
    rows: Tensor,
    takers: Tensor,
) -> Tensor:
    """Labels [N] of one state's Gaussians, those of hidden ones by what hides them in the other state.

    labels [N]; transforms [K-1, 4, 4] to the other state; stack, maps: its rendered depth and ``label_maps``.  rows
    [M]: Gaussians that may change, in ``groups`` [M] that change together: from a moving part to another one, of the
    ``takers`` [K] bool, that hides them, carried by its motion, ``CLEARLY`` more often; or to the base, under which
    they are hidden, too, from one that hides them from no view.
    """
    T = with_static(transforms).to(g.means)
    count, n = len(T), int(groups.max()) + 1 if len(groups) else 0
    share = torch.zeros(n, count)
    seen = torch.zeros(n, count)
    total = torch.zeros(n, count)
    for k in range(count):
        hidden, visible = hiders(se3.apply(T[k], g.means[rows]), stack, maps, count)
        share[:, k].index_add_(0, groups, hidden[:, k])
        seen[:, k].index_add_(0, groups, visible)
        total[:, k].index_add_(0, groups, hidden.sum(1) + visible)
    share, seen = share / total.clamp_min(1), seen / total.clamp_min(1)
    votes = torch.zeros(n, count).index_put_((groups, labels[rows]), torch.ones(len(rows)), accumulate=True)
    now = votes.argmax(1)
    best = torch.where((seen <= SEEN) & takers, share, 0.0)[:, 1:].max(1)
    mine = share[torch.arange(n), now]
    change = (now > 0) & (best.indices + 1 != now) & (best.values > LEAST) & (best.values > CLEARLY * mine)
    taker = torch.where(change, best.indices + 1, now)
    # hidden by others alone, and as well where it is: it need not have moved
    still = (now > 0) & ~change & (mine < NEVER) & (seen[:, 0] <= SEEN) & (total[:, 0] > 0)
    taker = torch.where(still, 0, taker)
    out = labels.clone()
    moved = (change | still)[groups] & (labels[rows] > 0)
    out[rows[moved]] = taker[groups[moved]]
    return out


@torch.no_grad()
def hidden_to_owners(
    states: list[StateGaussians], motions: PartMotions, stacks: list[DepthStack], *, backend: str, device="cpu"
) -> tuple[PartMotions, list[int]]:
    """The motions with what the other state hides given to the sliding parts that hide it (``owners``), and how many
    changed, by state.

    stacks: rendered depth of both states.
    """
    count, labels = len(motions.transforms) + 1, list(motions.labels)
    changed = [0, 0]
    takers = torch.tensor([False] + [kind == "prismatic" for kind in motions.types])
    for s, away in enumerate((motions.transforms, se3.inverse(motions.transforms))):
        g, other = states[s].gaussians, stacks[1 - s]
        rows = ((labels[s] > 0) & out_of_sight(landed(g.means, labels[s], away), other)).nonzero().squeeze(1)
        if len(rows) == 0:
            continue
        maps = label_maps(states[1 - s].gaussians, motions.labels[1 - s], count, other, backend, device)
        labels[s] = owners(g, labels[s], away, other, maps, patches(g[rows], PATCH), rows, takers)
        changed[s] = int((labels[s] != motions.labels[s]).sum())
    return replace(motions, labels=labels), changed
