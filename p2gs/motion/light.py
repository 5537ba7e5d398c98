"""How light changes as a part turns: its sides face other lamps, and a door that opens in a room may lose a third of
its brightness.

Colours of two states are compared after a gain per turning part: the median, over surface that lands on surface of the
same part and side, of how much brighter the end has it. A slide faces the lamps as before and has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3, so3
from p2gs.ops.knn import knn
from p2gs.ops.sh import C0, dc_to_rgb
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack

FEWEST = 10  # points of a part: the median of fewer is noise
DARK = 1 / 255  # one level of a photograph: what is darker has no ratio
# what ``seen_from`` and ``facing`` found last: Gaussians, tolerance, results
_SEEN: WeakKeyDictionary[DepthStack, tuple] = WeakKeyDictionary()


def turning_gains(
    points: list[Tensor],
    normals: list[Tensor],
    colours: list[Tensor],
    labels: list[Tensor],
    transforms: Sequence[Tensor],
    turns: list[bool],
    reach: float,
) -> Tensor:
    """[K] brightness (mean of channels) at the end over that at the start of each part; 1 for slides and where fewer
    than ``FEWEST`` points are seen in both.

    By state: points [N, 3], normals [N, 3] towards whoever sees them (0: nobody does), colours [N, 3] in 0..1, labels
    [N]. transforms: [4, 4] start -> end of each part.  turns: which of them turn.  reach: how far apart what is one
    place in both states may lie.
    """
    gains = torch.ones(len(turns))
    bright = [c.mean(1).clamp_min(DARK).log() for c in colours]
    for k in (k for k, turn in enumerate(turns) if turn):
        mine, found = [(x == k + 1).nonzero().squeeze(1) for x in labels], []
        if min(map(len, mine)) == 0:
            continue
        for s in (0, 1):
            T = (se3.inverse(transforms[k]) if s else transforms[k]).to(points[s])
            here, there = mine[s], mine[1 - s]
            at, way = se3.apply(T, points[s][here]), normals[s][here] @ T[:3, :3].T
            distance, near = knn(points[1 - s][there].contiguous(), at.contiguous(), 1)
            met = there[near[:, 0]]
            same = (distance[:, 0] < reach) & ((way * normals[1 - s][met]).sum(1) > 0)
            found.append((1 - 2 * s) * (bright[1 - s][met] - bright[s][here])[same])
        ratios = torch.cat(found)
        if len(ratios) >= FEWEST:
            gains[k] = ratios.median().exp()
    return gains


def as_lit_there(
    states: list[StateGaussians], motions: PartMotions, stacks: list[DepthStack], static: float, moving: float
) -> list[StateGaussians]:
    """Both states with the colours of turning parts as the other state's light has them.

    stacks: rendered depth of both states.  static, moving: tolerances, internal units, for a Gaussian that is seen on
    its own state's surface and for one that lands on the other's; where one is 0 nothing is asked (``what_counts``).
    """
    turns = [kind == "revolute" for kind in motions.types]
    if not any(turns) or min(static, moving) <= 0:
        return states
    points, normals, colours, labels = [], [], [], []
    for state, of, stack in zip(states, motions.labels, stacks, strict=True):
        g = state.gaussians
        points.append(g.means.detach().cpu())
        normals.append(facing(g, stack, static))
        colours.append(dc_to_rgb(g.sh[:, 0]).clamp(0, 1).detach().cpu())
        labels.append(torch.where(normals[-1].any(1), of, -1))
    gains = turning_gains(points, normals, colours, labels, list(motions.transforms), turns, moving)
    return [
        replace(state, gaussians=brighter(state.gaussians, of, 1 / gains if s else gains))
        for s, (state, of) in enumerate(zip(states, motions.labels, strict=True))
    ]


def facing(g: GaussianTensors, stack: DepthStack, tau: float) -> Tensor:
    """[N, 3] the shortest axis of each Gaussian, towards the cameras that see it on a surface; 0 where none does."""
    return _seen(g, stack, tau)[1]


def seen_from(g: GaussianTensors, stack: DepthStack, tau: float) -> Tensor:
    """``DepthStack.seen_from`` of a state's own Gaussians, on the CPU."""
    return _seen(g, stack, tau)[0]


def _seen(g: GaussianTensors, stack: DepthStack, tau: float) -> tuple[Tensor, Tensor]:
    """Of ``seen_from`` and ``facing``: found once for a stack, as no motion changes it."""
    known = _SEEN.get(stack)
    if known is None or known[0] is not g or known[1] != tau:
        own = g.detach().to("cpu")
        R, shortest = so3.quat_to_matrix(so3.quat_normalize(own.quats)), own.log_scales.argmin(1)
        normal = R.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
        ways = stack.seen_from(own.means, tau)
        known = _SEEN[stack] = (g, tau, ways, normal * (normal * ways).sum(1, keepdim=True).sign())
    return known[2], known[3]


def brighter(g: GaussianTensors, labels: Tensor, gains: Tensor) -> GaussianTensors:
    """The Gaussians with the colours of part k + 1 times ``gains`` [K]; labels [N] (0 static)."""
    gain = torch.cat([torch.ones(1), gains]).to(g.sh)[labels.clamp_min(0).to(g.sh.device)][:, None, None]
    sh = g.sh * gain
    sh[:, :1] = sh[:, :1] + (gain - 1) * 0.5 / C0
    return replace(g, sh=sh)
