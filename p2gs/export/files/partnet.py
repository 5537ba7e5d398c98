"""The layout of PartNet-Mobility, which SAPIEN, ManiSkill and programs written for that data set read: Y up, a link a
part, labels.

After Xiang et al. 2020 (SAPIEN, arXiv 2003.08515) and the published objects: mobility.urdf whose root ``base`` turns Y
to Z, textured_objs/, mobility_v2.json, semantics.txt, result.json (tree of parts), bounding_box.json, meta.json.
Textures lie beside the OBJ files (the data set's in images/), where readers that take no path upwards find them too.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Mapping, Optional
from xml.etree import ElementTree as ET

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.assets_dir import write_obj
from p2gs.export.files.urdf import add_inertial, add_joint, fixed_joint, numbers, write_xml
from p2gs.export.links import Link

OBJS, PIECES = "textured_objs", "collision_objs"
UPRIGHT = (np.pi / 2, 0.0, -np.pi / 2)  # of the object in ``base``: Y to Z, its front (Z) to -X
# the data set's words; a root may be free
JOINTS: dict[Optional[str], str] = {"revolute": "hinge", "prismatic": "slider", None: "heavy"}


def write_partnet(asset: Asset, out: Path, meta: Mapping[str, object]) -> list[Path]:
    """The files of one object in OUT. The asset has Y up and labelled links; moving ones become link_0, link_1, ...,
    the base the last.

    meta: of the user; ``category`` becomes model_cat.
    """
    for folder, pattern in ((OBJS, "original-*"), (PIECES, "link_*")):
        (out / folder).mkdir(parents=True, exist_ok=True)
        for old in (out / folder).glob(pattern):  # of an earlier export
            old.unlink()
    kinds = JOINTS | {None: "free"} if asset.fixed is False else JOINTS
    order = [*asset.moving, asset.links[0]]
    number = {link.name: i for i, link in enumerate(order)}
    robot = ET.Element("robot", name=f"partnet_{asset.name}")
    ET.SubElement(robot, "link", name="base")
    for link in order:
        _link(robot, link, number[link.name], out)
    root = f"link_{len(order) - 1}"
    for link in order:
        i = number[link.name]
        if link.joint is None:
            fixed_joint(robot, f"joint_{i}", "base", root, UPRIGHT)
        else:
            add_joint(robot, link.hinge, f"joint_{i}", root, f"link_{i}")
    written = [write_xml(robot, out / "mobility.urdf")]
    points = np.concatenate([link.visual.vertices + link.origin for link in asset.links])
    box = {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    category = str(meta.get("category", "Object"))
    tree = {
        "id": 0,
        "name": category.lower(),
        "text": category,
        "children": [_leaf(link, number[link.name]) for link in order],
    }
    files = {
        "mobility_v2.json": [_entry(link, number[link.name], len(order) - 1, kinds) for link in order],
        "result.json": [tree],
        "bounding_box.json": box,
        "meta.json": {**meta, "model_cat": category, "anno_id": asset.name},
    }
    for name, content in files.items():
        (out / name).write_text(json.dumps(content, indent=1) + "\n")
        written.append(out / name)
    lines = [f"link_{number[link.name]} {kinds[link.joint and link.joint.type]} {link.label}" for link in order]
    (out / "semantics.txt").write_text("\n".join(lines) + "\n")
    return [*written, out / "semantics.txt"]


def _link(robot: ET.Element, link: Link, i: int, out: Path) -> None:
    element = ET.SubElement(robot, "link", name=f"link_{i}")
    if link.bare:
        return
    add_inertial(element, link)
    visual = ET.SubElement(element, "visual", name=f"{link.label}-{i + 1}")
    shown = f"{OBJS}/original-{i + 1}.obj"
    _mesh(visual, shown)
    look = link.visual
    write_obj(out / shown, look.vertices, look.faces, look.colours, link.texture)
    for k, piece in enumerate(link.collision):
        name = f"{PIECES}/link_{i}_{k}.obj"
        write_obj(out / name, piece.vertices, piece.faces)
        _mesh(ET.SubElement(element, "collision"), name)


def _mesh(parent: ET.Element, name: str) -> None:
    ET.SubElement(parent, "origin", xyz=numbers((0, 0, 0)), rpy=numbers((0, 0, 0)))
    ET.SubElement(ET.SubElement(parent, "geometry"), "mesh", filename=name)


def _leaf(link: Link, i: int) -> dict:
    return {"id": i + 1, "name": link.label, "text": link.label, "objs": [] if link.bare else [f"original-{i + 1}"]}


def _entry(link: Link, i: int, root: int, kinds: Mapping[Optional[str], str]) -> dict:
    """A link of mobility_v2.json: origins in the object's frame, limits in degrees or its unit of length, 0 = start."""
    hinge = link.joint
    parts = [] if link.bare else [{"id": i + 1, "name": link.label, "children": []}]
    entry = {"id": i, "parent": root, "joint": kinds[hinge and hinge.type], "name": link.label, "parts": parts}
    if hinge is None:
        return entry | {"parent": -1, "jointData": {}}
    turns = hinge.type == "revolute"
    lower, upper = np.degrees([hinge.lower, hinge.upper]) if turns else (hinge.lower, hinge.upper)
    limit = {
        "a": float(upper),
        "b": float(lower),
        "noLimit": False,
        "rotates": False,
        "noRotationLimit": True,
        "rotationLimit": "",
    }
    return entry | {
        "jointData": {"axis": {"origin": hinge.origin.tolist(), "direction": hinge.axis.tolist()}, "limit": limit}
    }
