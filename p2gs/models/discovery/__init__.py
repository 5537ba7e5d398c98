"""Part and joint discovery from two reconstructed states: free-space evidence, exhaustive rigid hypotheses, joint selection, labels."""

from p2gs.models.discovery.config import DiscoveryConfig
from p2gs.models.discovery.evidence import StateEvidence
from p2gs.models.discovery.pipeline import discover, in_two, instead_of, places_changed, relabel, surface_energy
from p2gs.models.discovery.result import Candidate, Discovery, FoundMotion

__all__ = [
    "Candidate", "Discovery", "DiscoveryConfig", "FoundMotion", "StateEvidence", "discover", "in_two", "instead_of", "places_changed",
    "relabel", "surface_energy",
]  # fmt: skip
