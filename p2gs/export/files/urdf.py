"""URDF: a link per part, a joint per moving part, zero at the start state; visual and convex collision meshes, limits,
inertia, damping."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.assets_dir import FOLDER, collision_name, visual_name, write_assets
from p2gs.export.links import Hinge, Link

WORLD = "world"


def write_urdf(asset: Asset, out: Path, mujoco: bool = True) -> Path:
    """OUT/twin.urdf and OUT/assets. Mesh paths are relative to the file, which every reader resolves.

    mujoco: with the element of MuJoCo's own that tells it where the meshes are; some readers warn of it.  A fixed base
    hangs on a link ``world``, which readers that know no such option of their own need; by default and floating it is
    the root.
    """
    write_assets(asset, out)
    robot = ET.Element("robot", name=asset.name)
    if mujoco:
        compiler = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")
        compiler.attrib |= {
            "strippath": "false",
            "fusestatic": "false",
            "discardvisual": "true",
            "balanceinertia": "true",
        }
    if asset.fixed:
        ET.SubElement(robot, "link", name=WORLD)
        fixed_joint(robot, "fix_base", WORLD, asset.links[0].name)
    for link in asset.links:
        _link(robot, link)
    for link in asset.moving:
        add_joint(robot, link.hinge, f"joint_{link.part}", asset.links[0].name, link.name)
    path = out / "twin.urdf"
    return write_xml(robot, path)


def write_xml(robot: ET.Element, path: Path) -> Path:
    """The file, indented."""
    ET.indent(robot)
    path.write_text('<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n")
    return path


def _link(robot: ET.Element, link: Link) -> None:
    element = ET.SubElement(robot, "link", name=link.name)
    if link.bare:
        return
    add_inertial(element, link)
    visual = ET.SubElement(element, "visual")
    _mesh(visual, visual_name(link))
    if link.texture is None:  # readers paint over a mesh's own texture
        material = ET.SubElement(visual, "material", name=f"{link.name}_colour")
        ET.SubElement(material, "color", rgba=numbers((*link.colour, 1.0)))
    for i in range(len(link.collision)):
        _mesh(ET.SubElement(element, "collision"), collision_name(link, i))


def fixed_joint(
    robot: ET.Element, name: str, parent: str, child: str, rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> None:
    """A joint that does not move, both links' origins in one place."""
    joint = ET.SubElement(robot, "joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz="0 0 0", rpy=numbers(rpy))


def add_inertial(element: ET.Element, link: Link) -> None:
    """Mass, its centre and inertia of a link."""
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(link.inertia.center), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=number(link.inertia.mass))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {n: number(link.inertia.matrix[ij]) for n, ij in names.items()})


def _mesh(parent: ET.Element, name: str) -> None:
    ET.SubElement(parent, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(parent, "geometry"), "mesh", filename=f"{FOLDER}/{name}")


def add_joint(robot: ET.Element, hinge: Hinge, name: str, parent: str, child: str) -> None:
    """A moving joint with limits, damping and friction."""
    joint = ET.SubElement(robot, "joint", name=name, type=hinge.type)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=numbers(hinge.origin), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz=numbers(hinge.axis))
    limits = {
        "lower": number(hinge.lower),
        "upper": number(hinge.upper),
        "effort": number(hinge.effort),
        "velocity": number(hinge.velocity),
    }
    ET.SubElement(joint, "limit", limits)
    ET.SubElement(joint, "dynamics", damping=number(hinge.damping), friction=number(hinge.friction))


def number(value: float) -> str:
    """All the digits a float64 needs to come back the same."""
    return repr(float(value))


def numbers(values) -> str:
    return " ".join(number(v) for v in np.asarray(values, dtype=np.float64))
