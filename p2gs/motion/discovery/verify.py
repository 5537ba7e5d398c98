"""Image-space check of a complete explanation: every point carried to the other state must agree with what that state
shows there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2gs.motion.discovery.fields import Landing
from p2gs.motion.discovery.labels import Labelling
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions, same_place
from p2gs.motion.light import TurnedLight, turned_light

WRONG = 1.0  # cost of a point that something contradicts; hidden space costs what it does where motions are searched
VIEWS = 32  # of the other state that are asked, at most
NEIGHBOURS = 6  # surfels of the other state where a point lands, one of which must have come from the same place
# weight of a point that is said to move but is not known to: its error is the neighbour's rather than the motion's
STILL = 0.3


def light_of(problem: Problem, motions: Motions, labelling: Labelling) -> TurnedLight:
    """How much brighter each part is at the end (``turned_light``): one number a part, for while motions are coarse,
    more of them make up for a door that is shifted within its plane."""
    surfels, labels = problem.surfels, [labelling.labels(s) for s in (0, 1)]
    points, normals, colours = ([getattr(s, name) for s in surfels] for name in ("points", "normals", "colours"))
    transforms = [motions.transform(k) for k in range(len(motions))]
    reach = 2 * problem.scale.spacing + problem.scale.tp
    return turned_light(points, normals, colours, labels, transforms, motions.turn.tolist(), reach, alike=True)


@dataclass
class Met:
    """What labelled surfels [M] of a state meet in the other one.

    through: share of the views that nothing in front blocks which see through the place.  shown: is there such a view.
    own: does a surface lie there that came from the same place.  like: has some such surface its colour, or is it the
    plate's other side (``other_side``), whose colours tell nothing.  lost: moved, but called static.
    """

    through: Tensor
    shown: Tensor
    own: Tensor
    like: Tensor
    other_side: Tensor
    lost: Tensor

    def cost(self) -> Tensor:
        """Cost [M] in 0..1: ``WRONG`` where the place is empty, what lies there is another's or of another colour, or
        the point is lost; where all views are blocked ``Landing.HIDDEN``, or by the plate's other side
        ``Landing.TWO_SIDED``."""
        shown = self.through + (1 - self.through) * torch.where(self.like, 0.0, WRONG)
        hidden = torch.where(self.other_side, Landing.TWO_SIDED, Landing.HIDDEN)
        cost = torch.where(self.shown, shown, hidden.to(shown))
        return torch.where(self.lost, torch.full_like(cost, WRONG), cost)


def violation(
    problem: Problem, motions: Motions, labelling: Labelling, state: int, rows: Tensor, light: TurnedLight | None = None
) -> Tensor:
    """``Met.cost`` [M] of the labelled surfels ``rows`` [M] of ``state``; arguments as of ``meetings``."""
    return meetings(problem, motions, labelling, state, rows, light).cost()


def meetings(
    problem: Problem, motions: Motions, labelling: Labelling, state: int, rows: Tensor, light: TurnedLight | None = None
) -> Met:
    """What the labelled surfels ``rows`` [M] of ``state`` meet in the other state. light: of ``light_of``, if it is
    known."""
    light = light_of(problem, motions, labelling) if light is None else light
    surf, stack, other = problem.surfels[state], problem.stacks[1 - state], problem.surfels[1 - state]
    labels = labelling.labels(state)[rows]
    places = motions.places(surf.points[rows], state == 1)
    x, colours = places[labels, torch.arange(len(rows))], surf.colours[rows].clone()
    n, thick = surf.normals[rows].clone(), torch.zeros(len(rows))
    for k in range(len(motions)):
        mine, motion = labels == k + 1, motions[k : k + 1]
        n[mine], thick[mine] = motion.rotate(n[mine], inverse=state == 1)[0], motion.thick
    gains = light.gains(labels, n if state else surf.normals[rows])
    colours *= (1 / gains if state else gains)[:, None]
    free, on, _ = stack.counts(x, problem.scale.tp, stack.spread(VIEWS))
    d, j = other.nearest(x, NEIGHBOURS)
    same = same_place(places, x, problem.scale.apart).gather(1, labelling.labels(1 - state)[j])
    own = same & (d < 2 * problem.scale.spacing + problem.scale.tp + thick[:, None])
    other_side = own & ((other.normals[j] * n[:, None]).sum(2) < 0) & (thick[:, None] > 0)
    coloured = (other.colours[j] - colours[:, None]).abs().mean(2) < problem.config.recoloured
    return Met(
        through=free / (free + on).clamp_min(1),
        shown=free + on > 0,
        own=own.any(1),
        like=(other_side | (own & coloured)).any(1),
        other_side=other_side.any(1),
        lost=(labels == 0) & problem.moved[state][rows],
    )


def image_score(problem: Problem, motions: Motions, labelling: Labelling) -> float:
    """Violation of the points that moved or are said to move, of both states together, over the weight of those that
    moved: 0 is a perfect explanation, and saying of more points that they move makes it no better."""
    total = mass = 0.0
    light = light_of(problem, motions, labelling)
    for s in (0, 1):
        mass += float(problem.trust[s][problem.moved[s]].sum())
        index = (problem.moved[s] | (labelling.labels(s) > 0)).nonzero()[:, 0]
        if len(index):
            w = torch.where(problem.moved[s], problem.trust[s], torch.full_like(problem.trust[s], STILL))[index]
            total += float((violation(problem, motions, labelling, s, index, light=light) * w).sum())
    return total / mass if mass else 0.0
