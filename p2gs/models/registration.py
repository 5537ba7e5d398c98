"""Where the end state stands against the start, and how much darker its photographs are: one rigid motion and one gain.

Two reconstructions of one object are as far apart as the cameras of the two captures are; discovery would take that for
motion, and joints would have it in them. The motion with the widest support near the identity is the base's
(``surface_fit``); photographs refine it (``photo_fit``), and photographs held out of that decide whether it is applied.
The same for the gain. Clean states stay as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.data.exposure import median_gain
from p2gs.data.views import TargetImage, TrainingViews
from p2gs.gaussians.handover import Registration, StateGaussians
from p2gs.models.registered import REGISTRATION, dimmed, register_state, register_views, write_registration
from p2gs.models.stage import Stage, register_phase
from p2gs.models.trial import Trial, held_out, trial
from p2gs.motion.on_grey import photograph
from p2gs.motion.photo_fit import COLOUR, STRUCTURE, PhotoSide, compare, fit_photographs, unmoved
from p2gs.motion.surface_fit import fit_surfaces
from p2gs.ops import se3, so3
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack, StateEvidence
from p2gs.visibility.evidence import evidence_of
from p2gs.visibility.surfels import build_surfels

NOTHING = Trial(0.0, 0.0, 0.0, 0.0, 0)  # nothing was tried
NOISE = 2e-4  # least noise of surfels, of the box's diagonal: discovery's


@dataclass
class RegistrationConfig:
    """Options of the states' registration. Lengths are shares of the box's diagonal.

    motion, gain: "auto" (held-out photographs decide) or "never".  reach: distance up to which unmoved surfaces are
    looked for; states brought together by hand are off by about a hundredth. An object that moved farther as one is a
    part that has no base.  levels: sizes of the photographs that refine it, pixels.  surfels: at most so many a state.
    least: share by which held-out errors must fall.  least_shift: a motion that moves surfaces by less is not applied:
    a tenth of a pixel of the finest photographs.
    """

    motion: Literal["auto", "never"] = "auto"
    gain: Literal["auto", "never"] = "auto"
    reach: float = 0.03
    levels: list[int] = field(default_factory=lambda: [200, 400])
    surfels: int = 12000
    least: float = 0.02
    least_shift: float = 3e-4


def align_states(
    states: list[StateGaussians],
    evidence: list[StateEvidence],
    views: dict[int, TrainingViews],
    box: Tensor,
    config: RegistrationConfig,
    backend: str = "auto",
    device: torch.device | str = "cpu",
    report=None,
) -> Registration:
    """The end's motion into the start's frame and its gain, each none where it is not wanted or held-out photographs
    are no better with it.

    evidence: of both states, as discovery looks at them.  box: the object's, [2, 3].  All in internal coordinates.
    """
    say = report or (lambda text: None)
    still, dark = torch.eye(4, dtype=torch.float64), torch.zeros(3)
    if config.motion == "never" and config.gain == "never":
        return Registration(still, dark)
    if any(len(e.points) < 10 or not any(bool((d > 0).any()) for d in e.depths) for e in evidence):
        return Registration(still, dark)  # nothing opaque: discovery says so
    diagonal = float((box[1] - box[0]).norm())
    surfels = [
        build_surfels(e, DepthStack(e.depths, e.alphas, e.cameras), diagonal, config.surfels, NOISE)[0]
        for e in evidence
    ]
    found = fit_surfaces(surfels[1], surfels[0], config.reach * diagonal)
    T = found.transform if config.motion == "auto" else still
    tolerance = 4 * (surfels[0].noise ** 2 + surfels[1].noise ** 2) ** 0.5 + 2e-3 * diagonal
    start, end = (s.gaussians.to(device) for s in states)
    pair = Pair(start, end, views, tolerance, backend)
    held = [held_out(len(views[s])) for s in (1, 0)]
    fitted, judged = [h[0] for h in held], [h[1] for h in held]
    gain = pair.end_gain(T, fitted[0], config.levels[0]) if config.gain == "auto" else dark
    moved = NOTHING
    for size in config.levels if config.motion == "auto" else ():
        T = fit_photographs(pair.sides(gain), T, [p[::2] for p in fitted], size, backend=backend)
        moved = pair.tried(judged, size, still, T, gain)
        if not moved.passed(config.least):
            break  # states that lie on one another need no finer look
    points = surfels[1].points.double()
    shift = float((se3.apply(T, points) - points).norm(dim=1).square().mean().sqrt()) / diagonal
    why_not = pair.objection(judged, config, T, gain, shift) if moved.passed(config.least) else ""
    apply_motion = moved.passed(config.least) and shift > config.least_shift and not why_not
    best = T if apply_motion else still
    shots = pair.judges(judged, config.levels[-1], best)
    dimmer = trial(pair.errors(shots, best, dark, COLOUR), pair.errors(shots, best, gain, COLOUR))
    apply_gain = config.gain == "auto" and dimmer.passed(config.least)
    figures = {
        "share": found.share,
        "spread": found.spread / diagonal,
        "rms": found.rms / diagonal,
        "shift": shift,
        "angle": float(torch.rad2deg(so3.rotation_angle(T[:3, :3]))),
        "log_gain": gain.tolist(),
        "motion": {"applied": apply_motion, **vars(moved)},
        "gain": {"applied": apply_gain, **vars(dimmer)},
    }
    for line in _told(figures, moved, dimmer, why_not):
        say(line)
    return Registration(best, gain if apply_gain else dark, figures)


def _told(figures: dict, moved: Trial, dimmer: Trial, why_not: str) -> list[str]:
    """The two decisions for the user."""
    applied = {k: "applied" if figures[k]["applied"] else "not applied" for k in ("motion", "gain")}
    beside = (
        f"{100 * figures['shift']:.3f} % of the object and {figures['angle']:.3f} degrees beside the start, by "
        f"{100 * figures['share']:.0f} % of its surface"
    )
    factors = ", ".join(f"{math.exp(g):.3f}" for g in figures["log_gain"])
    return [
        f"the end lies {beside}; {moved.told()}: {applied['motion']}{why_not}",
        f"the end's red, green and blue are {factors} times the start's; {dimmer.told()}: {applied['gain']}",
    ]


@dataclass
class Pair:
    """Both states' Gaussians and photographs.  tolerance: of depths of one surface, internal units."""

    start: GaussianTensors
    end: GaussianTensors
    views: dict[int, TrainingViews]
    tolerance: float
    backend: str

    def sides(self, gain: Tensor) -> list[PhotoSide]:
        """The start's Gaussians in the end's photographs, as bright as those, and the reverse."""
        return [
            PhotoSide(dimmed(self.start, gain), self.end, self.views[1], True),
            PhotoSide(dimmed(self.end, -gain), self.start, self.views[0], False),
        ]

    @torch.no_grad()
    def end_gain(self, transform: Tensor, picks: list[int], size: int) -> Tensor:
        """Logarithm [3] of how much brighter the end's photographs are than the start's Gaussians where nothing moved:
        their median."""
        side, found = self.sides(torch.zeros(3))[0], []
        for index in picks:
            shot = photograph(self.views[1], index, size, self.start.means.device)
            weight = unmoved(side, shot.camera, transform, self.tolerance, self.backend)
            drawn = side.draw(shot.camera, transform, self.backend)
            gain = median_gain(shot.image, drawn.colour, (weight > 0) & (shot.alpha > 0.99) & (drawn.alpha > 0.99))
            found += [] if gain is None else [gain.cpu()]
        return torch.stack(found).median(0).values if found else torch.zeros(3)

    def tried(self, picks: list[list[int]], size: int, without: Tensor, with_it: Tensor, gain: Tensor) -> Trial:
        """One motion in place of another, by the held-out pixels where nothing moved by the new one."""
        shots = self.judges(picks, size, with_it)
        return trial(*(self.errors(shots, T, gain, STRUCTURE) for T in (without, with_it)))

    def objection(
        self, picks: list[list[int]], config: RegistrationConfig, transform: Tensor, gain: Tensor, shift: float
    ) -> str:
        """Why a motion that held-out photographs are better with is none of frames, for the user; nothing if it is.
        shift: share of the diagonal by which it moves surfaces."""
        if shift > config.reach:
            return f", as that is more than {100 * config.reach:.0f} %: what moved that far is taken for a part"
        # a lid that was lifted lies on itself if the pot fell, too: then the pot's own photographs are worse
        without = self.tried(picks, config.levels[-1], transform, torch.eye(4, dtype=torch.float64), gain)
        told = f", as what stands still without it would be worse ({without.told()})"
        return told if without.passed(config.least) else ""

    def judges(self, picks: list[list[int]], size: int, transform: Tensor) -> list[tuple[int, TargetImage, Tensor]]:
        """Held-out photographs of the end and of the start: the side, the picture, and where nothing moved by
        ``transform``."""
        out = []
        for turn, side in enumerate(self.sides(torch.zeros(3))):
            for index in picks[turn]:
                shot = photograph(side.views, index, size, self.start.means.device)
                out.append((turn, shot, unmoved(side, shot.camera, transform, self.tolerance, self.backend)))
        return out

    @torch.no_grad()
    def errors(self, shots, transform: Tensor, gain: Tensor, ssim_lambda: float) -> Tensor:
        """Image loss [N] of ``judges`` under a motion and a gain."""
        sides = self.sides(gain)
        return torch.stack(
            [compare(sides[k], shot, weight, transform, self.backend, ssim_lambda) for k, shot, weight in shots]
        ).cpu()


@register_phase("registration")
class RegistrationStage(Stage):
    """A phase without training: no losses, no callbacks."""

    Config = RegistrationConfig
    needs = ("states",)
    gives = "states"
    num_parts_matters = False
    changes_scene = True

    @classmethod
    def compute(cls, run: RunContext, section, *, states: list[StateGaussians]) -> Registration:
        say = partial(run.log, cls.phase_name)
        assert run.scene.box is not None  # every scene that is trained on has one
        options = {"backend": run.rasterizer, "device": run.device, "report": say}
        return align_states(states, evidence_of(run, states), run.views, run.scene.box, section.config, **options)

    @classmethod
    def hand_on(cls, run: RunContext, value: Registration, *, states: list[StateGaussians]) -> dict:
        """The states in the start's frame; so are scene and views from here on."""
        write_registration(run.run_dir / REGISTRATION, value, states, run.scene_as_read)
        run.take(register_views(run.scene, value))
        return {cls.gives: [register_state(s, value) for s in states], "registration": value}
