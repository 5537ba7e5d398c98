"""``p2gs test RUN --truth DIR``: a run of known errors in a frame and a unit of its own, written by hand."""

import json

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from p2gs.app import run as p2gs
from p2gs.data.generated.synthetic import look_at
from p2gs.gaussians.splat_ply import write_splat_ply
from p2gs.models.registered import REGISTRATION
from p2gs.scores.capture import camera_pairs, capture_lines, evaluate_capture, moved_joint
from p2gs.types import GaussianTensors, Joint, UserError

UNIT = 0.4  # metres that a unit of the capture is long
OWN = np.eye(4)  # takes the capture's coordinates to the true ones
OWN[:3, :3], OWN[:3, 3] = UNIT * Rotation.from_euler("xyz", [10, -20, 130], degrees=True).as_matrix(), (0.5, -1, 0.2)
DOOR = {"o": [-0.16, -0.44, 0.85], "d": [0.0, 0.0, 1.0]}
DRAWER = {"o": [0.04, -0.01, 0.46], "d": [2.0, 0.0, 0.0]}  # of any length
TRUTH = [
    {"axis": DOOR, "type": "rotate", "translate": {"l": 0, "r": 0}, "rotate": {"l": 10.0, "r": 70.0}},
    {"axis": DRAWER, "type": "translate", "translate": {"l": 0.01, "r": 0.24}, "rotate": {"l": 0, "r": 0}},
]
SIZE = np.array([0.6, 0.8, 0.9])  # metres, of the base


def rigid(turn, shift):
    """[4, 4] of Euler angles xyz in degrees and metres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), shift
    return T


def write_truth(folder, names):
    (folder / "gt" / "start").mkdir(parents=True)
    rng, cameras = np.random.default_rng(0), {}
    for name in names:
        view = look_at(rng.normal(size=3) + [2, 0, 1], (0, 0, 0.3))
        cameras[name] = np.linalg.inv(view) @ np.diag([1.0, -1, -1, 1])
    told = {name: pose.tolist() for name, pose in cameras.items()}
    (folder / "gt" / "cameras.json").write_text(json.dumps({"c2w": told}))
    (folder / "gt" / "trans.json").write_text(json.dumps({"trans_info": TRUTH}))
    base = trimesh.creation.box(SIZE, rigid([0, 0, 0], [0, 0, SIZE[2] / 2]))
    base.export(folder / "gt" / "start" / "start_static_rotate.ply")
    return cameras


def write_scene(folder, cameras, apart):
    """The scene as the capture has it, its end state moved by ``apart`` [4, 4] of the true world."""
    folder.mkdir()
    images = [{"state": "end", "source": "/x/IMG_0999.jpg", "file": None, "reason": "blurred"}]
    for state in ("start", "end"):
        frames = []
        for i, name in enumerate(sorted((n for n in cameras if n.startswith(state)), reverse=True)):
            own = np.linalg.inv(OWN) @ (apart if state == "end" else np.eye(4)) @ cameras[name]
            own[:3, :3] *= UNIT  # a pose has no scale
            file = f"{state}/train/rgba/{i:04d}.png"
            frames.append({"file_path": file, "transform_matrix": own.tolist()})
            images.append({"state": state, "source": f"/x/{name}.jpg", "file": file, "reason": None})
        (folder / f"transforms_train_{state}.json").write_text(json.dumps({"frames": frames}))
    (folder / "capture.json").write_text(json.dumps({"images": images}))


def twin_joint(kind, axis, origin, motion, number):
    """A part of twin.json whose joint is given in the true world, as the capture's coordinates have it."""
    R, t = OWN[:3, :3] / UNIT, OWN[:3, 3]
    length = motion if kind == "revolute" else motion / UNIT
    joint = {"type": kind, "axis": (R.T @ axis).tolist(), "origin": (R.T @ (np.array(origin) - t) / UNIT).tolist()}
    joint |= {"motion": length, "limits": [0.0, length], "transform": np.eye(4).tolist()}
    return {"id": number, "kind": "movable", "joint": joint, "gaussians": 1, "confidence": 1.0}


