"""The command from poses to a scene, the child process, and scores in true metres."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from p2gs.app import run
from p2gs.data.capture.child import run_job
from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.hull import agreement
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.static import loose_poses
from p2gs.data.check import check_dataset
from p2gs.data.generated.raytrace import render
from p2gs.data.generated.shapes import box
from p2gs.data.generated.synthetic import look_at
from p2gs.data.generated.textures import Texture
from p2gs.scores.capture import camera_pairs, moved_joint, rigid_between
from p2gs.types import Camera, Joint, UserError

LENS = Lens("PINHOLE", 320, 240, np.array([280.0, 280, 160, 120]))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photographs of a box on a floor before a wall, true masks, and the COLMAP model that goes with them; both states
    alike."""
    folder = tmp_path_factory.mktemp("capture")
    floor = box((-3, -3, -0.05), (3, 3, 0), Texture("checks", (0.6, 0.5, 0.3), (0.3, 0.3, 0.5), 0.5, 1))
    wall = box((-1.1, -3, 0), (-1.0, 3, 2.5), Texture("noise", (0.8, 0.8, 0.7), (0.4, 0.6, 0.4), 0.6, 2))
    thing = box((-0.3, -0.3, 0), (0.3, 0.3, 0.7), Texture("noise", (0.8, 0.15, 0.1), (0.6, 0.1, 0.1), 0.3, 4))
    rng = np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-1, 1.5, (200, 1)), rng.uniform(-1.5, 1.5, (200, 1)), np.zeros((200, 1))]
    photos = {}
    model = Model({1: LENS}, photos, np.arange(1, 201), xyz, np.full((200, 3), 90, np.uint8))
    for s, state in enumerate(("start", "end")):
        for sub in (state, f"masks/{state}"):
            (folder / sub).mkdir(parents=True)
        for i, angle in enumerate(np.linspace(-1.1, 1.1, 9)):
            view = look_at(np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), (0.6, 1.1, 1.6)[i % 3]]), (0, 0, 0.35))
            shot = render([floor, wall, thing], [0, 0, 1], view, LENS.K, 320, 240, samples=1)
            gain = 1.0 if s == 0 else 0.85
            cv2.imwrite(str(folder / state / f"p{s}{i}.jpg"), (gain * shot.image[..., ::-1]).astype(np.uint8))
            cv2.imwrite(
                str(folder / "masks" / state / f"p{s}{i}.png"), np.where(shot.parts == 1, 255, 0).astype(np.uint8)
            )
            key = len(photos) + 1
            photos[key] = Photo(f"{state}/p{s}{i}.jpg", 1, view)
            pixels = model.pixels_of(key, xyz)
            inside = (pixels > 0).all(1) & (pixels < [320, 240]).all(1)
            photos[key].xy, photos[key].point = pixels[inside], model.ids[inside]
    write_model(model, folder / "sparse")
    return folder


def command(capture, out, *more):
    words = ["data", "capture", str(capture / "start"), str(capture / "end"), "--out", str(out)]
    return run([*words, "--poses", str(capture / "sparse"), *more])


def test_poses_and_masks_become_a_scene(capture, tmp_path, capsys):
    out = tmp_path / "scene"
    assert command(capture, out, "--masks", str(capture / "masks"), "--height", "0.7") == 0
    assert not [f for f in check_dataset(out) if f.level == "error"]
    facts = json.loads((out / "capture.json").read_text())
    assert facts["scale"].pop("factor") > 0
    assert facts["scale"] == {"source": "height", "metric": True}
    assert facts["masks"] == "given" and facts["up"] == "floor plane"
    assert len(facts["images"]) == 18 and all(i["file"] and (out / i["file"]).is_file() for i in facts["images"])
    assert facts["bias"]["shift"] < 1e-6
    low, high = np.array(facts["object_box"])
    assert low[2] == 0 and high[2] == pytest.approx(0.7)
    assert 0.55 < (high - low)[1] < 0.75  # x is open at the back, which no photograph shows
    log_gains = np.log(np.array(list(facts["gains"].values())))
    assert np.abs(log_gains.mean(0)).max() < 1e-3  # rounding of the file
    files = {i["file"]: i["state"] for i in facts["images"]}
    by_state = [np.mean([np.log(g) for f, g in facts["gains"].items() if files[f] == s]) for s in ("start", "end")]
    assert abs((by_state[1] - by_state[0]) / (2.2 * np.log(0.85)) - 1) < 0.2  # linear light falls as the 2.2th power
    assert len(read_model(out / "sparse/0").photos) == 18
    assert len(json.loads((out / "end/transforms.json").read_text())["frames"]) == 9
    assert (out / "contact.jpg").is_file() and "<svg" in (out / "capture.html").read_text()
    capsys.readouterr()
    assert command(capture, out, "--masks", str(capture / "masks")) == 0
    assert "photos_start: unchanged" in capsys.readouterr().out


