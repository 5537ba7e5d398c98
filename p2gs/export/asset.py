"""The twin as links and joints in the target program's conventions: what URDF, MJCF, GLB and USD are written from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Callable, Optional

import numpy as np

from p2gs.export.clearance import clear_links
from p2gs.export.convex import Piece, decompose
from p2gs.export.mesh import read_meshes, write_meshes
from p2gs.export.texture import Texture
from p2gs.export.tsdf import Mesh, vertex_normals
from p2gs.export.twin_json import load_twin
from p2gs.export.unique_rows import unique_rows
from p2gs.models.joint_range import extend_ranges
from p2gs.types import Joint, UserError

DENSITY = 300.0  # kg / m^3 of the convex pieces: chipboard furniture with some air in it
DENSITIES = {  # kg / m^3 of the collision pieces, which fill a shell's hollow walls: solid materials weigh more than parts made of them
    "chipboard": DENSITY,  # default
    "wood": 550.0,  # pine, air-dry
    "plastic": 400.0,  # ABS shells of about a third
    "metal": 900.0,  # sheet steel over foam or air, as appliances are
    "glass": 2500.0,
    "ceramic": 2300.0,
}
LIKELY_SIZE = (0.05, 3.0)  # m, longest side: a stapler to a wardrobe
MAX_FACES = 40_000  # a part's visual mesh; simulators refuse meshes of several hundred thousand
HOLD = 0.02  # friction of a joint, in the weight that hangs on it: holds where the axis leans by a degree, as found axes do
GRAVITY = 9.81  # m / s^2
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


@dataclass(frozen=True)
class Inertia:
    """mass [kg], center of mass [3] and inertia about it [3, 3], in the link's frame."""

    mass: float
    center: np.ndarray
    matrix: np.ndarray


@dataclass(frozen=True)
class Hinge:
    """A joint in SI units of the target. axis [3] unit, origin [3].  lower, upper, motion: radians or metres, 0 = start state.

    damping: N m s / rad or N s / m.  friction: N m or N that holds the joint while it does not move.
    """

    type: str
    axis: np.ndarray
    origin: np.ndarray
    lower: float
    upper: float
    motion: float
    damping: float
    friction: float = 0.0


@dataclass(frozen=True)
class Link:
    """A rigid part at the start state. Geometry is in the link's frame: world axes, origin at the joint's (base: the world's)."""

    name: str
    part: int
    visual: Mesh
    collision: list[Piece]
    inertia: Inertia
    joint: Optional[Hinge]
    colour: tuple[float, float, float]
    texture: Optional[Texture] = None

    @property
    def origin(self) -> np.ndarray:
        return np.zeros(3) if self.joint is None else self.joint.origin


@dataclass(frozen=True)
class Asset:
    """links[0] is the static base.  blocking: (moving link, other link) that run into each other in one of the other's recorded states, as
    a door before a drawer does.  lost: share of a link's collision volume that was trimmed to give joints room, by name."""

    name: str
    links: list[Link]
    up: str
    blocking: list[tuple[str, str]] = field(default_factory=list)
    lost: dict[str, float] = field(default_factory=dict)

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
) -> Asset:
    """Read a run (its meshes are made if they are not there) into the target's conventions.

    scale: metres per input unit.  up: axis of the target that points up; the input's is z.  origin: ``keep`` the input's,
    ``center`` of the object's box, or the middle of its ``bottom``.  solid: with collision pieces and inertia; without, for looking
    at only, it takes no time.  extend_range: joint limits beyond the observed motion, until parts touch.  texture: makes one of a part's id
    and mesh (``texture.Baker``).  Raises UserError for other values or a run without a twin.
    """
    if up not in UPS:
        raise UserError(f"--up is '{up}', expected one of {', '.join(UPS)}")
    if origin not in ORIGINS:
        raise UserError(f"--origin is '{origin}', expected one of {', '.join(ORIGINS)}")
    if not scale > 0:
        raise UserError(f"--scale is {scale:g}, but metres per input unit must be positive")
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    if extend_range:
        obj.parts = extend_ranges(obj)
    meshes = read_meshes(run_dir)
    if meshes is None:
        write_meshes(run_dir)
        meshes = read_meshes(run_dir)
    place = placement(np.concatenate([m.vertices for m in meshes]), scale, up, origin)
    pairs = [(p, m) for p, m in zip(obj.parts, meshes, strict=True) if len(m.faces)]
    if not pairs or pairs[0][0].joint is not None:
        raise UserError(f"{run_dir}: the static part has no surface, so there is no base to hang joints on")
    links = [make_link(part.id, part.joint, mesh, place, density, max_faces, solid, texture) for part, mesh in pairs]
    name = run_dir.resolve().name
    if not solid:
        return Asset(name, links, up)
    cleared = clear_links(links)
    return Asset(name, cleared.links, up, cleared.blocking, cleared.lost)


