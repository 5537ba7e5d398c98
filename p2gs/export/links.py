"""A twin's parts as links and hinges: what placement, clearance, limits and every format are about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np

from p2gs.export.physics.convex import Piece
from p2gs.export.physics.inertia import Inertia
from p2gs.ops.mesh import Mesh
from p2gs.surface.texture import Texture
from p2gs.types import GaussianTensors

# friction of a joint, in the weight that hangs on it: holds where the axis leans by a degree, as found axes do
HOLD = 0.02
# effort limit of a joint in the weight that hangs on it: a hand or a motor that opens it has that much to spare
LIFT = 3.0
QUICK = 0.25  # seconds in which a joint may run through its range: a door that is thrown shut; sets the velocity limit


@dataclass(frozen=True)
class Hinge:
    """A joint in SI units of the target. axis [3] unit, origin [3].  lower, upper, motion: radians or metres, 0 = start
    state.

    damping: N m s / rad or N s / m.  load: N m or N, of the part's weight where it pulls most.
    """

    type: str
    axis: np.ndarray
    origin: np.ndarray
    lower: float
    upper: float
    motion: float
    damping: float
    load: float = 0.0

    @property
    def friction(self) -> float:
        """N m or N that holds the joint while it does not move."""
        return HOLD * self.load

    @property
    def velocity(self) -> float:
        """Limit, rad/s or m/s."""
        return max(self.upper - self.lower, 1e-3) / QUICK

    @property
    def effort(self) -> float:
        """Limit, N m or N: lifts the part, and drives it against its damping at the highest speed."""
        return LIFT * self.load + self.damping * self.velocity


@dataclass(frozen=True)
class Link:
    """A rigid part at the start state. Geometry is in the link's frame: world axes, origin at the joint's (base: the
    world's). A base of which nothing was seen is ``bare``: the place in the world that joints hang on."""

    name: str
    part: int
    visual: Mesh
    collision: list[Piece]
    inertia: Inertia
    joint: Optional[Hinge]
    colour: tuple[float, float, float]
    texture: Optional[Texture] = None
    label: str = ""  # what it is, of ``naming``: door, drawer; empty where names are those of the twin
    closed: bool = True  # whether the surface encloses a volume
    splats: Optional[GaussianTensors] = None  # the part's Gaussians, in the link's frame like the rest

    @property
    def bare(self) -> bool:
        """Whether it shows no surface; it has no collision pieces and no mass then."""
        return not len(self.visual.faces)

    @property
    def hinge(self) -> Hinge:
        """The joint of a link that moves. Raises ValueError for the base."""
        if self.joint is None:
            raise ValueError(f"the link '{self.name}' has no joint")
        return self.joint

    @property
    def origin(self) -> np.ndarray:
        return np.zeros(3) if self.joint is None else self.joint.origin


def joint_motion(hinge: Hinge, value: float) -> np.ndarray:
    """World motion [4, 4] of a link whose joint moved by ``value`` from the start state."""
    T = np.eye(4)
    if hinge.type == "prismatic":
        T[:3, 3] = hinge.axis * value
        return T
    x, y, z = hinge.axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T[:3, :3] += np.sin(value) * K + (1 - np.cos(value)) * K @ K
    T[:3, 3] = hinge.origin - T[:3, :3] @ hinge.origin
    return T
