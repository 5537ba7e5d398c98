"""MJCF files: bodies with their geoms, hinges and slides; default classes, compiler angles and mesh folders."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, Iterator, Optional

import numpy as np

from p2gs.data.render.asset import Asset, AssetJoint, Shape, euler, rotation, unit
from p2gs.data.render.shapes import mesh_shapes, primitive
from p2gs.data.render.urdf import numbers, parse_xml
from p2gs.types import UserError

KINDS = ("box", "cylinder", "capsule", "sphere", "ellipsoid", "mesh")
ZERO = "0 0 0"


def read_mjcf(path: Path) -> Asset:
    """The bodies of a model as links (the world is the root). Several joints of one body become links without shapes
    between it and its parent. Planes, height fields and free joints are left out. Raises UserError."""
    return _Reader(path).asset()


class _Reader:
    def __init__(self, path: Path):
        self.path, self.root = path, parse_xml(path, "mujoco")
        if self.root.find(".//include") is not None:
            raise UserError(f"{path}: has an <include>; save the model as one file first")
        compiler = self.root.find("compiler")
        options = {} if compiler is None else compiler.attrib
        self.degrees = options.get("angle", "degree") == "degree"
        self.order = options.get("eulerseq", "xyz")
        self.folder = path.parent / options.get("meshdir", options.get("assetdir", ""))
        self.classes: dict[str, dict[str, dict[str, str]]] = {}
        for top in self.root.findall("default"):
            self.learn(top, {})
        self.meshes = {self.mesh_name(m): m for m in self.root.findall("asset/mesh")}
        self.looks = {m.get("name"): self.given(m, "main").get("rgba") for m in self.root.findall("asset/material")}
        self.links: dict[str, list[Shape]] = {}
        self.joints: list[AssetJoint] = []

    def asset(self) -> Asset:
        world = self.root.find("worldbody")
        if world is None:
            raise UserError(f"{self.path}: has no <worldbody>")
        self.body(world, np.eye(4), "world", None, "main")
        return Asset(self.path, self.links, self.joints)

    @staticmethod
    def mesh_name(mesh: ET.Element) -> str:
        return mesh.get("name") or Path(mesh.get("file", "")).stem

    def learn(self, element: ET.Element, above: dict[str, dict[str, str]]) -> None:
        """A default class: what it says laid on what its parent says."""
        own = {tag: dict(values) for tag, values in above.items()}
        for child in element:
            if child.tag != "default":
                own[child.tag] = own.get(child.tag, {}) | dict(child.attrib)
        self.classes[element.get("class", "main")] = own
        for child in element.findall("default"):
            self.learn(child, own)

    def given(self, element: ET.Element, inherited: str) -> dict[str, str]:
        """An element's attributes, with those of its class below them."""
        defaults = self.classes.get(element.get("class", inherited), {})
        return defaults.get(element.tag, {}) | dict(element.attrib)

    def angle(self, value: float) -> float:
        return float(np.radians(value)) if self.degrees else float(value)

    def placed(self, given: dict[str, Any], where: str) -> np.ndarray:
        """[4, 4] of pos with quat, axisangle, euler, xyaxes or zaxis."""
        T = np.eye(4)
        T[:3, 3] = numbers(given.get("pos"), ZERO, where)
        if "quat" in given:
            T[:3, :3] = _quaternion(numbers(given["quat"], "", where, 4))
        elif "axisangle" in given:
            *axis, angle = numbers(given["axisangle"], "", where, 4)
            T[:3, :3] = rotation(unit(np.array(axis), where), self.angle(angle))
        elif "euler" in given:
            T[:3, :3] = euler([self.angle(v) for v in numbers(given["euler"], "", where)], self.order)
        elif "xyaxes" in given:
            x, y = numbers(given["xyaxes"], "", where, 6).reshape(2, 3)
            x = unit(x, where)
            y = unit(y - (y @ x) * x, where)
            T[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        elif "zaxis" in given:
            T[:3, :3] = _towards(unit(numbers(given["zaxis"], "", where), where))
        return T

    def within(
        self, element: ET.Element, tag: str, inherited: str, where: str
    ) -> Iterator[tuple[ET.Element, np.ndarray, str]]:
        """(child, the frame [4, 4] that it is given in, its class) of a body's children, those in its frames too."""
        for child in element:
            if child.tag == tag:
                yield child, np.eye(4), inherited
            elif child.tag == "frame":
                at = self.placed(dict(child.attrib), where)
                for one, T, own in self.within(child, tag, child.get("childclass", inherited), where):
                    yield one, at @ T, own

    def body(self, element: ET.Element, frame: np.ndarray, name: str, parent: Optional[str], inherited: str) -> None:
        where = f"{self.path}: body '{name}'"
        inherited = element.get("childclass", inherited)
        geoms = self.within(element, "geom", inherited, where)
        self.links[name] = [s for g, T, own in geoms for s in self.geom(self.given(g, own), T, where)]
        if parent is not None:
            at = frame @ self.placed(dict(element.attrib), where)
            self.hang(element, at, name, parent, inherited, where)
        for k, (child, T, own) in enumerate(self.within(element, "body", inherited, where)):
            self.body(child, T, child.get("name") or f"{name}.{k}", name, own)

    def hang(self, element: ET.Element, at: np.ndarray, name: str, parent: str, inherited: str, where: str) -> None:
        """The joints of a body that is at [4, 4] in its parent; a joint's own place is in the body's frame."""
        hinges = [(self.given(j, own), T) for j, T, own in self.within(element, "joint", inherited, where)]
        hinges = [(given, T) for given, T in hinges if given.get("type") != "free"]
        if not hinges:
            return self.joints.append(AssetJoint(f"{name}_fixed", "fixed", parent, name, at, np.array([1.0, 0, 0])))
        for k, (given, frame) in enumerate(hinges):
            kind = given.get("type", "hinge")
            if kind not in ("hinge", "slide"):
                raise UserError(f"{where}: a joint of type '{kind}' is not known; known: hinge, slide")
            last = k == len(hinges) - 1
            child = name if last else f"{name}.before_{k + 1}"
            if not last:
                self.links[child] = []
            there = np.eye(4)
            there[:3, 3] = frame[:3, :3] @ numbers(given.get("pos"), ZERO, where) + frame[:3, 3]
            axis = frame[:3, :3] @ unit(numbers(given.get("axis"), "0 0 1", where), where)
            limits, zero = self.limits(given, kind, where), float(numbers(given.get("ref"), "0", where, 1)[0])
            zero = self.angle(zero) if kind == "hinge" else zero
            own = given.get("name") or f"{name}.joint_{k}"
            kind = "revolute" if kind == "hinge" else "prismatic"
            joint = AssetJoint(own, kind, parent, child, at @ there, axis, limits, np.linalg.inv(there), zero)
            self.joints.append(joint)
            parent, at = child, np.eye(4)

    def limits(self, given: dict[str, str], kind: str, where: str) -> Optional[tuple[float, float]]:
        if "range" not in given or given.get("limited") == "false":
            return None
        low, high = (float(v) for v in numbers(given["range"], "", where, 2))
        return (self.angle(low), self.angle(high)) if kind == "hinge" else (low, high)

    def geom(self, given: dict[str, str], frame: np.ndarray, where: str) -> list[Shape]:
        """The shapes of one geom, which is given in a frame [4, 4] of its body."""
        kind = given.get("type", "mesh" if "mesh" in given else "sphere")
        if kind not in KINDS or given.get("group") == "3" and given.get("contype") != "0":
            return []  # group 3 is where models keep what collides and is not shown
        rgba = given.get("rgba") or self.looks.get(given.get("material"))
        look = None if rgba is None else numbers(rgba, "", where, 4)
        if look is not None and look[3] <= 0:
            return []
        colour = None if look is None else np.clip(look[:3], 0, 1)
        if kind == "mesh":
            mesh = self.meshes.get(given.get("mesh", ""))
            if mesh is None:
                raise UserError(f"{where}: the mesh '{given.get('mesh')}' is not among the assets")
            scale = numbers(self.given(mesh, "main").get("scale"), "1 1 1", where).tolist()
            file = self.folder / mesh.get("file", "")
            return mesh_shapes(file, scale, frame @ self.placed(given, where), colour)
        at, size = self.span(kind, given, where)
        return [primitive(kind, size, frame @ at, colour)]

    def span(self, kind: str, given: dict[str, str], where: str) -> tuple[np.ndarray, list[float]]:
        """Where a primitive is, [4, 4], and its sizes as ``primitive`` wants them (MJCF has half lengths)."""
        words = (given.get("size") or "").split()
        size = numbers(given.get("size"), "", where, len(words)).tolist() if words else []
        at = self.placed(given, where)
        if "fromto" in given:
            ends = numbers(given["fromto"], "", where, 6).reshape(2, 3)
            along = ends[1] - ends[0]
            at = np.eye(4)
            at[:3, :3], at[:3, 3] = _towards(unit(along, where)), ends.mean(0)
            half = float(np.linalg.norm(along)) / 2
            size = [*size[:1] * (2 if kind in ("box", "ellipsoid") else 1), half]
        count = {"sphere": 1, "cylinder": 2, "capsule": 2}.get(kind, 3)
        if len(size) < count or min(size[:count]) <= 0:
            raise UserError(f"{where}: a {kind} wants {count} positive sizes, got '{given.get('size')}'")
        if kind == "box":
            return at, [2 * s for s in size[:3]]
        return at, [size[0], 2 * size[1]] if count == 2 else size[:count]


def _quaternion(q: np.ndarray) -> np.ndarray:
    """[3, 3] of wxyz."""
    w, *v = q / max(float(np.linalg.norm(q)), 1e-12)
    length = float(np.linalg.norm(v))
    return np.eye(3) if length < 1e-12 else rotation(np.array(v) / length, 2 * float(np.arctan2(length, w)))


def _towards(z: np.ndarray) -> np.ndarray:
    """[3, 3] that turns the z axis to a unit direction by the shortest way."""
    axis = np.cross([0, 0, 1.0], z)
    length = float(np.linalg.norm(axis))
    if length < 1e-12:
        return np.eye(3) if z[2] > 0 else np.diag([1.0, -1, -1])
    return rotation(axis / length, float(np.arctan2(length, z[2])))
