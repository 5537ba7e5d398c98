"""USD as text (.usda), written without a library: meshes with colours, rigid bodies, UsdPhysics joints with limits and
damping."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Mapping, Optional, Sequence, Union

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.assets_dir import texture_name
from p2gs.export.files.splats_usd import splat_prim
from p2gs.export.links import Hinge, Link
from p2gs.export.physics.inertia import Inertia
from p2gs.surface.tsdf import vertex_normals
from p2gs.types import UserError

TEXTURES = "textures"  # folder beside the stage
FRICTION = 0.6  # of surfaces on each other, as in MJCF: wood on wood
# kg and kg m^2 of a base that shows nothing: articulations want a rigid body for their root, one without a mass draws a
# warning and gets these, and as it stands fast they act on nothing
BARE = Inertia(1.0, np.zeros(3), np.eye(3))
Value = Union[str, int, float, Sequence[float], Mapping[str, "Value"]]  # of layer metadata


def write_usd(
    asset: Asset,
    out: Path,
    name: str = "twin",
    data: Optional[Mapping[str, Value]] = None,
    labels: Sequence[tuple] = (),
) -> Path:
    """OUT/<name>.usda, metres, up axis Y or Z as asked for. Raises UserError for x, which USD does not know as an up
    axis.

    Links that have splats get them as a prim each.  data: the layer's own metadata (customLayerData).  labels:
    (taxonomy, label) pairs of the whole object.
    """
    if asset.up == "x":
        raise UserError("--up is 'x', but a USD stage stands on y or z: give --up y or --up z")
    schemas = ["PhysicsArticulationRootAPI", *(f"SemanticsLabelsAPI:{taxonomy}" for taxonomy, _ in labels)]
    lines = [
        "#usda 1.0",
        "(",
        *(layer_data(data) if data else []),
        '    defaultPrim = "twin"',
        "    metersPerUnit = 1",
        "    kilogramsPerUnit = 1",
        f'    upAxis = "{asset.up.upper()}"',
        ")",
        f'def Xform "twin" (prepend apiSchemas = {json.dumps(schemas)})',
        "{",
        *(f"    token[] semantics:labels:{taxonomy} = [{json.dumps(label)}]" for taxonomy, label in labels),
        *_contact(asset.material if asset.links[0].label else ""),
    ]
    for link in asset.links:
        lines += _link(link)
        if link.texture is not None:
            link.texture.save(_texture(out, link))
            lines += _material(link, asset.material if link.label else "")
    if asset.fixed is not False:
        lines += [
            '    def PhysicsFixedJoint "fix_base"',
            "    {",
            f"        rel physics:body1 = </twin/{asset.links[0].name}>",
            "    }",
        ]
    for link in asset.moving:
        lines += _joint(link, asset.links[0].name)
    path = out / f"{name}.usda"
    path.write_text("\n".join([*lines, "}"]) + "\n")
    return path


def layer_data(data: Mapping[str, Value], depth: int = 1, head: str = "customLayerData = {") -> list[str]:
    """Lines of a dictionary in a layer's metadata: strings, whole numbers, floats, triples of floats, dictionaries of
    these."""
    indent, lines = "    " * depth, []
    for key, value in data.items():
        if isinstance(value, Mapping):
            lines += layer_data(value, depth + 1, f"dictionary {key} = {{")
        elif isinstance(value, (str, bool)):
            lines.append(f"{indent}    string {key} = {json.dumps(str(value), ensure_ascii=False)}")
        elif isinstance(value, (int, float)):
            lines.append(f"{indent}    {'int' if isinstance(value, int) else 'double'} {key} = {value!r}")
        else:
            lines.append(f"{indent}    float3 {key} = {_tuple(value)}")
    return [indent + head, *lines, indent + "}"]


def _contact(label: str) -> list[str]:
    """The physics material of all collision pieces, labelled by what the object is made of, if it is labelled at
    all."""
    schemas = ["PhysicsMaterialAPI", *(["SemanticsLabelsAPI:material"] if label else [])]
    return [
        f'    def Material "contact" (prepend apiSchemas = {json.dumps(schemas)})',
        "    {",
        *([f'        token[] semantics:labels:material = ["{label}"]'] if label else []),
        f"        float physics:staticFriction = {FRICTION}",
        f"        float physics:dynamicFriction = {FRICTION}",
        "    }",
    ]


def _link(link: Link) -> list[str]:
    inertia = BARE if link.bare else link.inertia
    values, rotation = principal(inertia.matrix)
    body = [
        f'    def Xform "{link.name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])',
        "    {",
        f"        double3 xformOp:translate = {_tuple(link.origin)}",
        '        uniform token[] xformOpOrder = ["xformOp:translate"]',
        f"        float physics:mass = {inertia.mass!r}",
        f"        point3f physics:centerOfMass = {_tuple(inertia.center)}",
        f"        float3 physics:diagonalInertia = {_tuple(values)}",
        f"        quatf physics:principalAxes = {_tuple(rotation)}",
    ]
    if not link.bare:
        body += _shapes(link)
    if link.splats is not None and len(link.splats):
        body += splat_prim(link.splats, "        ")
    return [*body, "    }"]


def _shapes(link: Link) -> list[str]:
    """What a link shows, and its collision pieces."""
    visual = link.visual
    look = [
        f"color3f[] primvars:displayColor = {_array(visual.colours / 255, 4)} (",
        '    interpolation = "vertex"',
        ")",
    ]
    if link.texture is not None:
        look += [
            f"texCoord2f[] primvars:st = {_array(link.texture.uv.reshape(-1, 2), 7)} (",
            '    interpolation = "faceVarying"',
            ")",
        ]
        look += [f"rel material:binding = </twin/{link.name}_look>"]
    schemas = [] if link.texture is None else ["MaterialBindingAPI"]
    if link.label:
        schemas.append("SemanticsLabelsAPI:class")
        look.append(f'token[] semantics:labels:class = ["{link.label}"]')
    body = _mesh("visual", visual.vertices, visual.faces, look, schemas)
    for i, piece in enumerate(link.collision):
        extra = ['uniform token physics:approximation = "convexHull"', 'uniform token purpose = "guide"']
        extra.append("rel material:binding:physics = </twin/contact>")
        schemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "MaterialBindingAPI"]
        body += _mesh(f"collision_{i}", piece.vertices, piece.faces, extra, schemas)
    return body


def _texture(out: Path, link: Link) -> Path:
    folder = out / TEXTURES
    folder.mkdir(exist_ok=True)
    return folder / texture_name(link)


def _material(link: Link, label: str) -> list[str]:
    here = f"/twin/{link.name}_look"
    return [
        f'    def Material "{link.name}_look"'
        + (' (prepend apiSchemas = ["SemanticsLabelsAPI:material"])' if label else ""),
        "    {",
        *([f'        token[] semantics:labels:material = ["{label}"]'] if label else []),
        f"        token outputs:surface.connect = <{here}/surface.outputs:surface>",
        '        def Shader "surface"',
        "        {",
        '            uniform token info:id = "UsdPreviewSurface"',
        f"            color3f inputs:diffuseColor.connect = <{here}/picture.outputs:rgb>",
        "            float inputs:roughness = 0.9",
        "            token outputs:surface",
        "        }",
        '        def Shader "picture"',
        "        {",
        '            uniform token info:id = "UsdUVTexture"',
        f"            asset inputs:file = @./{TEXTURES}/{texture_name(link)}@",
        f"            float2 inputs:st.connect = <{here}/places.outputs:result>",
        '            token inputs:sourceColorSpace = "sRGB"',
        "            float3 outputs:rgb",
        "        }",
        '        def Shader "places"',
        "        {",
        '            uniform token info:id = "UsdPrimvarReader_float2"',
        '            string inputs:varname = "st"',
        "            float2 outputs:result",
        "        }",
        "    }",
    ]


def _mesh(name: str, vertices: np.ndarray, faces: np.ndarray, extra: list[str], schemas: list[str]) -> list[str]:
    rows = [
        f"point3f[] points = {_array(vertices, 7)}",
        # of the points as they are written
        f"float3[] extent = {_array(np.array([vertices.min(0), vertices.max(0)]), 7)}",
        f"normal3f[] normals = {_array(vertex_normals(vertices, faces), 4)} (",
        '    interpolation = "vertex"',
        ")",
        f"int[] faceVertexCounts = [{', '.join(['3'] * len(faces))}]",
        f"int[] faceVertexIndices = [{', '.join(map(str, faces.reshape(-1)))}]",
        'uniform token subdivisionScheme = "none"',
        "uniform bool doubleSided = 1",
        *extra,
    ]
    head = f'        def Mesh "{name}"' + (f" (prepend apiSchemas = {json.dumps(schemas)})" if schemas else "")
    return [head, "        {", *("            " + r for r in rows), "        }"]


def _joint(link: Link, base: str) -> list[str]:
    h = link.hinge
    kind = "Revolute" if h.type == "revolute" else "Prismatic"
    lo, hi = np.degrees([h.lower, h.upper]) if kind == "Revolute" else (h.lower, h.upper)
    turn = _tuple(x_to(h))
    # angular: per degree / s
    drive, damping = ("angular", h.damping * math.pi / 180) if kind == "Revolute" else ("linear", h.damping)
    return [
        f'    def Physics{kind}Joint "joint_{link.part}" (prepend apiSchemas = ["PhysicsDriveAPI:{drive}"])',
        "    {",
        f'        uniform token drive:{drive}:physics:type = "force"',
        f"        float drive:{drive}:physics:stiffness = 0",
        f"        float drive:{drive}:physics:damping = {damping!r}",
        f"        rel physics:body0 = </twin/{base}>",
        f"        rel physics:body1 = </twin/{link.name}>",
        '        uniform token physics:axis = "X"',
        f"        point3f physics:localPos0 = {_tuple(h.origin)}",
        "        point3f physics:localPos1 = (0, 0, 0)",
        f"        quatf physics:localRot0 = {turn}",
        f"        quatf physics:localRot1 = {turn}",
        f"        float physics:lowerLimit = {float(lo)!r}",
        f"        float physics:upperLimit = {float(hi)!r}",
        "    }",
    ]


def x_to(hinge: Hinge) -> np.ndarray:
    """Quaternion wxyz [4] that turns the x axis into the joint's (USD joints have a coordinate axis and a frame)."""
    x = hinge.axis
    w = 1 + x[0]
    q = np.array([w, 0, -x[2], x[1]]) if w > 1e-9 else np.array([0.0, 0, 0, 1])
    return q / np.linalg.norm(q)


def principal(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments [3] and the quaternion wxyz of their axes."""
    from scipy.spatial.transform import Rotation

    values, axes = np.linalg.eigh(matrix)
    axes = axes * np.sign(np.linalg.det(axes))
    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    return values, np.array([w, x, y, z])


def _tuple(values) -> str:
    return "(" + ", ".join(repr(float(v)) for v in values) + ")"


def _array(rows: np.ndarray, digits: int) -> str:
    return "[" + ", ".join("(" + ", ".join(f"{v:.{digits}g}" for v in row) + ")" for row in rows) + "]"
