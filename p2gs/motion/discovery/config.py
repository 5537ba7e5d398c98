"""Thresholds of part discovery. Lengths are relative to what is measured on the input: noise, point spacing, box
diagonal."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class DiscoveryConfig:
    """What to look for and when to stop.

    surfels: about how many surface points a state.  samples: moved points a state used while searching.
    max_parts: upper bound (static included) when the number of parts is "auto".
    noise_floor: least depth noise assumed, times the box diagonal.
    tolerance: depth tolerance of the free-space test, times the measured noise.
    recoloured: a surface that is in place in the other state but differs by this in colour (0..1) has changed there.
    unexplained: cost of a moved point that no motion explains (0.35 is hiding in unseen space, 1 is hanging in free
    space).
    part_cost: least drop of the mean cost over the moved surface for which a further part is believed.
    min_angle, max_angle: degrees searched.  max_slide: times the box diagonal.
    attach: weight of the rule that a hinge touches the part it carries.
    slide_bonus: a slide has two degrees of freedom less than a turn: share of a part's gain in its favour.
    thickest: greatest thickness of a plate of which the states may show different sides, times the box diagonal.
    min_mass: least share of the moved surface of a part.  min_moved: fewest moved surfels a state below which nothing
    moved.
    searches: how often the set is searched, each time among other samples.  candidates: best sets of each that are
    looked into.
    """

    surfels: int = 12000
    samples: int = 500
    max_parts: int = 10
    noise_floor: float = 0.001
    tolerance: float = 2.5
    recoloured: float = 0.2
    unexplained: float = 0.45
    part_cost: float = 0.03
    min_angle: float = 5.0
    max_angle: float = 135.0
    max_slide: float = 0.42
    attach: float = 0.8
    slide_bonus: float = 0.1
    thickest: float = 0.04
    min_mass: float = 0.015
    min_moved: int = 12
    searches: int = 2
    candidates: int = 4
