"""Parts are called what a person would call them, whichever axis is up; names reach every file and never the run's
own."""

import json

import numpy as np
import pytest
import trimesh
from boxed import boxed_run
from test_clearance import slide, turn

from p2gs.app import run as p2gs
from p2gs.export.asset import Asset
from p2gs.export.formats import export_run
from p2gs.export.links import Hinge, Link
from p2gs.export.naming import parse_names, with_names
from p2gs.export.physics.inertia import Inertia
from p2gs.ops.mesh import Mesh
from p2gs.types import UserError

CYCLE = {
    "z": np.eye(3),
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


def shown(name, lo, hi, hinge=None, up="z") -> Link:
    """A box of surface in world axes at the start, z up, turned so that ``up`` is."""
    R = CYCLE[up]
    mesh = trimesh.creation.box(bounds=[lo, hi]).subdivide().subdivide().subdivide()
    at = np.zeros(3) if hinge is None else hinge.origin
    visual = Mesh((mesh.vertices - at) @ R.T, np.array(mesh.faces), np.full((len(mesh.vertices), 3), 128, np.uint8))
    if hinge is not None:
        hinge = Hinge(hinge.type, R @ hinge.axis, R @ at, hinge.lower, hinge.upper, hinge.motion, 1.0)
    return Link(
        name, int(name[-1]) if hinge else 0, visual, [], Inertia(1.0, np.zeros(3), np.eye(3)), hinge, (0.5, 0.5, 0.5)
    )


BODY = ((-0.5, -0.4, -0.5), (0.5, 0.4, 0.5))
PARTS = {
    "drawer": ((-0.4, -0.42, 0.1), (0.4, 0.3, 0.4), slide((0, -1, 0), 0.4)),
    "drawer of which the front alone was seen": ((-0.4, -0.42, 0.1), (0.4, -0.4, 0.4), slide((0, -1, 0), 0.4)),
    "drawer that is a board": ((-0.4, -0.42, 0.1), (0.4, 0.3, 0.12), slide((0, -1, 0), 0.4)),
    "door": ((-0.49, -0.44, -0.49), (0.49, -0.41, 0.49), turn((0, 0, 1), (-0.49, -0.42, 0), -1.2)),
    "door that slides": ((-0.49, -0.44, -0.49), (0.0, -0.41, 0.49), slide((1, 0, 0), 0.4)),
    "lid": ((-0.5, -0.4, 0.5), (0.5, 0.4, 0.53), turn((1, 0, 0), (0, 0.4, 0.5), -1.3)),
    "lid photographed open first": ((-0.5, 0.4, 0.5), (0.5, 0.43, 1.3), turn((1, 0, 0), (0, 0.4, 0.5), np.pi / 2)),
    "lid that is lifted": ((-0.5, -0.4, 0.45), (0.5, 0.4, 0.55), slide((0, 0, 1), 0.3)),
    "flap": ((-0.49, -0.44, 0.1), (0.49, -0.41, 0.49), turn((1, 0, 0), (0, -0.41, 0.1), 1.5)),
    "flap photographed open first": ((-0.49, -0.8, 0.1), (0.49, -0.41, 0.13), turn((1, 0, 0), (0, -0.41, 0.1), -1.5)),
    "knob": ((-0.05, -0.45, 0.3), (0.05, -0.4, 0.4), turn((0, 1, 0), (0, -0.4, 0.35), 1.0)),
    "button": ((-0.05, -0.45, 0.3), (0.05, -0.4, 0.4), slide((0, 1, 0), 0.02)),
    "wheel": ((-0.6, -0.3, -0.3), (-0.5, 0.3, 0.3), turn((1, 0, 0), (-0.5, 0, 0), 1.0)),
}


@pytest.mark.parametrize("up", CYCLE)
@pytest.mark.parametrize("case", PARTS)
def test_a_part_is_called_what_it_is(case, up):
    lo, hi, hinge = PARTS[case]
    asset = Asset("cabinet", [shown("base", *BODY, up=up), shown("part_1", lo, hi, hinge, up)], up)
    base, part = with_names(asset).links
    assert part.name == part.label == case.split()[0]
    assert (base.name, base.label) == ("base", "body")


def test_names_are_single_and_the_users_word_holds():
    links = [shown("base", *BODY)]
    links += [
        shown(f"part_{i}", (-0.4, -0.42, z), (0.4, 0.3, z + 0.1), slide((0, -1, 0), 0.4))
        for i, z in ((1, 0.1), (2, 0.3))
    ]
    links += [shown("part_3", *PARTS["door"][:2], PARTS["door"][2])]
    asset = Asset("cabinet", links, "z", [("part_1", "part_3")], {"part_2": 0.1})
    named = with_names(asset)
    assert [link.name for link in named.links] == ["base", "drawer_1", "drawer_2", "door"]
    assert named.blocking == [("drawer_1", "door")] and named.lost == {"drawer_2": 0.1}
    given = with_names(asset, {"part_3": "drawer_2", "base": "desk"})
    assert [link.name for link in given.links] == ["desk", "drawer_1", "drawer_3", "drawer_2"]
    assert [link.label for link in given.links] == ["desk", "drawer", "drawer", "drawer_2"]
    with pytest.raises(UserError, match="no such part; the twin has base, part_1, part_2, part_3"):
        with_names(asset, {"part_7": "door"})


@pytest.mark.parametrize(
    "word, told", [("door", "expected PART=NAME"), ("part_1=2nd", "no digit comes first"), ("part_1=a b", "letters")]
)
def test_a_wrong_name_gets_a_sentence(word, told):
    with pytest.raises(UserError, match=told):
        parse_names([word])
    with pytest.raises(UserError, match="has a name already"):
        parse_names(["part_1=door", "part_1=lid"])


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory):
    return boxed_run(tmp_path_factory.mktemp("cabinet"))


def test_names_reach_every_file_and_not_the_runs_own(cabinet, tmp_path, capsys):
    import mujoco
    import yourdfpy

    assert p2gs(["export", str(cabinet), "--name", "--format", "urdf"]) == 2
    assert "give another folder with --out" in capsys.readouterr().err
    words = ["--format", "urdf", "mjcf", "glb", "usd", "--name", "part_2=tray", "--out", str(tmp_path)]
    assert p2gs(["export", str(cabinet), *words]) == 0
    want = {"base", "door", "tray"}
    robot = yourdfpy.URDF.load(str(tmp_path / "twin.urdf"))
    assert set(robot.link_map) == want and robot.joint_map["joint_2"].child == "tray"
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "twin.xml"))
    assert {model.body(i).name for i in range(model.nbody)} == {"world", *want}
    assert want <= set(trimesh.load(tmp_path / "twin.glb").graph.nodes)
    export_run(cabinet, ["urdf"])
    own = yourdfpy.URDF.load(str(cabinet / "twin.urdf"))
    assert set(own.link_map) == {"base", "part_1", "part_2"}
    assert json.loads((cabinet / "twin.json").read_text())["parts"][1]["id"] == 1


def test_usd_carries_labels_that_openusd_reads(cabinet, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom

    UsdSemantics = pytest.importorskip("pxr.UsdSemantics", reason="usd-core before 24.11 knows no labels")
    export_run(cabinet, ["usd"], tmp_path, names={})
    stage = Usd.Stage.Open(str(tmp_path / "twin.usda"))
    got = {}
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh) and prim.GetName() == "visual":
            got[prim.GetParent().GetName()] = list(UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get())
    assert got == {"base": ["body"], "door": ["door"], "drawer": ["drawer"]}
