"""COLMAP and nerfstudio files are read and written without pycolmap, from small files made here."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.model import Lens, Model, Photo, similarity
from p2gs.data.capture.photos import copy_photos
from p2gs.data.capture.poses import onto_copies, read_poses
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


def test_poses_are_brought_to_the_copies_of_another_size(tmp_path):
    model = small_model()
    image = np.random.default_rng(1).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    shots = []
    for state in ("start", "end"):
        (tmp_path / state).mkdir()
        for i in range(8):
            cv2.imwrite(str(tmp_path / state / f"{i}.jpg"), image)
        shots += copy_photos(tmp_path / state, state, tmp_path / "copies", 1600, 60)
    found = onto_copies(model, shots, tmp_path / "start", tmp_path / "end")
    assert sorted(p.name for p in found.photos.values()) == sorted(s.name for s in shots)
    assert found.errors()[2].max() < 1e-6  # keypoints and lens were scaled alike


def test_names_of_both_states_need_folders(tmp_path):
    model = small_model(names="{i}.jpg")
    shots = []
    for state in ("shut", "open"):
        (tmp_path / state).mkdir()
        for i in range(8):
            cv2.imwrite(str(tmp_path / state / f"{i}.jpg"), np.full((240, 320, 3), i, np.uint8))
    for state, folder in (("start", "shut"), ("end", "open")):
        shots += copy_photos(tmp_path / folder, state, tmp_path / "copies", 1600, 60)
    with pytest.raises(UserError, match="either state"):
        onto_copies(model, shots, tmp_path / "shut", tmp_path / "open")


def test_similarity_is_found_exactly():
    rng = np.random.default_rng(2)
    a = rng.normal(size=(9, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 1.7 * Rotation.random(random_state=0).as_matrix(), (1, 2, 3)
    np.testing.assert_allclose(similarity(a, a @ T[:3, :3].T + T[:3, 3]), T, atol=1e-9)
