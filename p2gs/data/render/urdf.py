"""URDF files: links with their visual shapes, joints with placement, axis and limits."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.render.asset import Asset, AssetJoint, JointType, Shape, euler, unit
from p2gs.data.render.shapes import mesh_shapes, primitive
from p2gs.types import UserError

TYPES: dict[str, JointType] = {
    "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed",
}  # fmt: skip


def read_urdf(path: Path) -> Asset:
    """Raises UserError for a file that is missing, no URDF, or has a joint of another type than revolute, continuous,
    prismatic or fixed."""
    root = parse_xml(path, "robot")
    looks = {m.get("name", ""): _rgba(m) for m in root.findall("material")}
    links = {e.get("name", ""): _shapes(e, path, looks) for e in root.findall("link")}
    joints = [_joint(e, path) for e in root.findall("joint")]
    for j in joints:
        for link in (j.parent, j.child):
            if link not in links:
                raise UserError(f"{path}: the joint '{j.name}' names the link '{link}', which is not there")
    return Asset(path, links, joints)


def parse_xml(path: Path, tag: str) -> ET.Element:
    """The root element of a file. Raises UserError where it is missing, no XML, or begins with another tag."""
    try:
        root = ET.parse(path).getroot()
    except OSError as err:
        raise UserError(f"{path}: cannot be read ({err.strerror})") from err
    except ET.ParseError as err:
        raise UserError(f"{path}: is no XML ({err})") from err
    if root.tag != tag:
        raise UserError(f"{path}: expected <{tag}> as its first element, got <{root.tag}>")
    return root


def numbers(text: Optional[str], default: str, where: str, count: int = 3) -> np.ndarray:
    """[count] floats of an attribute. Raises UserError."""
    words = (text or default).split()
    try:
        values = np.array([float(w) for w in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise UserError(f"{where}: expected {count} numbers, got '{text}'")
    return values


def placement(element: Optional[ET.Element], where: str) -> np.ndarray:
    """[4, 4] of an <origin>: xyz, and rpy about the fixed axes."""
    T = np.eye(4)
    if element is not None:
        T[:3, :3] = euler(numbers(element.get("rpy"), "0 0 0", where), "XYZ")
        T[:3, 3] = numbers(element.get("xyz"), "0 0 0", where)
    return T


def _shapes(link: ET.Element, path: Path, looks: dict[str, Optional[np.ndarray]]) -> list[Shape]:
    out, where = [], f"{path}: link '{link.get('name')}'"
    for visual in link.findall("visual"):
        at, material = placement(visual.find("origin"), where), visual.find("material")
        colour = None if material is None else _rgba(material)
        if material is not None and colour is None:
            colour = looks.get(material.get("name", ""))
        found = visual.find("geometry/*")
        if found is None:
            continue
        if found.tag == "mesh":
            scale = numbers(found.get("scale"), "1 1 1", where).tolist()
            out += mesh_shapes(find_mesh(path, found.get("filename", "")), scale, at, colour)
        elif found.tag in ("box", "cylinder", "sphere", "capsule"):
            out.append(primitive(found.tag, _size(found, where), at, colour))
        else:
            raise UserError(f"{where}: the geometry <{found.tag}> is not known; known: mesh, box, cylinder, sphere")
    return out


def _size(shape: ET.Element, where: str) -> list[float]:
    if shape.tag == "box":
        return list(numbers(shape.get("size"), "", where))
    names = ("radius",) if shape.tag == "sphere" else ("radius", "length")
    return [float(numbers(shape.get(n), "", where, 1)[0]) for n in names]


def _rgba(material: ET.Element) -> Optional[np.ndarray]:
    colour = material.find("color")
    return None if colour is None else np.clip(numbers(colour.get("rgba"), "", "material", 4)[:3], 0, 1)


def find_mesh(path: Path, name: str) -> Path:
    """The file that a URDF names: beside it, or package://PACKAGE/... below one of the folders above it."""
    plain = name.replace("package://", "").replace("file://", "")
    inner = re.sub(r"^[^/]+/", "", plain)
    tries = [path.parent / plain, path.parent.parent / inner, path.parent.parent / plain, path.parent / inner]
    return next((t for t in tries if t.is_file()), tries[0])


def _joint(element: ET.Element, path: Path) -> AssetJoint:
    name = element.get("name", "")
    where, kind = f"{path}: joint '{name}'", TYPES.get(element.get("type", ""))
    if kind is None:
        raise UserError(f"{where}: the type '{element.get('type')}' is not known; known: {', '.join(TYPES)}")
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise UserError(f"{where}: expected a parent and a child link")
    axis, limit = element.find("axis"), element.find("limit")
    along = np.array([1.0, 0, 0]) if axis is None else numbers(axis.get("xyz"), "1 0 0", where)
    limits = None
    if limit is not None and element.get("type") != "continuous":
        low, high = (float(numbers(limit.get(n), "0", where, 1)[0]) for n in ("lower", "upper"))
        limits = (low, high)
    return AssetJoint(
        name, kind, parent.get("link", ""), child.get("link", ""), placement(element.find("origin"), where),
        along if kind == "fixed" else unit(along, where), limits,
    )  # fmt: skip
