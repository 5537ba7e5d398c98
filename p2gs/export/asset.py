"""The twin as links and joints in the target program's conventions: what URDF, MJCF, GLB and USD are written from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Callable, Optional

import numpy as np
import torch

from p2gs.export.links import Hinge, Link
from p2gs.export.physics.clearance import clear_links
from p2gs.export.physics.convex import decompose
from p2gs.export.physics.inertia import Inertia, effective_inertia, enclosed, inertia_of, joint_load
from p2gs.export.physics.reach import extend_links
from p2gs.gaussians.pose import pose
from p2gs.gaussians.twin_json import load_twin
from p2gs.ops.mesh import Mesh
from p2gs.ops.sh import rotate_sh
from p2gs.ops.so3 import matrix_to_quat, quat_multiply
from p2gs.surface.mesh import read_meshes, write_meshes
from p2gs.surface.simplify import simplify
from p2gs.surface.texture import Texture
from p2gs.types import GaussianTensors, Joint, UserError

DENSITY = 300.0  # kg / m^3 of the convex pieces: chipboard furniture with some air in it
# kg / m^3 of the collision pieces, which fill a shell's hollow walls: solid materials weigh more than parts made of
# them
DENSITIES = {
    "chipboard": DENSITY,  # default
    "wood": 550.0,  # pine, air-dry
    "plastic": 400.0,  # ABS shells of about a third
    "metal": 900.0,  # sheet steel over foam or air, as appliances are
    "glass": 2500.0,
    "ceramic": 2300.0,
}
MAX_FACES = 40_000  # a part's visual mesh; simulators refuse meshes of several hundred thousand
SETTLE = 0.5  # seconds in which an undriven joint loses most of its speed; sets the default damping
UPS = ("z", "y", "x")
ORIGINS = ("keep", "center", "bottom")


@dataclass(frozen=True)
class Placement:
    """x_target = scale * rotation @ (x_input - origin). rotation [3, 3], origin [3]."""

    scale: float
    rotation: np.ndarray
    origin: np.ndarray

    def points(self, x: np.ndarray) -> np.ndarray:
        return self.scale * (np.asarray(x, dtype=np.float64) - self.origin) @ self.rotation.T

    def vector(self, v: np.ndarray) -> np.ndarray:
        return np.asarray(v, dtype=np.float64) @ self.rotation.T

    def gaussians(self, g: GaussianTensors, at: np.ndarray) -> GaussianTensors:
        """Gaussians with their centres relative to ``at`` [3] of the target."""
        R = torch.from_numpy(self.rotation)
        means = torch.from_numpy(self.points(g.means.double().numpy()) - at).float()
        quats = quat_multiply(matrix_to_quat(R).expand(len(g), 4), g.quats.double()).float()
        sh = rotate_sh(g.sh, R.to(g.sh)) if g.sh.shape[1] > 1 else g.sh
        return GaussianTensors(means, quats, g.log_scales + math.log(self.scale), g.opacity_logits, sh)


@dataclass(frozen=True)
class Asset:
    """links[0] is the static base (``Link.bare`` where nothing stands still). blocking: (moving link, other link) that
    run into each other in one of the other's recorded states, as a door before a drawer does. lost: share of a link's
    collision volume that was trimmed to give joints room, by name. fixed: whether the base stands fast in the world or
    may fall over; None: as each format has it. material: one of ``DENSITIES``."""

    name: str
    links: list[Link]
    up: str
    blocking: list[tuple[str, str]] = field(default_factory=list)
    lost: dict[str, float] = field(default_factory=dict)
    fixed: Optional[bool] = None
    material: str = "chipboard"

    @property
    def moving(self) -> list[Link]:
        return [link for link in self.links if link.joint is not None]


def load_asset(
    run_dir: Path | str,
    scale: float = 1.0,
    up: str = "z",
    origin: str = "keep",
    density: float = DENSITY,
    max_faces: int = MAX_FACES,
    solid: bool = True,
    extend_range: bool = False,
    texture: Optional[Callable[[int, Mesh], Texture]] = None,
    splats: bool = False,
) -> Asset:
    """Read a run (its meshes are made if they are not there) into the target's conventions.

    scale: metres per input unit.  up: axis of the target that points up; the input's is z.  origin: ``keep`` the
    input's, ``center`` of the object's box, or the middle of its ``bottom``.  solid: with collision pieces and inertia;
    without, for looking at only, it takes no time.  A moving part without a surface is left out, a base without one is
    bare.  extend_range: joint limits beyond the observed motion, until pieces touch (only where solid).  texture: makes
    one of a part's id and mesh (``texture.Baker``).  splats: with each part's Gaussians.  Raises UserError for other
    values, a run without a twin or one of which no part has a surface.
    """
    if up not in UPS:
        raise UserError(f"--up is '{up}', expected one of {', '.join(UPS)}")
    if origin not in ORIGINS:
        raise UserError(f"--origin is '{origin}', expected one of {', '.join(ORIGINS)}")
    if not scale > 0:
        raise UserError(f"--scale is {scale:g}, but metres per input unit must be positive")
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    meshes = read_meshes(run_dir)
    if meshes is None:
        write_meshes(run_dir)
        meshes = read_meshes(run_dir)
    place = placement(shown_points(run_dir, meshes), scale, up, origin)
    links = [
        make_link(part.id, part.joint, mesh, place, density, max_faces, solid, texture)
        if len(mesh.faces)
        else bare_base(part.id)
        for part, mesh in zip(obj.parts, meshes, strict=True)
        if len(mesh.faces) or part.joint is None
    ]
    if splats:
        start = pose(obj, 0.0)
        links = [replace(x, splats=place.gaussians(start[obj.part_ids == x.part], x.origin)) for x in links]
    name = run_dir.resolve().name
    if not solid:
        return Asset(name, links, up)
    cleared = clear_links(links)
    return Asset(
        name, extend_links(cleared.links) if extend_range else cleared.links, up, cleared.blocking, cleared.lost
    )


def start_box(run_dir: Path | str) -> np.ndarray:
    """Lower and upper corner [2, 3] of the whole object in the start state, in input units. The meshes are made if they
    are not there."""
    meshes = read_meshes(run_dir)
    if meshes is None:
        write_meshes(run_dir)
        meshes = read_meshes(run_dir)
    points = shown_points(run_dir, meshes)
    return np.array([points.min(0), points.max(0)])


def shown_points(run_dir: Path | str, meshes: list[Mesh]) -> np.ndarray:
    """Vertices [V, 3] of all parts. Raises UserError where there is no surface at all."""
    if not any(len(m.faces) for m in meshes):
        raise UserError(f"{run_dir}: no part of the twin has a surface, so there is nothing to export")
    return np.concatenate([m.vertices for m in meshes])


def placement(points: np.ndarray, scale: float, up: str, origin: str) -> Placement:
    """Where the object of points [N, 3] stands in the target: an even permutation of the axes turns z up into ``up``,
    so nothing is mirrored."""
    lo, hi = points.min(0), points.max(0)
    where = {
        "keep": np.zeros(3),
        "center": (lo + hi) / 2,
        "bottom": np.array([(lo[0] + hi[0]) / 2, (lo[1] + hi[1]) / 2, lo[2]]),
    }
    # y up as glTF has it: z -> y, y -> -z (the front, -y, looks along +z); x up: the cyclic permutation
    turns = {
        "z": np.eye(3),
        "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    }
    return Placement(float(scale), turns[up], where[origin])


def make_link(
    part: int,
    joint: Optional[Joint],
    mesh: Mesh,
    place: Placement,
    density: float,
    max_faces: int,
    solid: bool,
    texture: Optional[Callable[[int, Mesh], Texture]] = None,
) -> Link:
    """One part with its collision pieces, inertia, joint and texture."""
    at = np.zeros(3) if joint is None else place.points(joint.origin.numpy())
    world = simplify(mesh, max_faces)
    visual = Mesh(place.points(world.vertices) - at, world.faces, world.colours)
    pieces = decompose(place.points(mesh.vertices) - at) if solid else []
    inertia, closed = Inertia(0.0, np.zeros(3), np.zeros((3, 3))), True
    if solid:
        inside = enclosed(place.points(mesh.vertices) - at, mesh.faces)
        inertia, closed = inertia_of(pieces if inside is None else [inside], density), inside is not None
    hinge = None
    if joint is not None:
        axis = place.vector(joint.axis.numpy())
        axis = axis / np.linalg.norm(axis)
        unit = np.pi / 180 if joint.type == "revolute" else place.scale
        lower, upper = sorted(float(v) * unit for v in joint.limits)
        resistance = effective_inertia(inertia, axis) if joint.type == "revolute" else inertia.mass
        load = joint_load(inertia, axis, joint.type)
        hinge = Hinge(joint.type, axis, at, lower, upper, float(joint.motion) * unit, resistance / SETTLE, load)
    name = "base" if joint is None else f"part_{part}"
    colour = tuple(float(c) for c in mesh.colours.mean(0) / 255)
    return Link(
        name, part, visual, pieces, inertia, hinge, colour, texture(part, world) if texture else None, closed=closed
    )


def bare_base(part: int) -> Link:
    """The base of an object of which nothing stands still: no surface, no collision pieces, no mass."""
    nothing = Inertia(0.0, np.zeros(3), np.zeros((3, 3)))
    return Link("base", part, Mesh.empty(), [], nothing, None, (0.0, 0.0, 0.0))


def open_note(asset: Asset) -> Optional[str]:
    """A sentence where surfaces enclose no volume, so that masses are guesses by the collision pieces."""
    names = [link.name for link in asset.links if not link.closed]
    if not names:
        return None
    return (
        f"the mesh of {', '.join(names)} is open where no photograph looked: mass and inertia go by the collision "
        "pieces, not by volume"
    )
