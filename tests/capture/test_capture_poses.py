"""COLMAP and nerfstudio files are read and written without pycolmap, from small files made here."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.joint import state_bias
from p2gs.data.capture.model import Lens, Model, Photo, similarity
from p2gs.data.capture.photos import copy_photos
from p2gs.data.capture.poses import MAX_POINTS, MIN_REGISTERED, onto_copies, read_poses
from p2gs.data.capture.static import check_joint_support, loose_poses
from p2gs.data.generated.synthetic import look_at
from p2gs.types import UserError

LENS = Lens("OPENCV", 320, 240, np.array([300.0, 302, 161, 119, -0.05, 0.01, 0.001, -0.001]))


def small_model(per_state=8, points=60, names="{state}/{i}.jpg"):
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1.5, 1.5, (points, 3))
    photos, key = {}, 0
    model = Model(
        {3: LENS}, photos, np.arange(10, 10 + points), xyz, rng.integers(0, 255, (points, 3)).astype(np.uint8)
    )
    for s, state in enumerate(("start", "end")):
        for i in range(per_state):
            key += 1
            angle = 2.4 * i / per_state - 1.2 + 0.05 * s
            photos[key] = Photo(
                names.format(state=state, i=i),
                3,
                look_at(np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2]), (0, 0, 0.4)),
            )
            pixels = model.pixels_of(key, xyz)
            inside = (pixels > 0).all(1) & (pixels < [320, 240]).all(1)
            photos[key].xy, photos[key].point = pixels[inside], model.ids[inside]
    return model


def same(a: Model, b: Model):
    assert a.photos.keys() == b.photos.keys()
    for key in a.photos:
        assert a.photos[key].name == b.photos[key].name
        np.testing.assert_allclose(a.photos[key].viewmat, b.photos[key].viewmat, atol=1e-9)
        np.testing.assert_allclose(a.photos[key].xy, b.photos[key].xy, atol=1e-9)
        np.testing.assert_array_equal(a.photos[key].point, b.photos[key].point)
    np.testing.assert_array_equal(a.ids, b.ids)
    np.testing.assert_allclose(a.xyz, b.xyz)
    np.testing.assert_array_equal(a.rgb, b.rgb)


def write_text(model, folder):
    folder.mkdir()
    lines = ["# cameras"] + [
        f"{k} {c.model} {c.width} {c.height} " + " ".join(map(repr, map(float, c.params)))
        for k, c in model.lenses.items()
    ]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# images"]
    for key, p in model.photos.items():
        quat = np.roll(Rotation.from_matrix(p.viewmat[:3, :3]).as_quat(), 1)
        lines.append(
            " ".join(map(repr, [key, *map(float, quat), *map(float, p.viewmat[:3, 3]), p.lens])) + f" {p.name}"
        )
        lines.append(" ".join(f"{float(x)!r} {float(y)!r} {i}" for (x, y), i in zip(p.xy, p.point, strict=True)))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} " + " ".join(map(repr, map(float, x))) + " " + " ".join(map(str, c)) + " 0.5"
            for i, x, c in zip(model.ids, model.xyz, model.rgb, strict=True)]  # fmt: skip
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def test_colmap_binary_goes_round(tmp_path):
    model = small_model()
    write_model(model, tmp_path / "sparse/0")
    same(model, read_poses(tmp_path))


def test_colmap_text_is_read(tmp_path):
    model = small_model()
    write_text(model, tmp_path / "text")
    same(model, read_model(tmp_path / "text"))


def test_pycolmap_reads_what_is_written(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model = small_model()
    write_model(model, tmp_path)
    read = pycolmap.Reconstruction(str(tmp_path))
    assert read.num_reg_images() == 16
    assert read.compute_mean_reprojection_error() < 1e-6
    read.write_binary(str(tmp_path))
    same(model, read_model(tmp_path))


def test_a_file_cut_short_is_named(tmp_path):
    write_model(small_model(), tmp_path)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(UserError, match="images.bin"):
        read_model(tmp_path)


def transforms(model, applied=None):
    A = np.eye(4)
    if applied is not None:
        A[:3] = applied
    frames = []
    for p in model.photos.values():
        c2w = np.linalg.inv(p.viewmat)
        c2w[:3, 1:3] *= -1
        frames.append({"file_path": p.name, "transform_matrix": (A @ c2w).tolist()})
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    meta = dict(zip(names, map(float, LENS.params), strict=True)) | {
        "w": 320,
        "h": 240,
        "camera_model": "OPENCV",
        "frames": frames,
    }
    return meta | ({} if applied is None else {"applied_transform": applied})


@pytest.mark.parametrize(
    "applied", [None, [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 3]]]
)
def test_nerfstudio_poses_come_back_to_their_own_frame(tmp_path, applied):
    model = small_model()
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(model, applied)))
    read = read_poses(tmp_path)
    for a, b in zip(model.photos.values(), read.photos.values(), strict=True):
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-9)
        np.testing.assert_allclose(read.lenses[b.lens].params, LENS.params)


@pytest.mark.parametrize("applied", [None, [[0, 1, 0, 1], [1, 0, 0, 2], [0, 0, -1, 3]]])
@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_of_a_ply_file_lie_in_the_frame_of_its_poses(tmp_path, applied, encoding):
    """The cloud as nerfstudio writes it, after applied_transform, is seen where the photographs saw its points."""
    model, meta = small_model(), transforms(small_model(), applied)
    A = np.eye(4) if applied is None else np.vstack([applied, [0, 0, 0, 1]])
    cloud = trimesh.PointCloud(model.xyz @ A[:3, :3].T + A[:3, 3])
    (tmp_path / "sparse_pc.ply").write_bytes(cloud.export(file_type="ply", encoding=encoding))
    (tmp_path / "transforms.json").write_text(json.dumps(meta | {"ply_file_path": "sparse_pc.ply"}))
    read = read_poses(tmp_path)
    assert len(read.ids) == 60 and (np.diff(read.ids) > 0).all() and read.ids[0] > 0
    photo = model.photos[5]
    rows = np.searchsorted(model.ids, photo.point)
    assert np.abs(read.pixels_of(5, read.xyz[rows]) - photo.xy).max() < 0.01  # the file has single precision
    assert not any(len(p.point) for p in read.photos.values())


def test_a_cloud_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(transforms(small_model()) | {"ply_file_path": "points/p.ply"}))
    with pytest.raises(UserError, match=r"transforms.json: its ply_file_path 'points/p.ply' is no file beside it"):
        read_poses(tmp_path)
    (tmp_path / "points").mkdir()
    (tmp_path / "points/p.ply").write_text("no ply")
    with pytest.raises(UserError, match=r"p.ply: cannot be read as PLY"):
        read_poses(tmp_path)
    path.write_text(json.dumps(transforms(small_model()) | {"ply_file_path": 3}))
    with pytest.raises(UserError, match="its ply_file_path 3 is no file"):
        read_poses(tmp_path)


def test_a_scanner_s_cloud_is_thinned(tmp_path):
    xyz = np.random.default_rng(0).normal(size=(MAX_POINTS + 5000, 3))
    xyz[:100] = np.nan
    trimesh.PointCloud(xyz).export(tmp_path / "all.ply")
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(small_model()) | {"ply_file_path": "all.ply"}))
    read = read_poses(tmp_path)
    assert len(read.xyz) == MAX_POINTS == len(read.ids) == len(read.rgb) and np.isfinite(read.xyz).all()


def copies(folder, per_state=8, size=(240, 320), states=("start", "end")):
    """Photographs of both states as they are copied."""
    image = np.random.default_rng(1).integers(0, 255, (*size, 3)).astype(np.uint8)
    shots = []
    for state, name in zip(("start", "end"), states, strict=True):
        (folder / name).mkdir()
        for i in range(per_state):
            cv2.imwrite(str(folder / name / f"{i}.jpg"), image)
        shots += copy_photos(folder / name, state, folder / "copies", 1600, 60)
    return shots


def test_poses_are_brought_to_the_copies_of_another_size(tmp_path):
    shots = copies(tmp_path, size=(480, 640))
    found = onto_copies(small_model(), shots, tmp_path / "start", tmp_path / "end")
    assert sorted(p.name for p in found.photos.values()) == sorted(s.name for s in shots)
    assert found.errors()[2].max() < 1e-6  # keypoints and lens were scaled alike


def test_copies_of_one_lens_keep_their_own_sizes(tmp_path):
    shots = copies(tmp_path)
    cv2.imwrite(str(tmp_path / "start/3.jpg"), np.random.default_rng(1).integers(0, 255, (480, 640, 3)))
    shots = copy_photos(tmp_path / "start", "start", tmp_path / "copies", 1600, 60) + shots[8:]
    found = onto_copies(small_model(), shots, tmp_path / "start", tmp_path / "end")
    assert sorted(found.lenses[p.lens].width for p in found.photos.values()) == [320] * 15 + [640]
    assert found.errors()[2].max() < 1e-6


def test_names_of_both_states_need_folders(tmp_path):
    shots = copies(tmp_path, states=("shut", "open"))
    with pytest.raises(UserError, match="either state"):
        onto_copies(small_model(names="{i}.jpg"), shots, tmp_path / "shut", tmp_path / "open")


def test_nine_tenths_of_a_state_need_poses(tmp_path):
    shots = copies(tmp_path, per_state=20)
    folders = (tmp_path / "start", tmp_path / "end")

    def without(*left_out):
        model = small_model(per_state=20)
        return replace(model, photos={k: p for k, p in model.photos.items() if p.name not in left_out})

    assert len(onto_copies(without("start/3.jpg", "start/4.jpg"), shots, *folders).photos) == 38
    with pytest.raises(UserError) as caught:
        onto_copies(without(*(f"end/{i}.jpg" for i in (2, 5, 7, 11))), shots, *folders)
    assert str(caught.value) == (
        f"{tmp_path / 'end'}: the poses name only 16 of its 20 photographs, not 2.jpg, 5.jpg, 7.jpg and others; "
        "expected at least 90 %: take those without a pose out of the folder, or solve the poses with all of them"
    )
    with pytest.raises(UserError, match="end: the poses name none or only one of its photographs"):
        onto_copies(without(*(f"end/{i}.jpg" for i in range(20))), shots, *folders)
    few = [s for s in shots if s.name.startswith("end") or int(s.name[6:10]) < MIN_REGISTERED - 1]
    with pytest.raises(UserError, match="start: the poses name 7 of its photographs, expected at least 8"):
        onto_copies(without(), few, *folders)


def test_the_pose_of_a_photograph_left_out_is_not_its_namesake_s(tmp_path):
    shots, model = copies(tmp_path, per_state=10), small_model(per_state=10)
    shots = [s for s in shots if s.name != "start/0007.jpg"]  # blurred
    found = onto_copies(model, shots, tmp_path / "start", tmp_path / "end")
    assert sorted(p.name for p in found.photos.values()) == sorted(s.name for s in shots)
    views = {p.name: p.viewmat for p in found.photos.values()}
    np.testing.assert_array_equal(views["end/0007.jpg"], model.photos[18].viewmat)


def test_two_poses_of_one_photograph_are_refused(tmp_path):
    model = small_model()
    model.photos[2] = replace(model.photos[2], name="more/start/1.jpg")
    model.photos[3] = replace(model.photos[3], name="start/1.jpg")
    with pytest.raises(UserError, match=r"more/start/1.jpg and start/1.jpg both name .*1.jpg; expected one pose"):
        onto_copies(model, copies(tmp_path), tmp_path / "start", tmp_path / "end")


def test_a_video_has_no_names_for_poses(tmp_path):
    shots = copies(tmp_path)
    video = tmp_path / "open.mp4"
    video.write_bytes(b"")
    with pytest.raises(UserError, match=r"open.mp4: is a video, .* expected a folder of the frames"):
        onto_copies(small_model(), shots, tmp_path / "start", video)


def test_points_that_nobody_observes_stay_and_say_nothing_of_the_states(tmp_path):
    """Exporters write clouds without tracks, and so is a ply file; points of photographs that are not here go."""
    shots, model = copies(tmp_path), small_model()
    model.photos[99] = replace(
        model.photos[1], name="elsewhere/x.jpg", point=np.array([model.ids[0]]), xy=np.ones((1, 2))
    )
    for key in range(1, 17):
        model.photos[key] = replace(model.photos[key], point=model.photos[key].point[:0], xy=model.photos[key].xy[:0])
    found = onto_copies(model, shots, tmp_path / "start", tmp_path / "end")
    np.testing.assert_array_equal(found.ids, model.ids[1:])
    assert check_joint_support(found) == {"points": 0}
    assert "too few points are seen in both states" in (loose_poses(found) or "")
    assert state_bias(found).points == 0


def test_similarity_is_found_exactly():
    rng = np.random.default_rng(2)
    a = rng.normal(size=(9, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 1.7 * Rotation.random(random_state=0).as_matrix(), (1, 2, 3)
    np.testing.assert_allclose(similarity(a, a @ T[:3, :3].T + T[:3, 3]), T, atol=1e-9)
