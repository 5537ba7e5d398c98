"""Reading trans.json: one joint or several, units, signs, and what is wrong with a file."""

import json

import pytest
import torch

from p2gs.data.ground_truth import load_ground_truth, parse_joint, rotation_about
from p2gs.types import UserError

HINGE = {
    "axis": {"o": [1, 0, 0], "d": [0, 0, 2]},
    "type": "rotate",
    "rotate": {"l": 10, "r": 100},
    "translate": {"l": 0, "r": 0},
}
SLIDE = {"axis": {"o": [0, 0, 0], "d": [0, 3, 0]}, "type": "translate", "translate": {"l": 0.5, "r": 0.2}}


def test_joint_is_the_signed_motion_from_start_to_end():
    hinge = parse_joint(HINGE, "x")
    assert (hinge.type, hinge.motion, hinge.limits) == ("revolute", 90.0, (0.0, 90.0))
    # one unit right of the axis: a quarter turn about z moves it to y = 1
    x = torch.tensor([2.0, 0, 5, 1], dtype=torch.float64)
    torch.testing.assert_close(hinge.transform @ x, torch.tensor([1.0, 1, 5, 1], dtype=torch.float64))
    assert hinge.axis.tolist() == [0, 0, 1]
    slide = parse_joint(SLIDE, "x")
    assert (
        slide.type == "prismatic" and slide.motion == pytest.approx(-0.3) and slide.limits == (pytest.approx(-0.3), 0.0)
    )
    assert slide.transform[:3, 3].tolist() == [0, pytest.approx(-0.3), 0]


def test_rotation_equals_the_matrix_exponential():
    axis = torch.nn.functional.normalize(torch.randn(3, dtype=torch.float64), dim=0)
    origin = torch.randn(3, dtype=torch.float64)
    cross = torch.linalg.cross(
        torch.eye(3, dtype=torch.float64), axis.expand(3, 3)
    ).T  # columns e_i x a: minus the cross matrix
    twist = torch.zeros(4, 4, dtype=torch.float64)
    twist[:3, :3] = -cross
    twist[:3, 3] = cross @ origin
    angle = torch.tensor(-77.0, dtype=torch.float64).deg2rad()
    torch.testing.assert_close(rotation_about(axis, origin, -77.0), torch.linalg.matrix_exp(angle * twist))


@pytest.mark.parametrize("info, motions", [(HINGE, [90.0]), ([HINGE], [90.0]), ([HINGE, SLIDE], [90.0, -0.3])])
def test_dict_or_list(written, copy_of, info, motions):
    root = copy_of("dta")
    (root / "gt/trans.json").write_text(json.dumps({"trans_info": info, "input": {}}))
    truth = load_ground_truth(root)
    assert [j.motion for j in truth.joints] == pytest.approx(motions)
    # one joint: "_dynamic_rotate"; two joints would need numbered meshes, which are not there
    assert len(truth.start.dynamic) == (1 if len(motions) == 1 else 0)
    assert truth.meshes(1).whole.name == "end_rotate.ply"


@pytest.mark.parametrize("format", ["artgs", "dta", "paris"])
def test_every_layout_has_its_ground_truth(written, format):
    truth = load_ground_truth(str(written[format]), format)
    assert len(truth.joints) == len(truth.end.dynamic) == 1 and truth.start.static.is_file()
    assert load_ground_truth(written[format]).joints[0].motion == truth.joints[0].motion
    if format == "paris":
        inside = load_ground_truth(written[format] / "load")
        assert inside.folder.name == "textured_objs" and inside.joints[0].motion == truth.joints[0].motion


def test_none_where_there_is_none(tmp_path, copy_of):
    root = copy_of("artgs")
    (root / "gt/trans.json").unlink()
    assert load_ground_truth(root) is None and load_ground_truth(tmp_path / "nothing") is None


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("{", "has no readable 'trans_info'"),
        ("[]", "has no readable 'trans_info'"),
        ('{"trans_info": {"type": "rotate"}}', "joint 0 does not describe a joint"),
        (
            json.dumps({"trans_info": [HINGE, {**HINGE, "type": "screw", "screw": {"l": 0, "r": 1}}]}),
            "joint 1 needs the type rotate or translate",
        ),
        (json.dumps({"trans_info": {**HINGE, "axis": {"o": [0, 0, 0], "d": [0, 0, 0]}}}), "an axis of some length"),
        (
            json.dumps({"trans_info": {**HINGE, "axis": {"o": [0, 0], "d": [0, 0, 1]}}}),
            "joint 0 does not describe a joint",
        ),
    ],
)
def test_broken_file_is_told(copy_of, text, sentence):
    root = copy_of("artgs")
    (root / "gt/trans.json").write_text(text)
    with pytest.raises(UserError, match="trans.json") as raised:
        load_ground_truth(root)
    assert sentence in str(raised.value)


def test_training_does_not_import_it(repo):
    """Ground truth is for scoring: neither the models nor the pipeline nor the readers name the module."""
    readers = [
        repo / "p2gs/data" / f"{n}.py"
        for n in ("base", "modules", "images", "views", "box", "frames", "artgs", "dta", "paris")
    ]
    training = [
        *readers,
        *(repo / "p2gs/models").glob("*.py"),
        *(repo / "p2gs/losses").glob("*.py"),
        *repo.glob("p2gs/pipeline*.py"),
    ]
    assert len(training) > 15
    assert [
        p.name for p in training if "ground_truth import" in p.read_text() or "import ground_truth" in p.read_text()
    ] == []
