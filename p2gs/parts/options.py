"""Options of part discovery."""

from __future__ import annotations

from dataclasses import dataclass, field

from p2gs.motion.discovery import DiscoveryConfig
from p2gs.motion.screw_polish import PolishConfig


@dataclass
class PartMotionsConfig:
    """Options of part discovery.

    evidence_size: long edge of the rendered depth maps, pixels.  min_opacity: fainter Gaussians are no surface points.
    candidates: how many complete explanations, and later changes of one kind, are compared by re-rendering; of more
    explanations those that look best at a glance, after ``look_steps`` of refinement at the smallest size.
    coarse: photometric refinement right after discovery.
    compare_types_below: a part that turns by less than this (degrees) is refined as a slide as well, and the images
    decide; freedom_penalty: relative image loss by which a turn must win against a slide.
    same_motion: two touching parts whose motions carry them this near to each other (internal units) are tried as one.
    survey: shifts within its own surface tried for each part (internal units; [] = none).
    part_penalty: share of the image loss in its own pixels that each part with an axis of its own must save, or goes,
    and that one which is added or halved must save when parts are reconsidered (``Judge.own_share``).
    islands: pieces of a part smaller than this share of its largest piece, and apart from it, go to the part whose
    surface they touch (0 = off).  rounds: how often labels, types and motions are settled anew.
    reconsider: each part's motion, one more, two parts with their ends exchanged, and each part as two are searched
    again amid the others, refined, and taken where the energy falls.
    seek: surface that no motion explains is then searched by itself for further parts, however small; share of the
    image loss in its own pixels that such a part must save (0: none is sought). False ones saved up to 0.27, latches
    of a hundredth of the moved surface 0.38.
    askew: share of the image loss that an axis must save which is askew to the directions that the object has, against
    one along them (0: axes stay), or part_penalty in its own pixels where it is far from them.
    """

    evidence_size: int = 200
    min_opacity: float = 0.5
    candidates: int = 3
    look_steps: int = 40
    compare_types_below: float = 45.0
    freedom_penalty: float = 0.002
    same_motion: float = 0.04
    part_penalty: float = 0.15
    survey: list[float] = field(default_factory=lambda: [0.03, 0.06, 0.09])
    islands: float = 0.25
    rounds: int = 2
    reconsider: bool = True
    seek: float = 0.3
    askew: float = 0.01
    search: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    coarse: PolishConfig = field(default_factory=lambda: PolishConfig(steps=150, levels=[100, 200], rate=1e-2))
