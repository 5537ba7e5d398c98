"""GLB (binary glTF 2.0): a node per part with vertex colours, and an animation that opens and shuts every joint.

Written by hand from the Khronos specification (registry.khronos.org/glTF): it is a JSON header and one block of arrays.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.links import Hinge, Link
from p2gs.ops.palette import part_colour
from p2gs.surface.tsdf import vertex_normals

SECONDS = 4.0  # start -> end -> start
FLOAT, UINT, UBYTE = 5126, 5125, 5121
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
LINEAR = 9729


class Buffer:
    """Collects arrays into one block, each with its accessor."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add_bytes(self, content: bytes, target: int | None = None) -> int:
        """Index of the new view."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
            | ({"target": target} if target else {})
        )
        self.data += content
        return len(self.views) - 1

    def add(
        self, values: np.ndarray, kind: str, component: int, target: int | None = None, normalized: bool = False
    ) -> int:
        """Index of the new accessor."""
        view = self.add_bytes(np.ascontiguousarray(values).tobytes(), target)
        accessor = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        if component == FLOAT:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        if normalized:
            accessor["normalized"] = True
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(asset: Asset, out: Path) -> Path:
    """OUT/twin.glb. A part's node stands at its joint's origin; ``extras`` of the node hold the joint."""
    path = out / "twin.glb"
    path.write_bytes(glb_bytes(asset))
    return path


def glb_bytes(asset: Asset) -> bytes:
    """The file's content."""
    buffer = Buffer()
    shown = [link for link in asset.links if not link.bare]
    meshes = [_mesh(buffer, link) for link in shown]
    textured = [(link.name, link.texture) for link in asset.links if link.texture is not None]
    document: dict = {}
    if textured:  # read between texels, but from no smaller copies, in which neighbours run together
        images = [
            {"bufferView": buffer.add_bytes(texture.png()), "mimeType": "image/png", "name": name}
            for name, texture in textured
        ]
        document |= {"images": images, "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR}]}
        document["textures"] = [{"source": i, "sampler": 0} for i in range(len(images))]
    number = {name: i for i, (name, _) in enumerate(textured)}
    for mesh in meshes:
        mesh["primitives"][0]["material"] = number.get(mesh["name"], len(textured))
    document["materials"] = [_material(name, i) for i, (name, _) in enumerate(textured)]
    if len(textured) < len(shown):
        document["materials"].append(_material("scan"))
    return animated_glb(asset, buffer, meshes, document)


def animated_glb(asset: Asset, buffer: Buffer, meshes: list[dict], document: dict) -> bytes:
    """A file of one node a part, with the mesh of its name where there is one, that opens and shuts every joint.

    document: what else it has; arrays are in ``buffer``.
    """
    nodes: list[dict] = [{"name": asset.name, "children": list(range(1, len(asset.links) + 1))}]
    number = {mesh["name"]: {"mesh": i} for i, mesh in enumerate(meshes)}
    for link in asset.links:
        nodes.append(
            {"name": link.name, "translation": link.origin.tolist()} | number.get(link.name, {}) | _extras(link)
        )
    samplers, channels = [], []
    times = np.linspace(0, SECONDS, 9, dtype=np.float32)
    clock = buffer.add(times, "SCALAR", FLOAT) if asset.moving else -1
    for i, link in enumerate(asset.links):
        if link.joint is not None:
            keys, kind, path = _keyframes(link.joint, 1 - np.abs(1 - 2 * times / SECONDS))
            samplers.append({"input": clock, "output": buffer.add(keys, kind, FLOAT), "interpolation": "LINEAR"})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": i + 1, "path": path}})
    document = document | {
        "asset": {"version": "2.0", "generator": "p2gs"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if channels:
        document["animations"] = [{"name": "open_and_shut", "samplers": samplers, "channels": channels}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    block = bytes(buffer.data) + b"\0" * (-len(buffer.data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(block), 0x004E4942) + block
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def _material(name: str, texture: int | None = None) -> dict:
    surface: dict = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    if texture is not None:
        surface["baseColorTexture"] = {"index": texture}
    return {"name": name, "doubleSided": True, "pbrMetallicRoughness": surface}


def _mesh(buffer: Buffer, link: Link) -> dict:
    v, normals = link.visual, vertex_normals(link.visual.vertices, link.visual.faces)
    # a texture has places for triangles' corners, not for vertices that they share
    rows = slice(None) if link.texture is None else v.faces.reshape(-1)
    faces = v.faces if link.texture is None else np.arange(v.faces.size)
    attributes = {
        "POSITION": buffer.add(v.vertices[rows].astype(np.float32), "VEC3", FLOAT, ARRAY_BUFFER),
        "NORMAL": buffer.add(normals[rows].astype(np.float32), "VEC3", FLOAT, ARRAY_BUFFER),
    }
    if link.texture is None:
        rgba = (np.c_[linear_light(v.colours / 255), np.ones(len(v.colours))] * 255).round().astype(np.uint8)
        attributes["COLOR_0"] = buffer.add(rgba, "VEC4", UBYTE, ARRAY_BUFFER, normalized=True)
    else:
        uv = link.texture.uv.reshape(-1, 2) * [1, -1] + [0, 1]  # glTF counts from the upper edge
        attributes["TEXCOORD_0"] = buffer.add(uv.astype(np.float32), "VEC2", FLOAT, ARRAY_BUFFER)
    indices = buffer.add(faces.astype(np.uint32).reshape(-1), "SCALAR", UINT, ELEMENT_BUFFER)
    return {"name": link.name, "primitives": [{"attributes": attributes, "indices": indices}]}


def linear_light(srgb: np.ndarray) -> np.ndarray:
    """Colours [..., 3] in 0..1 as pictures have them, in the linear light that glTF's vertex colours are."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _extras(link: Link) -> dict:
    h = link.joint
    extras: dict = {"colour": list(part_colour(link.part))} | ({"label": link.label} if link.label else {})
    if h is None:
        return {"extras": extras}
    joint = {
        "type": h.type,
        "axis": h.axis.tolist(),
        "origin": h.origin.tolist(),
        "motion": h.motion,
        "limits": [h.lower, h.upper],
    }
    return {"extras": extras | {"joint": joint}}


def _keyframes(hinge: Hinge, shares: np.ndarray) -> tuple[np.ndarray, str, str]:
    """The node's pose at shares [n] of the motion: quaternions xyzw, or translations."""
    if hinge.type == "prismatic":
        return (hinge.origin + shares[:, None] * hinge.motion * hinge.axis).astype(np.float32), "VEC3", "translation"
    half = shares * hinge.motion / 2
    return np.c_[np.sin(half)[:, None] * hinge.axis, np.cos(half)].astype(np.float32), "VEC4", "rotation"