def write_run(folder, joints):
    (folder / "splats").mkdir(parents=True)
    parts = [{"id": 0, "kind": "static", "gaussians": 1, "confidence": 1.0}]
    parts += [twin_joint(*joint, i) for i, joint in enumerate(joints, 1)]
    twin = {"format": "p2gs-twin/1", "num_parts": len(parts), "canonical_time": 0.5, "parts": parts}
    (folder / "twin.json").write_text(json.dumps(twin))
    n = len(parts)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    splats = GaussianTensors(torch.rand(n, 3), quats, torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 1, 3))
    write_splat_ply(folder / "splats" / "canonical.ply", splats, torch.arange(n))


def tilted(about, degrees, axis):
    return Rotation.from_euler(about, degrees, degrees=True).apply(axis)


# the door's axis 2 deg askew about x and 5 mm beside, in x: the lines are 5 mm apart wherever they are followed to
FOUND_DOOR = ("revolute", tilted("x", 2, DOOR["d"]), np.array(DOOR["o"]) + [0.005, 0, 0], 61.5)
FOUND_DRAWER = ("prismatic", tilted("z", 3, [1.0, 0, 0]), np.array([7.0, 8, 9]), 0.234)


@pytest.fixture
def written(tmp_path):
    """Makes (run, truth, scene) of an end state that is ``apart`` [4, 4] and of joints as found."""

    def make(apart, joints=(FOUND_DRAWER, FOUND_DOOR)):
        cameras = write_truth(tmp_path / "truth", [f"{s}/IMG_{i:04d}" for s in ("start", "end") for i in range(9)])
        write_scene(tmp_path / "scene", cameras, apart)
        write_run(tmp_path / "run", joints)
        return tmp_path / "run", tmp_path / "truth", tmp_path / "scene"

    return make


def test_known_errors_come_out_in_metres_and_degrees(written):
    run, truth, scene = written(rigid([0, 0, 0], [0.004, 0, 0]))
    result = evaluate_capture(run, truth, scene)
    assert result["metres_per_unit"] == pytest.approx(UNIT)
    assert result["state_misalignment_mm"] == pytest.approx(4, abs=1e-4)
    joints = result["joints"]
    assert joints["failures"] == 0 and joints["extra"] == []
    door, drawer = joints["joints"]
    assert (door["pred"], drawer["pred"]) == (1, 0)
    assert door["errors"]["axis_angle"] == pytest.approx(2)
    assert door["errors"]["axis_position"] == pytest.approx(0.05)  # tenths of metres, as the tables have it
    between = Rotation.from_rotvec(np.radians(60) * np.array(DOOR["d"])).inv() * Rotation.from_rotvec(
        np.radians(FOUND_DOOR[3]) * FOUND_DOOR[1]
    )
    assert door["errors"]["motion"] == pytest.approx(np.degrees(between.magnitude()))
    assert drawer["errors"]["axis_angle"] == pytest.approx(3)
    assert drawer["errors"]["motion"] == pytest.approx(np.linalg.norm(FOUND_DRAWER[3] * FOUND_DRAWER[1] - [0.23, 0, 0]))
    assert json.loads((run / "capture_metrics.json").read_text()) == json.loads(json.dumps(result))
    lines = capture_lines(result)
    assert lines[0] == "metres per unit: 0.40000" and lines[1] == "states apart on the base: 4.00 mm"
    assert "axis 2.00 deg, axis 5.0 mm off, motion" in lines[2] and "0 failed, 0 extra" in lines[-1]


def test_a_turn_between_the_states_counts_as_far_as_the_base_reaches(written):
    """The mean way of the box's surface under the turn, from a grid on its faces."""
    apart = rigid([0.4, 0, 0.5], [0.001, 0.002, -0.001])
    run, truth, scene = written(apart)
    points, weights = [], []
    s = (np.arange(60) + 0.5) / 60 - 0.5
    for axis in range(3):
        u, v = np.meshgrid(s, s)
        for side in (-0.5, 0.5):
            face = np.insert(np.stack([u.ravel(), v.ravel()], 1), axis, side, axis=1)
            points.append(face * SIZE + [0, 0, SIZE[2] / 2])
            weights.append(np.full(len(face), SIZE.prod() / SIZE[axis]))
    points = np.concatenate(points)
    ways = np.linalg.norm(points @ apart[:3, :3].T + apart[:3, 3] - points, axis=1)
    expected = 1000 * np.average(ways, weights=np.concatenate(weights))
    assert evaluate_capture(run, truth, scene)["state_misalignment_mm"] == pytest.approx(expected, rel=0.03)