def start_box(run_dir: Path | str) -> np.ndarray:
    """Lower and upper corner [2, 3] of the whole object in the start state, in input units. The meshes are made if they are not there."""
    meshes = read_meshes(run_dir)
    if meshes is None:
        write_meshes(run_dir)
        meshes = read_meshes(run_dir)
    points = np.concatenate([m.vertices for m in meshes])
    return np.array([points.min(0), points.max(0)])


def unlikely_size(longest: float) -> Optional[str]:
    """A sentence where the longest side [m] is none that household objects have."""
    if LIKELY_SIZE[0] <= longest <= LIKELY_SIZE[1]:
        return None
    return f"the object's longest side comes out as {longest:.3g} m: give metres per unit of the input with --scale, or its --height"


def placement(points: np.ndarray, scale: float, up: str, origin: str) -> Placement:
    """Where the object stands in the target: an even permutation of the axes turns z up into ``up``, so nothing is mirrored."""
    lo, hi = points.min(0), points.max(0)
    where = {"keep": np.zeros(3), "center": (lo + hi) / 2, "bottom": np.array([(lo[0] + hi[0]) / 2, (lo[1] + hi[1]) / 2, lo[2]])}
    # y up as glTF has it: z -> y, y -> -z (the front, -y, looks along +z); x up: the cyclic permutation
    turns = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])}
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
    inertia = inertia_of(pieces, density) if solid else Inertia(0.0, np.zeros(3), np.zeros((3, 3)))
    hinge = None
    if joint is not None:
        axis = place.vector(joint.axis.numpy())
        axis = axis / np.linalg.norm(axis)
        unit = np.pi / 180 if joint.type == "revolute" else place.scale
        lower, upper = sorted(float(v) * unit for v in joint.limits)
        resistance = effective_inertia(inertia, axis) if joint.type == "revolute" else inertia.mass
        friction = joint_friction(inertia, axis, joint.type)
        hinge = Hinge(joint.type, axis, at, lower, upper, float(joint.motion) * unit, resistance / SETTLE, friction)
    name = "base" if joint is None else f"part_{part}"
    colour = tuple(float(c) for c in mesh.colours.mean(0) / 255)
    return Link(name, part, visual, pieces, inertia, hinge, colour, texture(part, world) if texture else None)


def inertia_of(pieces: list[Piece], density: float) -> Inertia:
    """Mass properties of solid convex pieces, taken as disjoint."""
    import trimesh

    props = [trimesh.Trimesh(p.vertices, p.faces, process=False).mass_properties for p in pieces]
    masses = np.array([max(float(p["volume"]), 1e-12) * density for p in props])
    centers = np.array([p["center_mass"] for p in props])
    center = (masses[:, None] * centers).sum(0) / masses.sum()
    total = np.zeros((3, 3))
    for p, m, c in zip(props, masses, centers, strict=True):
        d = c - center
        total += np.asarray(p["inertia"]) * density + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    return Inertia(float(masses.sum()), center, (total + total.T) / 2)


def joint_friction(inertia: Inertia, axis: np.ndarray, kind: str) -> float:
    """``HOLD`` of the part's weight; on a hinge times the distance of its centre of mass from the axis. N or N m."""
    arm = 1.0 if kind == "prismatic" else float(np.linalg.norm(np.cross(axis, inertia.center)))
    return HOLD * GRAVITY * inertia.mass * arm


def effective_inertia(inertia: Inertia, axis: np.ndarray) -> float:
    """About a unit axis through the link's origin, kg m^2."""
    arm = np.cross(axis, inertia.center)
    return float(axis @ inertia.matrix @ axis + inertia.mass * arm @ arm)


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


def simplify(mesh: Mesh, max_faces: int) -> Mesh:
    """At most about ``max_faces`` triangles: vertices of a grid cell become one, its cells as large as need be."""
    if len(mesh.faces) <= max_faces:
        return mesh
    corner = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    cell = np.sqrt(area / max_faces) * 1.2
    while True:
        out = cluster(mesh, cell)
        if len(out.faces) <= max_faces:
            return out
        cell *= 1.15


def cluster(mesh: Mesh, cell: float) -> Mesh:
    """Vertices merged by cubic cell (mean position and colour); triangles that collapse or double go.

    Vertices that look in different directions stay apart, so that the two sides of a thin wall do not become one.
    """
    normal = vertex_normals(mesh.vertices, mesh.faces)
    rows = np.arange(len(normal))
    side = np.abs(normal).argmax(1)
    side = 2 * side + (normal[rows, side] > 0)
    key = np.c_[np.floor((mesh.vertices - mesh.vertices.min(0)) / cell).astype(np.int64), side]
    _, label = unique_rows(key)
    count = np.bincount(label).astype(float)
    vertices = np.stack([np.bincount(label, mesh.vertices[:, i]) for i in range(3)], 1) / count[:, None]
    colours = np.stack([np.bincount(label, mesh.colours[:, i].astype(float)) for i in range(3)], 1) / count[:, None]
    faces = label[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    faces = faces[unique_rows(np.sort(faces, 1))[0]]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], renumbered.reshape(-1, 3), colours[used].round().astype(np.uint8))
