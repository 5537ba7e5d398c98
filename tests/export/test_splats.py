"""Splat PLY, poses and twin.json on the hand-made cabinet."""

import json
import math

import numpy as np
import pytest
import torch
from toy import toy_twin

from p2gs.gaussians.frame import camera_to_input, object_to_input
from p2gs.gaussians.splat_ply import read_splat_ply, splat_dtype, write_splat_ply
from p2gs.types import GaussianTensors, Similarity, UserError

SIM = Similarity(2.5, (0.3, -0.2, 1.0))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splat_ply_round_trip(tmp_path, degree):
    g = torch.Generator().manual_seed(degree)
    n, b = 17, (degree + 1) ** 2
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=-1)
    a = GaussianTensors(
        torch.randn(n, 3, generator=g),
        quats,
        torch.randn(n, 3, generator=g),
        torch.randn(n, generator=g),
        torch.randn(n, b, 3, generator=g),
    )
    ids = torch.randint(0, 4, (n,), generator=g)
    write_splat_ply(tmp_path / "a.ply", a, ids)
    back, back_ids = read_splat_ply(tmp_path / "a.ply")
    for name in GaussianTensors.NAMES:
        assert torch.allclose(getattr(back, name), getattr(a, name), atol=1e-6), name
    assert torch.equal(back_ids, ids)


def test_splat_ply_layout_is_the_public_one(tmp_path):
    """Column order and channel-major f_rest as viewers expect, told by an independent PLY reader."""
    import trimesh

    twin = toy_twin()
    write_splat_ply(tmp_path / "a.ply", twin.gaussians, twin.part_ids)
    raw = trimesh.load(tmp_path / "a.ply", process=False).metadata["_ply_raw"]["vertex"]
    names = list(raw["properties"])
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[-9:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "part_id"]
    assert np.allclose(raw["data"]["f_rest_3"], twin.gaussians.sh[:, 1, 1])  # green starts after red's three
    assert np.array_equal(raw["data"]["part_id"], twin.part_ids)


def test_splat_reader_names_the_mistake(tmp_path):
    twin = toy_twin()
    path = tmp_path / "a.ply"
    write_splat_ply(path, twin.gaussians)
    assert read_splat_ply(path)[1] is None
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(UserError, match="ends early"):
        read_splat_ply(path)
    path.write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(UserError, match="binary little-endian"):
        read_splat_ply(path)
    rows = np.zeros(1, [(n, "<f4") for n in splat_dtype(1, False).names if n != "scale_1"])
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + "".join(
        f"property float {n}\n" for n in rows.dtype.names
    )
    path.write_bytes((head + "end_header\n").encode() + rows.tobytes())
    with pytest.raises(UserError, match="'scale_1' is missing"):
        read_splat_ply(path)


def test_export_comes_back_in_input_coordinates():
    """The same cabinet stored under two similarities is one and the same in input coordinates."""
    a, b = object_to_input(toy_twin()), object_to_input(toy_twin(SIM))
    for name in GaussianTensors.NAMES:
        assert torch.allclose(getattr(a.gaussians, name), getattr(b.gaussians, name), atol=1e-5), name
    for p, q in zip(a.parts[1:], b.parts[1:], strict=True):
        assert torch.allclose(p.joint.transform, q.joint.transform, atol=1e-12)
        assert torch.allclose(p.joint.origin, q.joint.origin, atol=1e-12)
        assert math.isclose(p.joint.motion, q.joint.motion, rel_tol=1e-12)
        assert np.allclose(p.joint.limits, q.joint.limits)


def test_cameras_see_the_same_pixels_in_input_coordinates():
    from toy import toy_scene

    x = torch.tensor([0.1, -0.3, 0.4])
    for view in toy_scene(SIM, n=3).views:
        inner, outer = view.camera, camera_to_input(view.camera, SIM)
        p = inner.viewmat[:3, :3] @ SIM.to_internal(x) + inner.viewmat[:3, 3]
        q = outer.viewmat[:3, :3] @ x + outer.viewmat[:3, 3]
        assert torch.allclose(p / SIM.scale, q, atol=1e-5)