def test_a_known_length_gives_metres_whenever_the_command_is_given(capture, tmp_path, capsys):
    """The poses are in metres, so the scene's factor is 1: of the second run, too, whose page has other units."""
    out, masks = tmp_path / "scene", ["--masks", str(capture / "masks")]
    assert command(capture, out, *masks, "--length", "1", *"000100") == 2
    assert "run without --length first" in capsys.readouterr().err
    assert command(capture, out, *masks, "--length", "1", *"100100") == 2
    assert "both ends are one place" in capsys.readouterr().err
    assert command(capture, out, *masks) == 0
    unit = json.loads((out / "capture.json").read_text())["scale"]["factor"]
    assert unit != pytest.approx(1, rel=0.05)
    ends = [0.1, 0.2, 0.0, 0.1 + 1.2 * unit, 0.2 + 1.6 * unit, 0.0]  # two metres apart
    for _ in range(2):
        assert command(capture, out, *masks, "--length", "2", *map(str, ends)) == 0
        scale = json.loads((out / "capture.json").read_text())["scale"]
        assert scale["source"] == "length" and scale["metric"] and scale["factor"] == pytest.approx(1)
    assert run(["data", "capture", "a", "b", "--out", "c", "--height", "1", "--length", "1", *"000100"]) == 2
    assert "not allowed with" in capsys.readouterr().err


def test_pictures_are_windows_about_the_object(capture, tmp_path):
    out = tmp_path / "scene"
    assert command(capture, out, "--masks", str(capture / "masks")) == 0
    model = read_model(out / "sparse/0")
    assert model.errors()[2].max() < 0.5  # the windows' cameras see the points where the photographs saw them
    whole = next(iter(read_model(capture / "sparse").lenses.values()))
    for photo in model.photos.values():
        lens, alpha = model.lenses[photo.lens], cv2.imread(str(out / photo.name), cv2.IMREAD_UNCHANGED)[..., 3]
        assert alpha.shape == (lens.height, lens.width) and len(photo.xy) > 0
        rows, cols = np.nonzero(alpha.any(1))[0], np.nonzero(alpha.any(0))[0]
        beside = [rows[0], cols[0], lens.height - 1 - rows[-1], lens.width - 1 - cols[-1]]
        assert min(beside) >= 0.02 * max(alpha.shape)
        tight = [min(beside[0], beside[2]), min(beside[1], beside[3])]
        assert max(tight) <= 0.05 * max(alpha.shape)  # on one side at least of each direction
        middle = lens.K[:2, 2] / [lens.width, lens.height]
        assert np.abs(middle - 0.5).max() < 0.02
        assert lens.width < whole.width and lens.height < whole.height


def test_a_mask_of_another_thing_is_told_from_the_others():
    """Of thirty outlines of a box one is of something beside it; the others are the box's own."""
    low, high = np.array([-0.3, -0.2, 0.0]), np.array([0.3, 0.2, 0.7])
    corners = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.2, 0.2) for z in (0.0, 0.7)])
    outlines = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, 30, endpoint=False)):
        view = look_at(np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), (0.4, 1.2, 2.2)[i % 3]]), (0, 0, 0.35))
        camera = Camera(torch.tensor(view).float(), torch.tensor(LENS.K).float(), LENS.width, LENS.height)
        pixels = LENS.project(corners @ view[:3, :3].T + view[:3, 3])
        drawn = cv2.fillConvexPoly(np.zeros((240, 320), np.uint8), cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
        outlines.append((camera, drawn > 0))
    wider = np.stack([low - 0.1, high + 0.1])
    assert min(agreement(outlines, wider)) > 0.85
    other = np.zeros((240, 320), bool)
    other[200:, :60] = True
    outlines[7] = outlines[7][0], other
    shares = agreement(outlines, wider)
    assert shares[7] == 0 and min(shares[:7] + shares[8:]) > 0.85


def test_a_folder_of_something_else_is_not_written_into(capture, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("x")
    assert command(capture, tmp_path, "--masks", str(capture / "masks")) == 2
    assert "expected a new folder" in capsys.readouterr().err


def test_a_narrow_arc_is_refused_and_states_apart_are_told(capture, tmp_path, capsys):
    model = read_model(capture / "sparse")
    assert loose_poses(model) is None
    for key, photo in model.photos.items():
        i = int(photo.name[-5])
        angle = 0.25 * np.linspace(-1.1, 1.1, 9)[i]
        eye = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), (0.6, 1.1, 1.6)[i % 3]])
        photo.viewmat = look_at(eye, (0, 0, 0.35))
        pixels = model.pixels_of(key, model.xyz)
        inside = (pixels > 0).all(1) & (pixels < [320, 240]).all(1)
        photo.xy, photo.point = pixels[inside], model.ids[inside]
        if photo.name.startswith("end/"):
            photo.viewmat[:3, 3] += photo.viewmat[:3, :3] @ [0, 0, 0.01]  # 1 cm lower, of 2.4 m
    write_model(model, tmp_path / "narrow")
    words = ["data", "capture", str(capture / "start"), str(capture / "end"), "--out", str(tmp_path / "s")]
    assert run([*words, "--masks", str(capture / "masks"), "--poses", str(tmp_path / "narrow")]) == 2
    told = capsys.readouterr()
    assert "degrees around the object" in told.err
    assert re.search(r"narrow: both states see what stands still up to 0\.[3-6]\d % of the cameras' distance", told.out)


