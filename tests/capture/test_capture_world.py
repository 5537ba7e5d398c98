"""The scene's frame and size by its masks: with a floor that points show, and without one; the command on poses of
several cameras."""

import itertools
import json

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from p2gs.app import run
from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.frame import floor_of, to_world
from p2gs.data.capture.model import Lens, Model, Photo, similarity
from p2gs.data.capture.world import box_of, check_floor, oriented, scaled
from p2gs.data.generated.synthetic import look_at
from p2gs.types import UserError

LENS = Lens("PINHOLE", 320, 240, np.array([280.0, 280, 160, 120]))
LOW, HIGH = np.array([-0.3, -0.3, 0.0]), np.array([0.3, 0.3, 0.7])  # metres; the object stands on the floor z = 0


def captured(points: int = 0):
    """(model of a box in true metres, from around it at three heights; its masks as its corners project). points: on
    the floor."""
    rng = np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-1.5, 1.5, (points, 2)), np.zeros(points)]
    photos, masks = {}, {}
    corners = np.array(list(itertools.product(*zip(LOW, HIGH, strict=True))))
    for state in ("start", "end"):
        for i, angle in enumerate(np.linspace(-2.2, 2.2, 12)):
            eye = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), (0.25, 0.9, 1.6)[i % 3]])
            photo = Photo(f"{state}/{i}.jpg", 0, look_at(eye, (0, 0, 0.35)))
            pixels = LENS.project(corners @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3])
            mask = np.zeros((240, 320), np.uint8)
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(pixels - 0.5).astype(np.int32)), 255)
            photos[len(photos)], masks[photo.name] = photo, mask
    return Model({0: LENS}, photos, np.arange(points), xyz, np.zeros((points, 3), np.uint8)), masks


