"""Options of the articulation phase."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from p2gs.models.single_state import ImageConfig, SplatRates


@dataclass
class RepelConfig:
    """Repel points (paper section 4.3, appendix). count: N_R.  threshold: how near to the static base a movable part
    must be, by ``threshold_mode`` ("relative" to the box diagonal, "absolute", or in "spacing"s).  noise: length of an
    offset at their first placement, relative to the diagonal. The callback ``repel`` places them anew, without noise
    (the dynamic variant).
    render: their force, as the loss ``art`` has it, moves the Gaussians in what training draws (paper appendix, "Part
    Assignment Details"), never in what is predicted or handed over."""

    count: int = 2000
    threshold: float = 0.05
    threshold_mode: Literal["relative", "absolute", "spacing"] = "relative"
    noise: float = 0.0
    render: bool = False


@dataclass
class ArticulationConfig(ImageConfig):
    """Options of the articulation phase.

    init: "discovery" starts psi, f and xi from the discovered parts; "identity" and "random" (the paper's own) learn
    from nothing.
    psi: "init" begins as ``init`` says; "random" begins psi at random wherever the screws come from: nothing of the
    discovered labels is used.  embedding_dim: of psi.  temperature .. temperature_end: softmax temperature, falling
    geometrically until ``harden_until`` (fraction of the phase); the paper's letter is 1 throughout.  rate_screws:
    paper 1e-3.  screws_from: fraction of the phase at which screws begin to learn.  neighbours, refresh: k of the
    neighbourhood KL, and steps between kNN and pair refreshes.
    pair_target: "matched" holds the pairs of the fusion; "nearest" renews the observed centres by nearest neighbours in
    each state from ``nearest_from`` (fraction) on.
    """

    steps: int = 1000
    levels: list[int] = field(default_factory=lambda: [400])
    level_starts: list[float] = field(default_factory=lambda: [0.0])
    init: Literal["discovery", "identity", "random"] = "discovery"
    psi: Literal["init", "random"] = "init"
    embedding_dim: int = 16
    sureness: float = 4.0
    temperature: float = 1.0
    temperature_end: float = 0.1
    harden_until: float = 0.6
    rates: SplatRates = field(default_factory=lambda: SplatRates(1e-4, 4e-6, 1.5e-3, 2e-2, 6e-4, 2e-3, 2e-4))
    rate_embedding: float = 2.5e-2
    rate_classifier: float = 5e-4
    rate_screws: float = 1e-4
    rate_screws_end: float = 1e-6
    screws_from: float = 0.0
    neighbours: int = 5
    refresh: int = 100
    pair_target: Literal["matched", "nearest"] = "nearest"
    nearest_from: float = 0.2
    repel: RepelConfig = field(default_factory=RepelConfig)