def test_poses_without_points_cannot_be_checked(capture):
    model = read_model(capture / "sparse")
    none = replace(model, ids=model.ids[:0], xyz=model.xyz[:0], rgb=model.rgb[:0])
    none.photos = {k: replace(p, xy=p.xy[:0], point=p.point[:0]) for k, p in model.photos.items()}
    assert "too few points are seen in both states" in (loose_poses(none) or "")


def test_the_child_adjusts_a_model(capture, tmp_path):
    pytest.importorskip("pycolmap")
    model = read_model(capture / "sparse")
    model.xyz = model.xyz + 0.01 * np.random.default_rng(1).normal(size=model.xyz.shape)
    write_model(model, tmp_path / "model")
    before = model.errors()[2].mean()
    job = {"model": str(tmp_path / "model"), "principal_point": False, "iterations": 50, "known": [], "scale": 1.0}
    result = run_job("adjust", job, tmp_path)
    assert before > 0.5 and result["error"] < 0.05
    assert read_model(tmp_path / "model").errors()[2].mean() < 0.05


def test_without_pycolmap_it_is_said_how_to_get_it(tmp_path, monkeypatch):
    (tmp_path / "pycolmap.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(UserError, match=r"pip install 'p2gs\[capture\]'"):
        run_job("adjust", {}, tmp_path / "work")


def test_the_package_imports_without_pycolmap():
    code = "import sys; sys.modules['pycolmap'] = None; import p2gs.data.capture.pipeline"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_cameras_give_the_frame_and_the_misalignment(tmp_path):
    """A capture in another frame and unit, its end state hung 4 mm off: the similarity is found and the 4 mm are what
    is left."""
    rng = np.random.default_rng(0)
    scene, truth = tmp_path / "scene", tmp_path / "truth"
    scene.mkdir(), truth.mkdir()
    images, true = [], {}
    for state in ("start", "end"):
        frames = []
        for i in range(6):
            c2w = np.linalg.inv(look_at(rng.normal(size=3) + [2, 0, 1], (0, 0, 0.3))) @ np.diag([1, -1, -1, 1])
            true[f"{state}/IMG_{i}"] = c2w.tolist()
            own = c2w.copy()
            own[:3, 3] = (own[:3, 3] + (np.array([0.004, 0, 0]) if state == "end" else 0) - [1, 2, 3]) / 0.5
            file = f"{state}/train/rgba/{i:04d}.png"
            frames.append({"file_path": file, "transform_matrix": own.tolist()})
            images.append({"state": state, "source": f"/x/IMG_{i}.jpg", "file": file, "reason": None})
        (scene / f"transforms_train_{state}.json").write_text(json.dumps({"frames": frames}))
    (scene / "capture.json").write_text(json.dumps({"images": images}))
    (truth / "cameras.json").write_text(json.dumps({"c2w": true}))
    pairs = camera_pairs(scene, truth)
    T = rigid_between(*pairs["start"], with_scale=True)
    np.testing.assert_allclose(T, [[0.5, 0, 0, 1], [0, 0.5, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]], atol=1e-9)
    own, other = pairs["end"]
    off = own[:, :3, 3] @ T[:3, :3].T + T[:3, 3] - other[:, :3, 3]
    np.testing.assert_allclose(off, np.tile([0.004, 0, 0], (6, 1)), atol=1e-9)
    slide = Joint("prismatic", torch.tensor([1.0, 0, 0]), torch.zeros(3), 0.4, (0.0, 0.4), torch.eye(4))
    moved = moved_joint(slide, T)
    assert moved.motion == pytest.approx(0.2) and moved.origin.tolist() == pytest.approx([1, 2, 3])