def elsewhere(model: Model, floor: float) -> Model:
    """The model in another frame: turned about the vertical, the floor at that height."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 70, degrees=True).as_matrix(), (2.0, -1.0, floor)
    return model.moved(T)


def test_where_the_floor_is_unknown_it_is_not_claimed():
    model, masks = captured()
    floor = floor_of(elsewhere(model, -0.4))
    assert floor.height is None and floor.source == "cameras"
    assert floor.normal == pytest.approx([0, 0, 1], abs=0.01)
    placed = elsewhere(model, -0.4).moved(to_world(floor, elsewhere(model, -0.4), 1.0))
    assert placed.centre()[0] == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("floor", [0.0, -0.4, -1.3, 3.0])
def test_poses_without_points_may_have_their_origin_anywhere(floor):
    """The hull of photographs from above is up to a fifth higher than the object; nothing else may depend on the
    frame."""
    model, masks = captured()
    model, about = oriented(elsewhere(model, floor), {})
    assert about["floor"] == "unknown" and about["up"] == "cameras"
    placed = scaled(model, masks, 0.7, about)
    low, high = box_of(placed, masks)
    assert low[2] == pytest.approx(0, abs=1e-3) and high[2] == pytest.approx(0.7, abs=1e-3)
    assert 0.8 < about["scale"]["factor"] < 1.0  # of true metres
    assert about["scale"]["source"] == "height" and about["scale"]["metric"]
    assert 0.5 < (high - low)[1] < 0.65  # 0.6 wide
    model, about = oriented(elsewhere(captured()[0], floor), {})
    low, high = box_of(scaled(model, masks, None, about), masks)
    assert low[2] == pytest.approx(0, abs=1e-3)
    assert np.linalg.norm(high - low) == pytest.approx(1, abs=2e-3)
    assert 1.1 < (high - low)[2] / (high - low)[1] < 1.2 * 0.7 / 0.6
    assert about["scale"] == {"source": "object diagonal", "metric": False, "factor": pytest.approx(0.79, abs=0.03)}


def test_a_floor_that_points_show_is_where_the_object_ends():
    model, masks = captured(300)
    model, about = oriented(elsewhere(model, -1.3), {})
    assert about["floor"] == about["up"] == "floor plane"
    assert box_of(model, masks, floor=False)[0, 2] < -0.03  # from above, the hull goes on
    low, high = box_of(scaled(model, masks, 0.7, about), masks)
    assert low[2] == 0 and high[2] == pytest.approx(0.7, abs=1e-3)
    assert 0.92 < about["scale"]["factor"] < 1.0


def test_points_without_a_plane_are_the_lowest_of_the_room():
    model, masks = captured(300)
    model.xyz[:, 2] = np.random.default_rng(1).uniform(0.0, 3.0, 300)
    _, about = oriented(elsewhere(model, -1.3), {})
    assert about["floor"] == "lowest points" and about["up"] == "cameras"


def test_an_object_below_the_floor_is_refused():
    model, masks = captured(300)
    model.xyz[:, 2] += 0.8  # of another object
    model, about = oriented(model, {})
    assert about["floor"] == "floor plane"
    with pytest.raises(UserError, match="below the floor that the points show"):
        scaled(model, masks, 0.7, about)


def test_automatic_masks_need_a_floor(tmp_path):
    _, about = oriented(captured()[0], {})
    with pytest.raises(UserError, match=r"transforms.json: has no points.*--masks"):
        check_floor(about, tmp_path / "transforms.json")
    check_floor(oriented(captured(300)[0], {})[1], tmp_path)


def test_a_floor_that_is_unknown_warns_of_nothing(recwarn):
    floor_of(captured()[0])
    assert not recwarn.list


# (device, lens of its poses, size of its photographs, EXIF orientation): portrait by tag and by pixels, and one
# device in two sizes
DEVICES = [
    ("Phone A", Lens("PINHOLE", 320, 240, np.array([280.0, 281, 162, 119])), (320, 240), 1),
    ("Phone B", Lens("PINHOLE", 240, 320, np.array([300.0, 299, 118, 163])), (240, 320), 6),
    ("Phone B", Lens("PINHOLE", 240, 320, np.array([300.0, 299, 118, 163])), (480, 640), 1),
]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Photographs of the box by two devices, upright and across, with masks; poses in another frame as COLMAP's and as
    transforms.json without and with points."""
    folder, rng = tmp_path_factory.mktemp("mixed"), np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-1.5, 1.5, (400, 2)), np.zeros(400)]
    model = Model({1: DEVICES[0][1], 2: DEVICES[1][1]}, {}, np.arange(1, 401), xyz, np.zeros((400, 3), np.uint8))
    frames = []
    for state in ("start", "end"):
        (folder / state).mkdir(), (folder / "masks" / state).mkdir(parents=True)
        for i, eye in enumerate(_eyes()):
            device, lens, size, orientation = DEVICES[i % 3]

            number = 1 if device == "Phone A" else 2
            photo, key = Photo(f"{state}/{i}.jpg", number, look_at(np.array(eye), (0, 0, 0.35))), len(frames) + 1
            model.photos[key] = photo
            _photograph(folder, photo, device, lens, size, orientation, rng)
            pixels = model.pixels_of(key, xyz)
            inside = (pixels > 0).all(1) & (pixels < [lens.width, lens.height]).all(1)
            photo.xy, photo.point = pixels[inside], model.ids[inside]
            frames.append((key, lens))
    model = elsewhere(model, -1.3)
    write_model(model, folder / "sparse")
    told = []
    for key, lens in frames:
        c2w = np.linalg.inv(model.photos[key].viewmat) @ np.diag([1.0, -1, -1, 1])
        told.append({"file_path": model.photos[key].name, "transform_matrix": c2w.tolist(), "w": lens.width})
        told[-1] |= {"h": lens.height} | dict(zip(("fl_x", "fl_y", "cx", "cy"), lens.params.tolist(), strict=True))
    trimesh.PointCloud(model.xyz).export(folder / "points.ply")
    (folder / "bare.json").write_text(json.dumps({"frames": told}))
    (folder / "points.json").write_text(json.dumps({"frames": told, "ply_file_path": "points.ply"}))
    return folder


