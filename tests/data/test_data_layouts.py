"""Oddities of the layouts on small generated scenes: what may vary on disk and must still be read right."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from p2gs.data.modules import DATASETS, open_data
from p2gs.types import UserError


def read(format, root, **options):
    return DATASETS[format](root=str(root), **options).raw_scene()


def rewrite_json(path, change):
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


@pytest.mark.parametrize("format", ["artgs", "dta", "paris"])
def test_written_scene_reads_back(written, toy_scene, format):
    scene = open_data(str(written[format])).raw_scene()
    splits = ("train",) if format == "dta" else ("train", "test")
    expected = [v for v in toy_scene.views if v.split in splits]
    assert len(scene.views) == len(expected) and {v.split for v in scene.views} == set(splits)
    by_key = {(v.state, v.split, v.name.split("_")[-1]): v for v in scene.views}
    for want in expected:
        got = by_key[want.state, want.split, want.name]
        torch.testing.assert_close(got.camera.viewmat, want.camera.viewmat, atol=1e-6, rtol=0)
        torch.testing.assert_close(got.camera.K, want.camera.K, atol=1e-4, rtol=0)
        if format == "dta":  # colours outside the mask are blacked out and masks are binary in this layout
            assert torch.equal(got.alpha, torch.where(want.alpha > 127, 255, 0).to(torch.uint8))
            assert torch.equal(got.image[want.alpha > 127], want.image[want.alpha > 127])
        else:
            assert torch.equal(got.alpha, want.alpha) and torch.equal(got.image, want.image)
        if format == "paris":
            assert got.depth is None
        else:
            torch.testing.assert_close(got.depth, want.depth, atol=5.1e-4, rtol=0)


def test_depth_modes(written, copy_of):
    assert not read("artgs", written["artgs"], depth="never").has_depth
    with pytest.raises(UserError, match="has no depth, but the option depth=always"):
        read("paris", written["paris"], depth="always")
    root = copy_of("artgs")
    for folder in root.glob("*/*/depth"):
        shutil.rmtree(folder)
    assert not read("artgs", root).has_depth


def test_max_views_spreads_over_the_cameras(written):
    scene = read("artgs", written["artgs"], max_views=3)
    assert [len(scene.select(s, "train")) for s in (0, 1)] == [3, 3] and len(scene.select(split="test")) == 4
    everything = read("artgs", written["artgs"])
    for state in (0, 1):
        assert nearest(scene.select(state, "train")) > 1.2 * nearest(everything.select(state, "train"))


def nearest(views):
    """The least distance between two cameras."""
    return torch.cdist(*[torch.stack([v.camera.position for v in views])] * 2).fill_diagonal_(9).min()


def test_paris_source_paths(written, tmp_path):
    source = "sapien/storage/1"
    for inner in ("load", "data"):
        shutil.copytree(written["paris"] / inner, tmp_path / inner / source)
    found = read("paris", tmp_path)
    named = read("paris", tmp_path, source=source)
    inside = read("paris", tmp_path / "load" / source)
    assert len(found.views) == len(named.views) == len(inside.views) == 20
    shutil.copytree(tmp_path / "load" / source, tmp_path / "load" / "sapien/storage/2")
    with pytest.raises(UserError, match="holds 2 scenes; name one by its source, for example 'sapien/storage/1'"):
        read("paris", tmp_path)
    assert len(read("paris", tmp_path, source=source).views) == 20
    with pytest.raises(UserError, match="folder of the source 'no' is missing"):
        read("paris", tmp_path, source="no")


def test_paris_uses_the_whole_K_and_the_val_split(copy_of):
    root = copy_of("paris")
    for state in ("start", "end"):
        folder = root / "load" / state
        shutil.move(folder / "test", folder / "val")
        shutil.move(folder / "camera_test.json", folder / "camera_val.json")
        rewrite_json(folder / "camera_train.json", lambda c: c.update(K=[[50, 0, 17.5], [0, 55, 23], [0, 0, 1]]))
    scene = read("paris", root)
    assert torch.equal(scene.select(split="train")[0].camera.K, torch.tensor([[50, 0, 17.5], [0, 55, 23], [0, 0, 1]]))
    assert len(scene.select(split="val")) == 4 and not scene.select(split="test")


def test_dta_masks_depth_and_states(copy_of):
    root = copy_of("dta")
    mask = cv2.imread(str(root / "mask/0_0000.png"), cv2.IMREAD_UNCHANGED)
    three = np.zeros((*mask.shape, 3), np.uint8)
    three[..., 2] = mask // 255  # the file's first channel (cv2 writes BGR), and 1 instead of 255
    cv2.imwrite(str(root / "mask/0_0000.png"), three)
    depth = cv2.imread(str(root / "depth_filtered/1_0001.png"), cv2.IMREAD_UNCHANGED)
    depth[mask.shape[0] // 2, :] = 99  # nearer than 0.1 m
    cv2.imwrite(str(root / "depth_filtered/1_0001.png"), np.kron(depth, np.ones((2, 2), np.uint16)))
    lines = (root / "init_keyframes.yml").read_text().splitlines()
    # the prefix tells the state
    (root / "init_keyframes.yml").write_text("\n".join(x for x in lines if "time" not in x))
    scene = read("dta", root)
    views = {v.name: v for v in scene.views}
    assert np.array_equal(views["0_0000"].alpha.numpy(), mask)
    assert views["1_0001"].state == 1 and len(scene.select(1)) == 8
    other = views["1_0001"]
    want = np.where(depth < 100, 0, depth) / 1000 * (other.alpha.numpy() > 127)
    np.testing.assert_allclose(other.depth.numpy(), want, atol=1e-6)
    assert not other.depth[mask.shape[0] // 2].any() and other.depth.any()


def test_artgs_paths_and_intrinsics(copy_of):
    root = copy_of("artgs")
    before = read("artgs", root)

    def change(meta):
        for i, frame in enumerate(meta["frames"]):
            stem = frame["file_path"].rsplit("/", 1)[1][:-4]
            frame["file_path"] = f"start/train/images/{stem}.jpg" if i % 2 else f"start/train/rgba/{stem}"
        del meta["camera_angle_y"]
        meta["frames"][3].update(fl_x=60.0, fl_y=61.0, cx=19.0, cy=22.0)

    rewrite_json(root / "transforms_train_start.json", change)
    (root / "transforms_test_end.json").unlink()
    after = read("artgs", root)
    for i in range(8):
        assert torch.equal(after.views[i].image, before.views[i].image)
        assert (after.views[i].depth is not None) and torch.equal(
            after.views[i].camera.viewmat, before.views[i].camera.viewmat
        )
        if i != 3:
            torch.testing.assert_close(after.views[i].camera.K, before.views[i].camera.K)
    assert after.views[3].camera.K.tolist() == [[60, 0, 19], [0, 61, 22], [0, 0, 1]]
    assert len(after.select(1, "test")) == 0 and len(after.select(0, "test")) == 2


def test_artgs_depth_needs_alpha(written):
    for view in read("artgs", written["artgs"]).views:
        assert not view.depth[view.alpha < 128].any()
        assert view.depth[view.alpha == 255].bool().float().mean() > 0.95


def test_poses_are_made_exactly_orthonormal(copy_of):
    root = copy_of("artgs")
    rewrite_json(
        root / "transforms_train_start.json",
        lambda m: m["frames"][0].update(transform_matrix=np.round(m["frames"][0]["transform_matrix"], 3).tolist()),
    )
    R = read("artgs", root).views[0].camera.viewmat[:3, :3].double()
    assert float((R @ R.T - torch.eye(3)).abs().max()) < 1e-6


def test_unknown_folder_and_options(tmp_path):
    with pytest.raises(UserError, match="is none of the layouts"):
        open_data(str(tmp_path))
    with pytest.raises(UserError, match="scene folder is missing"):
        read("artgs", tmp_path / "nothing")
    with pytest.raises(UserError, match="data.downscale is 0.5"):
        open_data(str(tmp_path), "artgs", downscale=0.5)
    with pytest.raises(UserError, match="data.max_views is 0"):
        open_data(str(tmp_path), "artgs", max_views=0)


def test_masks_that_share_no_object_are_told(copy_of):
    root = copy_of("artgs")
    for i, path in enumerate(sorted((root / "start/train/rgba").glob("*.png"))):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image[..., 3] = 0
        corner = (slice(0, 8), slice(0, 8)) if i % 2 else (slice(-8, None), slice(-8, None))
        image[..., 3][corner] = 255
        cv2.imwrite(str(path), image)
    with pytest.raises(UserError, match="masks of state 'start' show no common object"):
        DATASETS["artgs"](root=str(root)).scene()


def test_a_soft_mask_is_coverage_and_its_black_rim_is_filled(copy_of):
    """Soft edges are alpha; the half of them that the image blacks out takes the colour beside it."""
    root = copy_of("dta")
    path, picture = root / "mask/0_0000.png", root / "color_segmented/0_0000.png"
    mask, image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED), cv2.imread(str(picture))
    image[mask > 0] = (10, 60, 200)
    soft = cv2.blur(mask, (3, 3))
    cv2.imwrite(str(path), soft)
    rim = np.where((soft >= 128)[..., None], np.where((mask > 0)[..., None], image, (10, 60, 200)), 0)
    cv2.imwrite(str(picture), rim.astype(np.uint8))
    view = {v.name: v for v in read("dta", root).views}["0_0000"]
    alpha = view.alpha.numpy()
    assert np.array_equal(alpha, soft) and ((alpha > 0) & (alpha < 128)).sum() > 50
    assert np.array_equal(np.unique(view.image.numpy()[alpha > 0], axis=0), [[200, 60, 10]])
