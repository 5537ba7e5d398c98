"""Each fault of a scene's files is told in one sentence that names the file; a reader stops with the same sentence."""

import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs.data.check import check_dataset
from p2gs.data.modules import DATASETS
from p2gs.types import UserError

LENS = {"fl_x": 55.0, "fl_y": 55.0, "cx": 20.0, "cy": 20.0}


def edit_json(path, change):
    value = json.loads(path.read_text())
    path.write_text(json.dumps(change(value) or value))


def edit_image(path, change):
    cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def pose_of_first(meta, f):
    meta["frames"][0]["transform_matrix"] = f(np.array(meta["frames"][0]["transform_matrix"])).tolist()


def gone(path):
    return lambda root: (root / path).unlink()


def start(change):
    return lambda root: edit_json(root / START, change)


def cameras(change):
    return lambda root: edit_json(root / "load/end/camera_train.json", change)


def picture(path, change):
    return lambda root: edit_image(root / path, change)


def pad_right(root):
    for path in (root / "load/end/train").glob("*.png"):
        edit_image(path, lambda image: np.pad(image, ((0, 0), (0, 30), (0, 0))))


def no_alpha(image):
    return image[..., :3]


def empty_alpha(image):
    image[..., 3] = 0
    return image


def scaled_rotation(m):
    m[:3, :3] *= 1.3
    return m


def mirrored(m):
    m[:3, 0] *= -1
    return m


def broken_row(m):
    m[3, 0] = 0.5
    return m


def not_finite(m):
    m[0, 3] = np.nan
    return m