def test_what_the_run_put_right_is_not_counted(written):
    apart = rigid([0, 0, 0.5], [0.004, 0, 0])
    run, truth, scene = written(apart)
    put_right = np.linalg.inv(OWN) @ np.linalg.inv(apart) @ OWN
    kept = {"transform": put_right.tolist(), "log_gain": [0.0, 0, 0], "images": [], "figures": {}}
    (run / REGISTRATION).write_text(json.dumps(kept))
    assert evaluate_capture(run, truth, scene)["state_misalignment_mm"] == pytest.approx(0, abs=1e-4)


def test_a_joint_that_is_missing_or_of_another_type_has_failed(written):
    run, truth, scene = written(np.eye(4), [("prismatic", np.array([0.0, 0, 1]), np.zeros(3), 0.2), FOUND_DRAWER])
    result = evaluate_capture(run, truth, scene)
    assert result["joints"]["failures"] == 1 and result["joints"]["joints"][0]["errors"] is None
    assert any("joint 1 (revolute): F" in line for line in capture_lines(result))


def test_without_the_base_the_states_are_not_measured(written):
    run, truth, scene = written(np.eye(4))
    (truth / "gt" / "start" / "start_static_rotate.ply").unlink()
    assert evaluate_capture(run, truth, scene)["state_misalignment_mm"] is None


def test_the_command_prints_the_figures(written, capsys):
    run, truth, scene = written(rigid([0, 0, 0], [0.004, 0, 0]))
    assert p2gs(["test", str(run), "--truth", str(truth), "--root", str(scene)]) == 0
    assert "states apart on the base: 4.00 mm" in capsys.readouterr().out


def test_a_joint_s_motion_is_moved_with_it():
    """The full motion, applied to a point, goes where the moved joint says."""
    M = rigid([0, 0, 60], [0, 0, 0])
    joint = Joint("revolute", torch.tensor([0.0, 0, 1]), torch.zeros(3), 60.0, (0.0, 60.0), torch.tensor(M))
    point, move = np.array([1.0, 2, 3, 1]), moved_joint(joint, OWN)
    np.testing.assert_allclose(move.transform.numpy() @ OWN @ point, OWN @ M @ point, atol=1e-9)
    assert move.axis.tolist() == pytest.approx(list(OWN[:3, 2] / UNIT)) and move.motion == 60.0


def test_files_that_do_not_belong_together_are_named(written):
    _, truth, scene = written(np.eye(4))
    facts = json.loads((scene / "capture.json").read_text())
    rest = [i for i in facts["images"] if i["file"] != "end/train/rgba/0003.png"]
    (scene / "capture.json").write_text(json.dumps({"images": rest}))
    with pytest.raises(UserError, match=r"capture.json: has no image 'end/train/rgba/0003.png', which transforms_t"):
        camera_pairs(scene, truth / "gt")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("scene/capture.json", "{}", "no readable 'images'"),
        ("scene/capture.json", '{"images": [{"file": "a.png"}]}', "an image has no 'file' and 'source'"),
        ("scene/transforms_train_end.json", '{"frames": 3}', "no readable 'frames'"),
        ("scene/transforms_train_end.json", '{"frames": [7]}', "has no image None"),
        ("truth/gt/cameras.json", "[", "no readable 'c2w'"),
        ("truth/gt/cameras.json", '{"c2w": {}}', "knows 0 photographs of state 'start', expected at least 3"),
        ("truth/gt/cameras.json", '{"c2w": {"start/IMG_0002": [[1, 2]]}}', "start/IMG_0002: camera pose is not a 4x4"),
        ("truth/gt/trans.json", "{}", "no readable 'trans_info'"),
    ],
)
def test_a_broken_file_is_named(written, tmp_path, name, content, message):
    run, truth, scene = written(np.eye(4))
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError) as caught:
        evaluate_capture(run, truth, scene)
    assert message in str(caught.value)
    assert str(tmp_path / name).removesuffix("/transforms_train_end.json") in str(caught.value)