def test_pose_moves_each_part_along_its_screw():
    from p2gs.gaussians.pose import pose

    twin = toy_twin(SIM)
    for t in (-0.5, 0.0, 0.3, 1.0, 1.4):
        moved = pose(twin, t).means
        for part in twin.parts:
            mask = twin.part_ids == part.id
            x, y = SIM.to_input(twin.gaussians.means[mask]).double(), SIM.to_input(moved[mask]).double()
            if part.id == 0:
                want = x
            elif part.id == 1:  # 70 degrees about z through (-0.49, -0.43), negative sense
                a = math.radians(-70 * t)
                R = torch.tensor(
                    [[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]], dtype=torch.float64
                )
                o = torch.tensor([-0.49, -0.43, 0], dtype=torch.float64)
                want = (x - o) @ R.T + o
            else:
                want = x + torch.tensor([0, -0.4 * t, 0], dtype=torch.float64)
            assert torch.allclose(y, want, atol=1e-5), (t, part.id)


def test_pose_from_another_canonical_time_gives_the_same_states():
    from p2gs.gaussians.pose import pose

    start = toy_twin(sh_degree=2)
    middle = toy_twin(sh_degree=2, canonical_time=0.4)
    middle.gaussians = pose(start, 0.4)
    for t in (0.0, 0.4, 1.0):
        a, b = pose(start, t), pose(middle, t)
        assert torch.allclose(a.means, b.means, atol=1e-5)
        assert torch.allclose((a.quats * b.quats).sum(-1).abs(), torch.ones(len(a)), atol=1e-5)
        assert torch.allclose(a.sh, b.sh, atol=1e-5)


def test_pose_takes_one_time_per_part():
    from p2gs.gaussians.pose import pose

    twin = toy_twin()
    one = pose(twin, [0.0, 0.0, 1.0])
    assert torch.allclose(one.means[twin.part_ids == 1], pose(twin, 0.0).means[twin.part_ids == 1])
    assert torch.allclose(one.means[twin.part_ids == 2], pose(twin, 1.0).means[twin.part_ids == 2])
    with pytest.raises(ValueError, match="state times"):
        pose(twin, [0.0, 1.0])


def test_posed_colours_do_not_change_with_the_part():
    """Seen from a camera that moves along with the door, the door looks the same."""
    from p2gs.gaussians.pose import part_transform, pose
    from p2gs.ops.sh import evaluate

    twin = toy_twin(sh_degree=3)
    door = twin.part_ids == 1
    T = part_transform(twin, 1, 1.0).float()
    dirs = torch.nn.functional.normalize(
        torch.randn(int(door.sum()), 3, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    before = evaluate(twin.gaussians.sh[door], dirs)
    after = evaluate(pose(twin, 1.0).sh[door], dirs @ T[:3, :3].T)
    assert torch.allclose(before, after, atol=1e-4)


def test_twin_json_is_the_contract_and_loads_back(tmp_path):
    from p2gs.gaussians.twin_json import load_twin, write_twin_json

    twin = toy_twin(SIM)
    write_twin_json(twin, tmp_path / "twin.json")
    outer = object_to_input(twin)
    write_splat_ply(tmp_path / "splats" / "canonical.ply", outer.gaussians, outer.part_ids)
    data = json.loads((tmp_path / "twin.json").read_text())
    assert data["format"] == "p2gs-twin/1" and data["num_parts"] == 3 and data["parts"][0]["kind"] == "static"
    door, drawer = data["parts"][1]["joint"], data["parts"][2]["joint"]
    assert (
        door["type"] == "revolute"
        and math.isclose(door["motion"], -70)
        and np.allclose(door["origin"], [-0.49, -0.43, 0])
    )
    assert (
        drawer["type"] == "prismatic"
        and math.isclose(drawer["motion"], 0.4)
        and np.allclose(drawer["limits"], [0, 0.4])
    )
    assert np.allclose(np.array(drawer["transform"])[:3, 3], [0, -0.4, 0])
    assert data["parts"][1]["gaussians"] == int((twin.part_ids == 1).sum())

    back = load_twin(tmp_path)
    assert back.similarity == Similarity() and back.canonical_time == 0.0
    assert torch.allclose(back.gaussians.means, outer.gaussians.means) and torch.equal(back.part_ids, twin.part_ids)
    for p, q in zip(back.parts[1:], outer.parts[1:], strict=True):
        assert torch.equal(p.joint.transform, q.joint.transform) and p.confidence == q.confidence

    with pytest.raises(UserError, match="no finished run"):
        load_twin(tmp_path / "nowhere")
    (tmp_path / "twin.json").write_text('{"format": "other"}')
    with pytest.raises(UserError, match="expected 'p2gs-twin/1'"):
        load_twin(tmp_path)
