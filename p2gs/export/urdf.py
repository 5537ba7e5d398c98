"""URDF: a link per part, a joint per moving part, zero at the start state; visual and convex collision meshes, limits, inertia, damping."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from p2gs.export.asset import Asset, Link
from p2gs.export.assets_dir import FOLDER, collision_name, visual_name, write_assets

EFFORT, VELOCITY = 100.0, 5.0  # limits that robot programs demand; of no joint we can know them


def write_urdf(asset: Asset, out: Path) -> Path:
    """OUT/twin.urdf and OUT/assets. Mesh paths are relative to the file, which every reader resolves."""
    write_assets(asset, out)
    robot = ET.Element("robot", name=asset.name)
    compiler = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")  # read by MuJoCo, skipped by others
    compiler.attrib |= {"meshdir": FOLDER, "strippath": "true", "fusestatic": "false", "discardvisual": "true", "balanceinertia": "true"}
    for link in asset.links:
        _link(robot, link)
    for link in asset.moving:
        _joint(robot, link, asset.links[0].name)
    path = out / "twin.urdf"
    ET.indent(robot)
    path.write_text('<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n")
    return path


def _link(robot: ET.Element, link: Link) -> None:
    element = ET.SubElement(robot, "link", name=link.name)
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(link.inertia.center), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=number(link.inertia.mass))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {n: number(link.inertia.matrix[ij]) for n, ij in names.items()})
    visual = ET.SubElement(element, "visual")
    _mesh(visual, visual_name(link))
    if link.texture is None:  # readers paint over a mesh's own texture
        material = ET.SubElement(visual, "material", name=f"{link.name}_colour")
        ET.SubElement(material, "color", rgba=numbers((*link.colour, 1.0)))
    for i in range(len(link.collision)):
        _mesh(ET.SubElement(element, "collision"), collision_name(link, i))


def _mesh(parent: ET.Element, name: str) -> None:
    ET.SubElement(parent, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(parent, "geometry"), "mesh", filename=f"{FOLDER}/{name}")


def _joint(robot: ET.Element, link: Link, parent: str) -> None:
    hinge = link.joint
    joint = ET.SubElement(robot, "joint", name=f"joint_{link.part}", type=hinge.type)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=link.name)
    ET.SubElement(joint, "origin", xyz=numbers(hinge.origin), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz=numbers(hinge.axis))
    limits = {"lower": number(hinge.lower), "upper": number(hinge.upper), "effort": number(EFFORT), "velocity": number(VELOCITY)}
    ET.SubElement(joint, "limit", limits)
    ET.SubElement(joint, "dynamics", damping=number(hinge.damping), friction=number(hinge.friction))


def number(value: float) -> str:
    """All the digits a float64 needs to come back the same."""
    return repr(float(value))


def numbers(values) -> str:
    return " ".join(number(v) for v in np.asarray(values, dtype=np.float64))