def _photograph(folder, photo, device, lens, size, orientation, rng):
    """A picture of noise with the box in red, as its device stores it, and its upright mask."""
    factor, corners = size[0] / lens.width, np.array(list(itertools.product(*zip(LOW, HIGH, strict=True))))
    pixels = factor * lens.project(corners @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3])
    mask = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(pixels - 0.5).astype(np.int32)), 255)
    image = rng.integers(0, 255, (*mask.shape, 3)).astype(np.uint8)
    image[mask > 0] = [200, 20, 20]
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = device, orientation
    stored = np.rot90(image) if orientation == 6 else image
    Image.fromarray(np.ascontiguousarray(stored)).save(folder / photo.name, exif=exif, quality=95)
    Image.fromarray(mask).save((folder / "masks" / photo.name).with_suffix(".png"))


@pytest.fixture(autouse=True)
def no_board(monkeypatch):
    """No board is sought: that takes a second a photograph."""
    monkeypatch.setattr("p2gs.data.capture.board.find_board", lambda names, folder: {})


def command(mixed, out, poses, *more):
    words = ["data", "capture", str(mixed / "start"), str(mixed / "end"), "--out", str(out)]
    return run([*words, "--poses", str(mixed / poses), *more])


@pytest.mark.parametrize(
    ("poses", "floor", "factor"),
    [
        ("sparse", "floor plane", (0.9, 1.0)),
        ("points.json", "floor plane", (0.9, 1.0)),
        ("bare.json", "unknown", (0.75, 1)),
    ],
)
def test_two_devices_upright_and_across_become_a_scene(mixed, tmp_path, poses, floor, factor):
    """The true box, brought into the scene by its cameras, is where each picture shows red."""
    out = tmp_path / "scene"
    assert command(mixed, out, poses, "--masks", str(mixed / "masks"), "--height", "0.7") == 0
    facts = json.loads((out / "capture.json").read_text())
    assert facts["floor"] == floor and factor[0] < facts["scale"]["factor"] < factor[1]
    assert facts["object_box"][0][2] == pytest.approx(0, abs=1e-3)
    assert facts["object_box"][1][2] == pytest.approx(0.7, abs=1e-3)
    assert {(c["width"], c["height"]) for c in facts["lenses"].values()} == {d[2] for d in DEVICES}
    scene = read_model(out / "sparse/0")
    assert len(scene.photos) == 24 and all(i["file"] for i in facts["images"])
    true = {f"{s}/{i}.jpg": p for s in ("start", "end") for i, p in enumerate(_eyes())}
    source = {i["file"]: "/".join(i["source"].split("/")[-2:]) for i in facts["images"]}
    own = np.array([p.position for p in scene.photos.values()])
    T = similarity(np.array([true[source[p.name]] for p in scene.photos.values()]), own)
    assert np.cbrt(np.linalg.det(T[:3, :3])) == pytest.approx(facts["scale"]["factor"], rel=1e-6)
    corners = np.array(list(itertools.product(*zip(LOW, HIGH, strict=True)))) @ T[:3, :3].T + T[:3, 3]
    for key, photo in scene.photos.items():
        rgba = cv2.imread(str(out / photo.name), cv2.IMREAD_UNCHANGED)
        pixels = scene.pixels_of(key, corners)
        rows, cols = np.nonzero(rgba[..., 3] > 127)
        found = [cols.min(), rows.min(), cols.max() + 1, rows.max() + 1]
        assert np.abs(np.array(found) - [*pixels.min(0), *pixels.max(0)]).max() < 2  # pixels
        assert np.abs(np.median(rgba[rows, cols, :3], axis=0) - [20, 20, 200]).max() < 30


def _eyes():
    """Where the photographs of a state were taken from, in true metres."""
    angles = np.linspace(-2.2, 2.2, 12)
    return [(2.4 * np.cos(a), 2.4 * np.sin(a), (0.3, 0.9, 1.6)[i // 4]) for i, a in enumerate(angles)]


def test_the_command_says_that_automatic_masks_need_a_floor(mixed, tmp_path, capsys):
    assert command(mixed, tmp_path / "scene", "bare.json") == 2
    assert "bare.json: has no points, so nothing says where the floor is" in capsys.readouterr().err
