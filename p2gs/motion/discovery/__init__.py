"""Part and joint discovery from two reconstructed states: free-space evidence, exhaustive rigid hypotheses, joint
selection, labels."""

from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.leftover import left_over
from p2gs.motion.discovery.pipeline import discover
from p2gs.motion.discovery.proposals import (
    as_motions,
    in_rows,
    in_two,
    instead_of,
    places_changed,
    relabel,
    surface_energy,
)
from p2gs.motion.discovery.result import Candidate, Discovery, FoundMotion, Near
from p2gs.motion.discovery.rigid import axes_used
from p2gs.visibility.depth_stack import StateEvidence

__all__ = [
    "Candidate",
    "Discovery",
    "DiscoveryConfig",
    "FoundMotion",
    "Near",
    "StateEvidence",
    "as_motions",
    "axes_used",
    "discover",
    "in_rows",
    "in_two",
    "instead_of",
    "left_over",
    "places_changed",
    "relabel",
    "surface_energy",
]
