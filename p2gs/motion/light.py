"""How light changes as a part turns: its sides face other lamps, and a door that opens in a room may lose a third of
its brightness.

How bright a surface is depends on which way it faces, to first order linearly (Basri and Jacobs 2003,
DOI 10.1109/TPAMI.2003.1177153), and so does the logarithm of how much brighter it is after a turn. That is fitted to
surface of a turning part that lands on surface of the same part and side, and colours of two states are compared after
it. A slide faces the lamps as before, and its colours stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import shortest_axes, with_static
from p2gs.ops import se3
from p2gs.ops.knn import knn
from p2gs.ops.sh import C0, dc_to_rgb
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.free_space import landed

FEWEST = 10  # points of a part: fewer are noise; as many that have no direction stand against one being found
DARK = 1 / 255  # one level of a photograph: what is darker has no ratio
ROUNDS = 10  # of reweighting, after which gains stand still to a thousandth (seven parts of three objects)
# what ``seen_from`` and ``facing`` found last: Gaussians, tolerance, results
_SEEN: WeakKeyDictionary[DepthStack, tuple] = WeakKeyDictionary()


@dataclass(frozen=True)
class TurnedLight:
    """How much brighter the end has the surface of each part: exp(a + b . n), n which way it faces at the start.

    of: [K, 4], a and b of each part; 0 of what does not turn.
    """

    of: Tensor

    def gains(self, labels: Tensor, normals: Tensor) -> Tensor:
        """[N] of surface of parts ``labels`` [N] (0 and -1: 1) that faces ``normals`` [N, 3] at the start (0: not
        known)."""
        of = torch.cat([self.of.new_zeros(1, 4), self.of])[labels.clamp_min(0)]
        return (of[:, 0] + (of[:, 1:] * normals).sum(1)).exp()


def turned_light(
    points: list[Tensor],
    normals: list[Tensor],
    colours: list[Tensor],
    labels: list[Tensor],
    transforms: Sequence[Tensor],
    turns: list[bool],
    reach: float,
    alike: bool = False,
) -> TurnedLight:
    """How brightness (mean of channels) changes from start to end; not at all for slides and where fewer than
    ``FEWEST`` points are seen in both.

    By state: points [N, 3], normals [N, 3] towards whoever sees them (0: nobody does), colours [N, 3] in 0..1, labels
    [N]. transforms: [4, 4] start -> end of each part.  turns: which of them turn.  reach: how far apart what is one
    place in both states may lie.  alike: for every direction, the median.
    """
    of = torch.zeros(len(turns), 4)
    bright = [c.mean(1).clamp_min(DARK).log() for c in colours]
    for k in (k for k, turn in enumerate(turns) if turn):
        mine, ratios, ways = [(x == k + 1).nonzero().squeeze(1) for x in labels], [], []
        if min(map(len, mine)) == 0:
            continue
        for s in (0, 1):
            T = (se3.inverse(transforms[k]) if s else transforms[k]).to(points[s])
            here, there = mine[s], mine[1 - s]
            at, way = se3.apply(T, points[s][here]), normals[s][here] @ T[:3, :3].T
            distance, near = knn(points[1 - s][there].contiguous(), at.contiguous(), 1)
            met = there[near[:, 0]]
            same = (distance[:, 0] < reach) & ((way * normals[1 - s][met]).sum(1) > 0)
            ratios.append((1 - 2 * s) * (bright[1 - s][met] - bright[s][here])[same])
            ways.append((way if s else normals[s][here])[same])
        if sum(map(len, ratios)) < FEWEST:
            continue
        if alike:
            of[k, 0] = torch.cat(ratios).median()
        else:
            of[k] = _robust(torch.cat(ratios), torch.cat(ways))
    return TurnedLight(of)


def _robust(ratios: Tensor, normals: Tensor) -> Tensor:
    """[4] a and b of a + b . n by ``ratios`` [N] at ``normals`` [N, 3]: least squares within the median error, absolute
    errors beyond it."""
    rows, y = torch.cat([torch.ones(len(normals), 1), normals], 1).double(), ratios.double()
    held = torch.diag(torch.tensor([0.0, FEWEST, FEWEST, FEWEST])).double()
    found = torch.zeros(4).double()
    found[0] = y.median()
    for _ in range(ROUNDS):
        off = (y - rows @ found).abs()
        middle = off.median().clamp_min(1e-6)
        weighted = rows * (middle / off.clamp_min(middle))[:, None]
        found = torch.linalg.solve(weighted.T @ rows + held, weighted.T @ y)
    return found.float()


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
    light = turned_light(points, normals, colours, labels, list(motions.transforms), turns, moving)
    at_start = normals[0], _turned_back(normals[1], motions.labels[1].clamp_min(0), motions.transforms)
    gains = [light.gains(of, ways) for of, ways in zip(motions.labels, at_start, strict=True)]
    return [
        replace(state, gaussians=brighter(state.gaussians, 1 / gain if s else gain))
        for s, (state, gain) in enumerate(zip(states, gains, strict=True))
    ]


def facing_either(
    g: GaussianTensors, labels: Tensor, transforms: Tensor, stacks: list[DepthStack], tau: float
) -> Tensor:
    """[N, 3] the shortest axis of each of a twin's Gaussians at the start, towards the cameras of either state that see
    it on a surface; 0 where none does. labels [N], transforms [K, 4, 4]: their parts and these parts' motions."""
    own = g.detach().to("cpu")
    there = stacks[1].seen_from(landed(own.means, labels, transforms), tau)
    return _towards(own, stacks[0].seen_from(own.means, tau) + _turned_back(there, labels, transforms))


def _turned_back(ways: Tensor, labels: Tensor, transforms: Tensor) -> Tensor:
    """Directions [N, 3] at the end of what parts ``labels`` [N] carry, as they were at the start."""
    R = with_static(transforms)[labels][:, :3, :3].to(ways)
    return (R.transpose(1, 2) @ ways[..., None])[..., 0]


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
        ways = stack.seen_from(own.means, tau)
        known = _SEEN[stack] = (g, tau, ways, _towards(own, ways))
    return known[2], known[3]


def _towards(g: GaussianTensors, ways: Tensor) -> Tensor:
    """[N, 3] the shortest axis of each Gaussian, the way that has ``ways`` [N, 3] before it (0: there is none)."""
    normal = shortest_axes(g)
    return normal * (normal * ways).sum(1, keepdim=True).sign()


def brighter(g: GaussianTensors, gains: Tensor) -> GaussianTensors:
    """The Gaussians with their colours times ``gains`` [N]."""
    gain = gains.to(g.sh)[:, None, None]
    base = g.sh[:, :1] * gain + (gain - 1) * 0.5 / C0
    return replace(g, sh=torch.cat([base, g.sh[:, 1:] * gain], 1))
