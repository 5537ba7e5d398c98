"""MJCF: MuJoCo's own format. Shells are shown, convex pieces collide, joints carry limits, damping and a motor each."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

from p2gs.export.asset import Asset
from p2gs.export.assets_dir import FOLDER, collision_name, texture_name, visual_name, write_assets
from p2gs.export.files.urdf import number, numbers
from p2gs.export.links import Link
from p2gs.export.physics.inertia import effective_inertia

GRAVITY = {"z": (0, 0, -9.81), "y": (0, -9.81, 0), "x": (-9.81, 0, 0)}


def write_mjcf(asset: Asset, out: Path) -> Path:
    """OUT/twin.xml and OUT/assets. The base stands fixed in the world unless it is to float; joint names are those of
    the URDF."""
    write_assets(asset, out)
    root = ET.Element("mujoco", model=asset.name)
    ET.SubElement(root, "compiler", angle="radian", meshdir=FOLDER, texturedir=FOLDER, autolimits="true")
    option = ET.SubElement(
        root, "option", timestep="0.002", integrator="implicitfast", gravity=numbers(GRAVITY[asset.up])
    )
    if asset.fixed is False:  # where the base moves, MuJoCo lets parts pass through it unless told
        ET.SubElement(option, "flag", filterparent="disable")
    _defaults(root)
    meshes = ET.SubElement(root, "asset")
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 3", directional="true")
    for link in (one for one in asset.links if not one.bare):
        # an open shell has no volume; its mass is not used, but the compiler would stumble over it
        ET.SubElement(meshes, "mesh", name=link.name, file=visual_name(link), inertia="shell")
        if link.texture is not None:
            ET.SubElement(meshes, "texture", name=link.name, type="2d", file=texture_name(link))
            ET.SubElement(meshes, "material", name=link.name, texture=link.name)
        for i in range(len(link.collision)):
            ET.SubElement(meshes, "mesh", name=f"{link.name}_{i}", file=collision_name(link, i), inertia="convex")
    base = _body(world, asset.links[0])
    if asset.fixed is False:
        base.insert(0, ET.Element("freejoint", name="floating_base"))
    actuator = ET.SubElement(root, "actuator")
    for link in asset.moving:
        _body(base, link)
        reach = numbers((-link.hinge.effort, link.hinge.effort))
        ET.SubElement(
            actuator, "motor", name=f"motor_{link.part}", joint=f"joint_{link.part}", gear="1", ctrlrange=reach
        )
    path = out / "twin.xml"
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n")
    return path


def _defaults(root: ET.Element) -> None:
    default = ET.SubElement(root, "default")
    visual = ET.SubElement(default, "default", {"class": "visual"})
    ET.SubElement(visual, "geom", type="mesh", contype="0", conaffinity="0", group="2")
    collision = ET.SubElement(default, "default", {"class": "collision"})
    ET.SubElement(collision, "geom", type="mesh", group="3", friction="0.6 0.005 0.0001")
    joint = ET.SubElement(default, "default", {"class": "joint"})
    ET.SubElement(joint, "joint", solreflimit="0.01 1", solimplimit="0.98 0.999 0.001")


def _body(parent: ET.Element, link: Link) -> ET.Element:
    body = ET.SubElement(parent, "body", name=link.name, pos=numbers(link.origin))
    if link.bare:
        return body
    m = link.inertia.matrix
    full = (m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])
    ET.SubElement(
        body, "inertial", pos=numbers(link.inertia.center), mass=number(link.inertia.mass), fullinertia=numbers(full)
    )
    if link.joint is not None:
        hinge = link.joint
        kind = "hinge" if hinge.type == "revolute" else "slide"
        weight = effective_inertia(link.inertia, hinge.axis) if kind == "hinge" else link.inertia.mass
        joint = ET.SubElement(
            body,
            "joint",
            {"class": "joint"},
            name=f"joint_{link.part}",
            type=kind,
            pos="0 0 0",
            axis=numbers(hinge.axis),
        )
        joint.attrib |= {
            "range": numbers((hinge.lower, hinge.upper)),
            "damping": number(hinge.damping),
            "armature": number(0.01 * weight),
        }
        joint.attrib["frictionloss"] = number(hinge.friction)
    look = {"rgba": numbers((*link.colour, 1.0))} if link.texture is None else {"material": link.name}
    ET.SubElement(body, "geom", {"class": "visual"} | look, mesh=link.name)
    for i in range(len(link.collision)):
        ET.SubElement(body, "geom", {"class": "collision"}, mesh=f"{link.name}_{i}")
    return body
