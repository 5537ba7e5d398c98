"""Procedural surface colours of generated objects, functions of the position in the primitive's own coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

Pattern = Literal["noise", "wood", "stripes", "checks", "speckle"]
PATTERNS: tuple[Pattern, ...] = ("noise", "wood", "stripes", "checks", "speckle")


@dataclass(frozen=True)
class Texture:
    """colour, second: RGB in 0..1, mixed by the pattern.  period: length of one repetition, scene units.  seed: of its
    phases."""

    pattern: Pattern
    colour: tuple[float, float, float]
    second: tuple[float, float, float]
    period: float = 0.2
    seed: int = 0

    def scaled(self, scale: float) -> "Texture":
        return replace(self, period=self.period * scale)

    def at(self, p: np.ndarray) -> np.ndarray:
        """[N, 3] float32 colours at local points p [N, 3] float32."""
        mix = np.clip(self._mix(p / np.float32(self.period)), 0, 1)[:, None]
        a, b = np.array([self.colour, self.second], dtype=np.float32)
        return a + mix * (b - a)

    def _mix(self, p: np.ndarray) -> np.ndarray:
        waves = self._waves(p)
        if self.pattern == "noise":
            return 0.5 + 0.5 * waves
        if self.pattern == "wood":  # stretched along local z, warped growth rings
            return 0.5 + 0.5 * np.sin(2 * np.pi * (p[:, 0] + p[:, 1] + 0.15 * p[:, 2]) + 2.5 * waves)
        if self.pattern == "stripes":
            return 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * (p[:, 1] + p[:, 2])) + waves)
        if self.pattern == "checks":
            s = np.sin(2 * np.pi * p + 0.5)
            return 0.5 + 0.5 * np.tanh(6 * s[:, 0] * s[:, 1] * s[:, 2] * 1.5 + 0.8 * waves)
        return 1 / (1 + np.exp(-6 * (self._waves(3 * p) + 0.5 * waves - 0.7)))  # speckle: dark ground, few bright spots

    def _waves(self, p: np.ndarray) -> np.ndarray:
        """A smooth random field in about -1..1: sines along random directions (a cheap stand-in for lattice noise)."""
        rng = np.random.default_rng(self.seed)
        directions = rng.normal(size=(3, 6))
        directions *= np.geomspace(0.5, 2.5, 6) / np.linalg.norm(directions, axis=0)
        phases = rng.uniform(0, 2 * np.pi, 6)
        weights = np.geomspace(1, 0.45, 6)
        angles = p @ np.float32(2 * np.pi * directions) + np.float32(phases)
        return np.sin(angles) @ np.float32(weights / weights.sum() * 1.8)
