"""Part motions against the photographs: which Gaussians have a say, refinement of all motions at once, what an
explanation costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Callable, TypeVar

import torch
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.agreement import ShownPixels, kept_and_shown
from p2gs.motion.difference import image_losses
from p2gs.motion.discovery import Discovery, surface_energy
from p2gs.motion.discovery.fields import Landing
from p2gs.motion.light import as_lit_there, seen_from
from p2gs.motion.screw_polish import PolishConfig, Side, photometric_cost, polish
from p2gs.native import at_once
from p2gs.ops import se3
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack

# What a pixel costs that the other state hides: as much of the loss of one without any likeness (1 of 1 - SSIM,
# weighted 0.8) as landing in hidden space costs of landing in free space.
HIDDEN = 0.8 * Landing.HIDDEN
KNOWN = 64  # answers of a ``Judge`` that are kept
T = TypeVar("T")
LOOKED = 4  # motions of which a ``Judge`` keeps what counts: pixels' weights of all views


def polish_labels(motions: PartMotions, state: int, min_margin: float) -> Tensor:
    """Labels of one state with the ambiguous Gaussians left out (-1)."""
    return torch.where(motions.margin[state] >= min_margin, motions.labels[state], -1)


def explanation_cost(
    states,
    motions: PartMotions,
    views,
    config: PolishConfig,
    stacks: list[DepthStack],
    *,
    backend: str,
    level: int | None = None,
    seen: list[Seen] | None = None,
    by: list[Seen] | None = None,
    device="cpu",
) -> float:
    """Image loss of each state's Gaussians moved into the other state's photographs, both directions averaged.

    Of the Gaussians those that nothing contradicts are drawn (``kept_and_shown``); pixels of surface that the other
    state hides cost ``HIDDEN`` instead of what is wrong in them, which no motion could mend.  level: size of the
    photographs (None: ``config``'s last).  seen: of ``what_counts`` for these motions (None: found).  by: the same for
    the motions that say what is drawn and what counts (None: these).
    """
    seen = what_counts(states, motions, config, stacks, backend=backend, device=device) if seen is None else seen
    by = seen if by is None else by
    ways = (motions.transforms, se3.inverse(motions.transforms))
    options = {"level": config.levels[-1] if level is None else level, "backend": backend, "device": device}

    def one_way(s: int) -> float:
        labels = torch.where(by[s].kept, motions.labels[s], -1)
        there = {"shown": by[1 - s].pixels, "hidden": HIDDEN}
        return photometric_cost(seen[s].lit, labels, ways[s], views[1 - s], **there, **options)

    return 0.5 * sum(at_once(one_way, (0, 1)))


class Latest:
    """The latest ``count`` answers. Several threads may ask at once, and may then work out the same."""

    def __init__(self, count: int):
        self.count, self.kept = count, []

    def __call__(self, of: object, answer: Callable[[], T], also: object = None) -> T:
        """``answer()``, or what it was the last time for this very object ``of`` and an equal ``also``."""
        known = next((k for k in self.kept if k[0] is of and k[1] == also), None)
        known = (of, also, answer()) if known is None else known
        self.kept = [*[k for k in self.kept if k is not known][1 - self.count :], known]
        return known[2]


@dataclass
class Judge:
    """By what explanations are compared and refined: one number, the logarithm of the image loss (``explanation_cost``)
    plus what the surfaces say (``surface_energy``); lower is better. Adding 0.01 is an image loss higher by a
    hundredth, or a hundredth of the moved surface left unexplained. Many are ranked by their own energies (a call), two
    are compared by ``gain``.

    found: discovery's problem (None: photographs alone).  stacks: rendered depth of both states.  further: share of the
    image loss in its own pixels that a further part must save (``own_share``).
    """

    found: Discovery | None
    states: list
    views: dict
    config: PolishConfig
    stacks: list[DepthStack]
    seed: int
    backend: str
    device: torch.device | str = "cpu"
    further: float = 0.0
    # the latest answers: image losses; what surfaces say of transforms and types; what counts
    losses: Latest = field(default_factory=partial(Latest, KNOWN), init=False)
    surfaced: Latest = field(default_factory=partial(Latest, KNOWN), init=False)
    looked: Latest = field(default_factory=partial(Latest, LOOKED), init=False)

    def at_a_glance(self, steps: int) -> Judge:
        """The same by the smallest photographs, refining in fewer steps."""
        small = replace(self.config, steps=steps, levels=self.config.levels[:1], level_starts=[0.0])
        glance = replace(self, config=small)
        glance.surfaced, glance.looked = self.surfaced, self.looked  # neither hangs on the photographs' size
        return glance

    def seen(self, motions: PartMotions) -> list[Seen]:
        """What counts under these motions (``what_counts``)."""
        options = {"backend": self.backend, "device": self.device}
        return self.looked(motions, partial(what_counts, self.states, motions, self.config, self.stacks, **options))

    def cost(self, motions: PartMotions, by: PartMotions | None = None) -> float:
        """Image loss (``explanation_cost``) of what counts under the motions ``by`` (None: under these)."""
        by = motions if by is None else by
        options = {"seen": self.seen(motions), "by": self.seen(by), "backend": self.backend, "device": self.device}
        ask = partial(explanation_cost, self.states, motions, self.views, self.config, self.stacks, **options)
        return ask() if by is not motions else self.losses(motions, ask)

    def saved(self, tried: PartMotions, than: PartMotions) -> float:
        """Logarithm of how much smaller the image loss of ``tried`` is than that of ``than``, on the same pixels: those
        that count under either, averaged.

        Which pixels count depends on the motions: a front that is carried into the body is hidden there, and its
        pixels are no longer asked. By its own pixels each explanation would be judged by the data that it chose.
        """

        def ratio(by: PartMotions) -> float:
            return max(self.cost(than, by), 1e-9) / max(self.cost(tried, by), 1e-9)

        for motions in (tried, than):
            self.seen(motions)  # once, and not in both threads
        return 0.5 * sum(map(math.log, at_once(ratio, (tried, than))))

    def own_share(self, tried: PartMotions, than: PartMotions) -> float:
        """Share of the image loss that ``tried`` saves against ``than`` (-inf..1), each pixel weighted by how far their
        pictures differ there and by how much it counts under either, averaged; 0 where they nowhere differ.

        Of the whole image a small part saves little however right it is; this is alike for parts of any size.
        """

        def one_way(asked: tuple[int, list[Seen]]) -> Tensor:
            s, seen = asked
            ways = [se3.inverse(m.transforms) if s else m.transforms for m in (tried, than)]
            drawn = [torch.where(seen[s].kept, m.labels[s], -1) for m in (tried, than)]
            return image_losses(
                list(zip([of[s].lit for of in both], drawn, ways, strict=True)),
                self.views[1 - s],
                self.config.ssim_lambda,
                seen[1 - s].pixels,
                self.backend,
                self.device,
            )

        both = [self.seen(tried), self.seen(than)]
        lost = torch.stack(at_once(one_way, [(s, seen) for s in (0, 1) for seen in both])).sum(0)
        return float(1 - lost[0] / lost[1]) if float(lost[1]) > 0 else 0.0

    def gain(self, tried: PartMotions, than: PartMotions) -> float:
        """How much lower the energy of ``tried`` is than that of ``than``: what it saved, and what surfaces say."""
        return self.saved(tried, than) + self.surfaces(than) - self.surfaces(tried)

    def surfaces(self, motions: PartMotions) -> float:
        """What the surfaces say (``surface_energy``); nothing without ``found``."""
        if self.found is None:
            return 0.0
        ask = partial(surface_energy, self.found, motions.transforms, motions.types)
        return self.surfaced(motions.transforms, ask, tuple(motions.types))

    def __call__(self, motions: PartMotions) -> tuple[float, float]:
        """Energy and image loss."""
        cost = self.cost(motions)
        return math.log(max(cost, 1e-9)) + self.surfaces(motions), cost

    def sides(self, motions: PartMotions) -> list[Side]:
        """Both directions: the start's Gaussians against the end's photographs, and the reverse, of each what both
        states show."""
        seen, config, sides = self.seen(motions), self.config, []
        for s, (state, stack) in enumerate(zip(self.states, self.stacks, strict=True)):
            labels = torch.where(seen[s].kept, polish_labels(motions, s, config.min_margin), -1)
            ways = seen_from(state.gaussians, stack, config.free_static or 0.02) if config.front > -1 else None
            sides.append(Side(seen[s].lit, labels, self.views[1 - s], s == 1, ways, seen[1 - s].pixels))
        return sides

    def refine(self, motions: PartMotions, axes: Tensor | None = None) -> PartMotions:
        """Refined by the photographs, both directions at once, whether or not the energy falls. axes: as in
        ``polish``."""
        if self.config.steps <= 0 or len(motions) == 0:
            return motions
        options = {"seed": self.seed, "axes": axes, "backend": self.backend, "device": self.device}
        result, _ = polish(self.sides(motions), motions.transforms, motions.types, self.config, **options)
        return replace(motions, transforms=result)

    def single_ways(self, motions: PartMotions) -> dict:
        """Where each direction alone takes refined motions: {"forward", "backward"} [K-1, 4, 4], both start -> end.

        A third of the polish's steps at half its rate. How far the two come apart tells how sure the photographs are.
        """
        config = self.config
        if config.steps <= 0 or len(motions) == 0:
            return {}
        short = replace(config, steps=max(config.steps // 3, 1), rate=config.rate / 2)
        options = {"seed": self.seed, "backend": self.backend, "device": self.device}
        one_way = partial(polish, transforms=motions.transforms, types=motions.types, config=short, **options)
        found = at_once(lambda side: one_way([side]), self.sides(motions))
        return {name: T for name, (T, _) in zip(("forward", "backward"), found, strict=True)}

    def improved(self, motions: PartMotions) -> tuple[float, float, PartMotions]:
        """Energy, image loss and motions: refined where that gains, else as they were. Where a part is plain,
        photographs alone let it drift along itself, and surfaces know better."""
        tried = self.refine(motions)
        best = tried if self.gain(tried, motions) > 0 else motions
        return *self(best), best

    def no_worse(self, before: PartMotions, after: PartMotions) -> PartMotions:
        """``after``, but for the parts that ``before`` explains better: each goes back alone where that gains."""
        for k, kind in enumerate(before.types):
            tried = after.with_motion(k, kind, before.transforms[k])
            if self.gain(tried, after) > 0:
                after = tried
        return after


@dataclass
class Seen:
    """Of a state: its Gaussians as the other state's light has them; which of them [N] nothing contradicts there; the
    weight of its photographs' pixels (None: all count alike)."""

    lit: GaussianTensors
    kept: Tensor
    pixels: ShownPixels | None


def what_counts(
    states, motions: PartMotions, config: PolishConfig, stacks: list[DepthStack], *, backend: str, device="cpu"
) -> list[Seen]:
    """Of both states, under these motions. Pixels count as far as they are not of surface that the other state hides;
    everything does where a tolerance of ``config`` is 0."""

    lit = as_lit_there(states, motions, stacks, config.free_static, config.free_moving)

    def of(s: int) -> Seen:
        g = lit[s].gaussians
        if config.free_static <= 0 or config.free_moving <= 0:
            return Seen(g, torch.ones(len(motions.labels[s]), dtype=torch.bool), None)
        kept, shown = kept_and_shown(states, motions, s, g, stacks, config)
        return Seen(g, kept, ShownPixels(states[s], shown | ~kept, backend, device))

    return at_once(of, (0, 1))
