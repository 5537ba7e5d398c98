"""What a part is called: drawer, door, lid, flap, knob, button or wheel, by its joint's type and axis and its shape, or
as the user says.

The up axis is taken at its word. Where a capture's up is not gravity's, a lid may come out as a flap; ``--name
part_1=lid`` says it better.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Iterable, Mapping, Optional

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.links import Link, joint_motion
from p2gs.types import UserError

LABELS = ("drawer", "door", "lid", "flap", "knob", "button", "wheel")  # that geometry tells; a user's may be any
BODY = "body"  # label of the static part
ALONG = 0.7  # |cos| above which a direction counts as along another: 45 degrees
# distance of the centre of area from the axis, in the part's radius about it, below which it turns about its middle
CENTRED = 0.25
SMALL = 0.2  # share of the object's diagonal below which a part is for the fingers: a knob, a button
FLAT = 0.35  # thickness in the second of the three sides below which a part is a panel
WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")  # what URDF, MJCF and USD all take for a name


@dataclass(frozen=True)
class Shape:
    """Area-weighted: centre [3]; principal directions [3, 3] as rows, longest side first, and the sides' lengths
    [3]."""

    centre: np.ndarray
    axes: np.ndarray
    sides: np.ndarray


def shape_of(points: np.ndarray, weights: np.ndarray) -> Shape:
    """Of points [N, 3] with weights [N]."""
    centre = np.average(points, axis=0, weights=weights)
    local = points - centre
    axes = np.linalg.eigh((local * weights[:, None]).T @ local)[1].T
    sides = np.ptp(local @ axes.T, axis=0)
    order = np.argsort(-sides)
    return Shape(centre, axes[order], sides[order])


def surface_points(link: Link) -> tuple[np.ndarray, np.ndarray]:
    """Centres [F, 3] of what a link shows, in world axes at the start, and their areas [F]."""
    corners = link.visual.vertices[link.visual.faces] + link.origin
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners.mean(1), np.maximum(area, 1e-300)


def shut_motion(link: Link, rest: np.ndarray) -> np.ndarray:
    """Motion [4, 4] from the start to the recorded state in which the part and the rest [N, 3] fill the smaller box:
    the shut one."""
    points = surface_points(link)[0]

    def room(T: np.ndarray) -> float:
        both = np.concatenate([points @ T[:3, :3].T + T[:3, 3], rest])
        return float(np.ptp(both, axis=0).prod())

    start, end = np.eye(4), joint_motion(link.hinge, link.hinge.motion)
    return start if room(start) <= room(end) else end


def label_of(link: Link, base: Link, up: np.ndarray) -> str:
    """One of ``LABELS`` for a moving part, or ``part`` where it looks like none of them. up: unit [3]."""
    points, area = surface_points(link)
    rest = surface_points(base)[0]
    shape = shape_of(points, area)
    diagonal = float(np.linalg.norm(np.ptp(np.concatenate([points, rest]), axis=0)))
    small = shape.sides[0] < SMALL * diagonal
    axis = link.hinge.axis
    panel = shape.sides[2] < FLAT * shape.sides[1]
    normal = shut_motion(link, rest)[:3, :3] @ shape.axes[2]
    if link.hinge.type == "prismatic":
        if small:
            return "button"
        in_plane = panel and abs(float(normal @ axis)) < 1 - ALONG
        if in_plane and abs(float(normal @ up)) < ALONG:
            return "door"  # a sliding one
        return "lid" if abs(float(axis @ up)) > ALONG else "drawer"
    away = np.cross(points - link.hinge.origin, axis)
    offset = np.linalg.norm(np.cross(shape.centre - link.hinge.origin, axis))
    if offset < CENTRED * np.linalg.norm(away, axis=1).max():
        return "knob" if small else "wheel"
    if abs(float(axis @ up)) > ALONG:
        return "door"
    if not panel:
        return "part"
    return "lid" if abs(float(normal @ up)) > ALONG else "flap"


def parse_names(words: Iterable[str]) -> dict[str, str]:
    """``part_1=door`` of a command line as {"part_1": "door"}. Raises UserError for other words or names that a format
    would not take."""
    out: dict[str, str] = {}
    for word in words:
        part, equals, name = word.partition("=")
        if not equals or not part:
            raise UserError(f"--name '{word}': expected PART=NAME, as in part_1=door")
        if not WORD.fullmatch(name):
            raise UserError(f"--name '{word}': a name is letters, digits and underscores, and no digit comes first")
        if name == "world":
            raise UserError(f"--name '{word}': simulators keep that name for the ground a base stands on")
        if part in out:
            raise UserError(f"--name '{word}': {part} has a name already, '{out[part]}'")
        out[part] = name
    return out


def with_names(asset: Asset, given: Optional[Mapping[str, str]] = None) -> Asset:
    """The asset with labelled links, named by their labels, numbered where several have the same: door, drawer_1,
    drawer_2.

    given: label of a link by its name (``base``, ``part_1``), which geometry does not overrule. Raises UserError for a
    link it lacks.
    """
    given = dict(given or {})
    unknown = sorted(set(given) - {link.name for link in asset.links})
    if unknown:
        raise UserError(
            f"--name {unknown[0]}: there is no such part; the twin has {', '.join(link.name for link in asset.links)}"
        )
    up = np.eye(3)["xyz".index(asset.up)]
    base = asset.links[0]
    labels = [given.get(base.name, BODY)] + [
        given.get(link.name) or label_of(link, base, up) for link in asset.links[1:]
    ]
    wanted = [given.get(base.name, base.name), *labels[1:]]
    names, taken = [], set(wanted)
    for i, name in enumerate(wanted):
        if wanted.count(name) > 1:
            count = 1 + wanted[:i].count(name)
            while f"{name}_{count}" in taken:
                count += 1
            name = f"{name}_{count}"
            taken.add(name)
        names.append(name)
    renamed = dict(zip((link.name for link in asset.links), names, strict=True))
    links = [
        replace(link, name=renamed[link.name], label=label) for link, label in zip(asset.links, labels, strict=True)
    ]
    blocking = [(renamed[a], renamed[b]) for a, b in asset.blocking]
    return replace(asset, links=links, blocking=blocking, lost={renamed[k]: v for k, v in asset.lost.items()})