START, END = "transforms_train_start.json", "transforms_train_end.json"
IMAGE = "start/train/rgba/0003.png"
FAULTS = {
    "camera file missing": ("artgs", gone(END), f"{END}: camera file is missing"),
    "camera file not JSON": ("artgs", lambda r: (r / END).write_text("{"), f"{END}: is not valid JSON"),
    "no frames": ("artgs", start(lambda m: {"camera_angle_x": 1}), f"{START}: has no list 'frames'"),
    "empty frames": ("artgs", start(lambda m: m.update(frames=[])), "state 'start' has no training views"),
    "frame without pose": (
        "artgs",
        start(lambda m: m["frames"][2].pop("transform_matrix") and None),
        "frame 2 needs",
    ),
    "image missing": ("artgs", gone(IMAGE), "0003.png: image is missing, but transforms_train_start.json lists it"),
    "image unreadable": ("artgs", lambda r: (r / IMAGE).write_bytes(b"no png"), "0003.png: cannot be read as an image"),
    "image without alpha": ("artgs", picture(IMAGE, no_alpha), "0003.png: has no alpha channel"),
    "mask empty": ("artgs", picture(IMAGE, empty_alpha), "0003.png: mask is empty"),
    "pose scaled": ("artgs", start(lambda m: pose_of_first(m, scaled_rotation)), "is not orthonormal"),
    "pose mirrored": ("artgs", start(lambda m: pose_of_first(m, mirrored)), "is a mirror image"),
    "pose last row": ("artgs", start(lambda m: pose_of_first(m, broken_row)), "last row of the camera pose"),
    "pose not finite": ("artgs", start(lambda m: pose_of_first(m, not_finite)), "values that are not finite"),
    "pose no matrix": (
        "artgs",
        start(lambda m: m["frames"][0].update(transform_matrix=[1, 2])),
        "not a 4x4 matrix",
    ),
    "no field of view": (
        "artgs",
        start(lambda m: m.pop("camera_angle_x") and None),
        "neither camera_angle_x nor fl_x",
    ),
    "degrees": (
        "artgs",
        start(lambda m: m.update(camera_angle_x=39.6)),
        "camera_angle_x is 39.6, but it should be",
    ),
    "distortion": ("artgs", start(lambda m: m.update(k1=0.1)), "lens distortion (k1) is not supported"),
    "no principal point": ("artgs", start(lambda m: m.update(fl_x=50)), "has fl_x but no principal point"),
    "another size than told": (
        "artgs",
        start(lambda m: m.update(LENS, w=41, h=40)),
        "0000.png: is 40x40 pixels, but",
    ),
    "depth not 16 bit": (
        "artgs",
        picture("end/train/depth/0001.png", lambda d: d.astype(np.uint8)),
        "0001.png: depth should be a 16-bit single-channel PNG",
    ),
    "depth of another shape": (
        "artgs",
        picture("end/train/depth/0001.png", lambda d: d[:20]),
        "0001.png: is 40x20 pixels, which is not the shape of its 40x40 image",
    ),
    "PARIS state missing": ("paris", lambda r: shutil.rmtree(r / "load/end"), "folder of the state 'end' is missing"),
    "PARIS camera file missing": (
        "paris",
        gone("load/end/camera_train.json"),
        "camera_train.json: camera file is missing",
    ),
    "PARIS no K": (
        "paris",
        cameras(lambda c: c.pop("K") and None),
        "no intrinsics under the key 'K'",
    ),
    "PARIS K of another size": (
        "paris",
        cameras(lambda c: c.update(K=[[111, 0, 80], [0, 111, 80], [0, 0, 1]])),
        "K does not fit the 40x40 image 0000.png, its principal point (80.0, 80.0) lies outside",
    ),
    "one K, two sizes": (
        "paris",
        picture("load/end/train/0002.png", lambda i: i[:30]),
        "0002.png: is 40x30 pixels, but 0000.png",
    ),
    "PARIS K broken": (
        "paris",
        cameras(lambda c: c.update(K=[[0, 0, 20], [0, 1, 20], [0, 0, 1]])),
        "with positive focal lengths",
    ),
    "PARIS skew": (
        "paris",
        cameras(lambda c: c.update(K=[[50, 2, 20], [0, 50, 20], [0, 0, 1]])),
        "K has a skew of 2",
    ),
    "PARIS image missing": (
        "paris",
        gone("load/end/train/0002.png"),
        "0002.png: image is missing, but camera_train.json",
    ),
    "DTA K missing": ("dta", gone("cam_K.txt"), "cam_K.txt: camera file is missing"),
    "DTA K short": (
        "dta",
        lambda r: (r / "cam_K.txt").write_text("1 0 2"),
        "cam_K.txt: should hold the 9 numbers of K",
    ),
    "DTA keyframes missing": ("dta", gone("init_keyframes.yml"), "init_keyframes.yml: camera file is missing"),
    "DTA keyframes no YAML": (
        "dta",
        lambda r: (r / "init_keyframes.yml").write_text("a: [1"),
        "init_keyframes.yml: is not valid YAML",
    ),
    "DTA third state": (
        "dta",
        lambda r: (r / "init_keyframes.yml").write_text("frame_2_0:\n  cam_in_ob: [1]\n"),
        "belongs to the time 2",
    ),
    "DTA mask missing": ("dta", gone("mask/1_0002.png"), "mask/1_0002.png: image is missing"),
    "DTA mask of another size": (
        "dta",
        picture("mask/1_0002.png", lambda m: m[:20]),
        "mask/1_0002.png: is 40x20 pixels, but its",
    ),
    "DTA mask empty": ("dta", picture("mask/1_0002.png", lambda m: 0 * m), "mask/1_0002.png: mask is empty"),
    "DTA depth missing": ("dta", gone("depth_filtered/0_0005.png"), "depth_filtered/0_0005.png: image is missing"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_named_by_check_and_reader(copy_of, fault):
    format, damage, sentence = FAULTS[fault]
    root = copy_of(format)
    damage(root)
    errors = [f.message for f in check_dataset(root, format) if f.level == "error"]
    assert errors and sentence in errors[0], errors
    assert "\n" not in errors[0] and str(root) in errors[0]
    with pytest.raises(UserError) as raised:
        DATASETS[format](root=str(root)).scene()
    assert str(raised.value) == errors[0]


def test_windows_of_one_K_may_differ_in_size_that_is_told(copy_of):
    """Two windows of photographs whose principal points lie alike may end at another column: a capture writes such."""
    root = copy_of("artgs")
    edit_image(root / "start/train/rgba/0001.png", lambda image: image[:, :39])
    shutil.rmtree(root / "start/train/depth")
    edit_json(
        root / START, lambda m: [f.update(LENS, w=39 if k == 1 else 40, h=40) for k, f in enumerate(m["frames"])] and m
    )
    assert not [f.message for f in check_dataset(root, "artgs") if f.level == "error"]


def replace_K(root):
    for split in ("train", "test"):
        edit_json(root / f"load/end/camera_{split}.json", lambda c: c.update(K=[[60, 0, 20], [0, 60, 20], [0, 0, 1]]))


NOTES = {
    "different intrinsics": ("paris", replace_K, "states were taken with different intrinsics"),
    "off centre": (
        "paris",
        pad_right,
        "principal point (20.0, 20.0) is far from the centre",
    ),
    "image without a frame": (
        "paris",
        cameras(lambda c: c.pop("0004") and None),
        "1 images have no camera frame and are left out, the first is 0004.png",
    ),
    "numbers of views": (
        "artgs",
        start(lambda m: m.update(frames=m["frames"][:5])),
        "has only 5 training views; 32 or more are usual",
    ),
    "no test views": ("dta", lambda r: None, "there are no test views"),
    "no depth folder": (
        "dta",
        lambda r: shutil.rmtree(r / "depth_filtered"),
        "depth_filtered: folder is missing, so the scene is read without",
    ),
    "depth resized": (
        "artgs",
        picture("end/train/depth/0001.png", lambda d: d[::2, ::2]),
        "is 20x20 pixels and is brought to",
    ),
    "depth empty": ("artgs", picture("end/train/depth/0001.png", lambda d: d // 100), "holds no depth of at least 0.1"),
    "depth of some": ("artgs", gone("end/train/depth/0001.png"), "has no depth, though 19 of 20 frames have"),
    "full mask": (
        "artgs",
        picture("start/test/rgba/0000.png", lambda i: np.dstack([i[..., :3], 255 + 0 * i[..., 3]])),
        "mask covers the whole image",
    ),
    "time of the other state": (
        "artgs",
        start(lambda m: m["frames"][0].update(time=1.0)),
        "has time 1.0, but it is read",
    ),
    "no ground truth": (
        "artgs",
        lambda r: shutil.rmtree(r / "gt"),
        "has no ground truth, so the result cannot be scored",
    ),
    "broken ground truth": (
        "artgs",
        lambda r: (r / "gt/trans.json").write_text("{}"),
        "so the result cannot be scored",
    ),
    "ground truth without meshes": ("artgs", gone("gt/end/end_rotate.ply"), "shape cannot be scored"),
}


@pytest.mark.parametrize("oddity", NOTES)
def test_oddity_is_a_note_and_training_goes_on(copy_of, oddity):
    format, change, sentence = NOTES[oddity]
    root = copy_of(format)
    change(root)
    findings = check_dataset(root)
    assert [f for f in findings if f.level == "error"] == []
    assert any(sentence in f.message for f in findings), findings
    assert DATASETS[format](root=str(root)).scene().views


@pytest.mark.parametrize("format, depth", [("artgs", "depth in 20"), ("paris", "no depth")])
def test_sound_scene_has_one_summary_and_nothing_else(written, format, depth):
    (finding,) = check_dataset(written[format])
    assert finding.level == "note"
    assert (
        f"{format} layout, 8 train (start), 2 test (start), 8 train (end), 2 test (end) views of 40x40 pixels, {depth}"
        in finding.message
    )


def test_several_faults_are_all_listed(copy_of):
    root = copy_of("artgs")
    for i in (1, 3):
        edit_image(root / f"start/train/rgba/000{i}.png", no_alpha)
    (root / "end/train/rgba/0000.png").unlink()
    errors = [f.message for f in check_dataset(root) if f.level == "error"]
    assert (
        len(errors) == 3
        and "end/train/rgba/0000.png" in errors[0]
        and "0001.png" in errors[1]
        and "0003.png" in errors[2]
    )


def test_folder_of_no_layout(tmp_path):
    (finding,) = check_dataset(tmp_path)
    assert finding.level == "error" and "is none of the known layouts" in finding.message
    (finding,) = check_dataset(tmp_path / "nothing")
    assert "scene folder is missing" in finding.message
    with pytest.raises(UserError, match="did you mean 'artgs'"):
        check_dataset(tmp_path, "artg")
