"""Masks from 3D on a small room whose object is known, and given masks."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from p2gs.data.capture.auto_masks import Look, distorted, nearer, object_in, shares, sharpened
from p2gs.data.capture.coarse import Picture, Region, Splat, fit, initial, object_rows, region_of
from p2gs.data.capture.given_masks import folder_masks, shown
from p2gs.data.capture.hull import hull_of
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.photos import Shot
from p2gs.data.generated.raytrace import render
from p2gs.data.generated.shapes import box
from p2gs.data.generated.synthetic import look_at
from p2gs.data.generated.textures import Texture
from p2gs.types import Camera, UserError

K = np.array([[110.0, 0, 64], [0, 110, 48], [0, 0, 1]])


def room():
    """Floor, a wall behind, a box on the floor aside, and the object (part 1) before the cameras."""
    floor = box((-3, -3, -0.05), (3, 3, 0), Texture("checks", (0.6, 0.5, 0.3), (0.3, 0.3, 0.5), 0.5, 1))
    wall = box((-1.1, -3, 0), (-1.0, 3, 2.5), Texture("noise", (0.8, 0.8, 0.7), (0.4, 0.6, 0.4), 0.6, 2))
    aside = box((-0.8, 0.9, 0), (-0.4, 1.3, 0.35), Texture("checks", (0.2, 0.8, 0.3), (0.9, 0.9, 0.2), 0.2, 3))
    thing = box((-0.3, -0.3, 0), (0.3, 0.3, 0.7), Texture("noise", (0.8, 0.15, 0.1), (0.6, 0.1, 0.1), 0.3, 4))
    return [floor, wall, aside, thing], [0, 0, 0, 1]


def test_the_object_is_told_from_the_room():
    primitives, parts = room()
    pictures, truths, points = [], [], []
    for i, angle in enumerate(np.linspace(-1.2, 1.2, 18)):
        view = look_at(np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), (0.6, 1.1, 1.6)[i % 3]]), (0, 0, 0.35))
        shot = render(primitives, parts, view, K, 128, 96, samples=1)
        pictures.append(
            Picture(
                Camera(torch.tensor(view).float(), torch.tensor(K).float(), 128, 96),
                torch.from_numpy(shot.image).float() / 255,
            )
        )
        truths.append(shot.parts == 1)
        v, u = np.nonzero((shot.depth > 0) & (np.random.default_rng(i).random(shot.depth.shape) < 0.01))
        local = (
            np.stack([(u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(u))], 1)
            * shot.depth[v, u, None]
        )
        points.append((local - view[:3, 3]) @ view[:3, :3])
    xyz = np.concatenate(points)
    cameras = np.array([p.camera.position.numpy() for p in pictures])
    region = region_of(xyz, cameras, np.array([0, 0, 0.35]), 2.2)
    assert len(region.planes) == 2  # floor and wall
    assert abs(region.planes[1] @ [1, 0, 0, 0]) > 0.99 and abs(region.planes[1][3] + 1.0) < 0.02
    splat = initial(region, xyz, np.full((len(xyz), 3), 128, np.uint8))
    fit(splat, pictures, region.distance, steps=250)
    rows = object_rows(splat, region)
    hull = hull_of(region, [(p.camera, shares(splat, rows, p.camera) > 0.5) for p in pictures])
    overlaps = []
    for picture, truth in zip(pictures, truths, strict=True):
        found, believed = object_in(splat, rows, hull, picture.camera, picture)
        assert believed
        overlaps.append((found & truth).sum() / (found | truth).sum())
    assert np.median(overlaps) > 0.8, overlaps


def outlined(*bodies: np.ndarray) -> list[tuple[Camera, list[np.ndarray]]]:
    """What 24 cameras around see of bodies of points [N, 3]: the camera and a picture [96, 128] bool of each body."""
    out = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False)):
        view = look_at(np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0 + 0.5 * (i % 3)]), (0, 0, 0.5))
        pictures = []
        for points in bodies:
            local = points @ view[:3, :3].T + view[:3, 3]
            x, y = (local[:, :2] / local[:, 2:] @ K[:2, :2] + K[:2, 2]).astype(int).T
            shown = (x >= 0) & (x < 128) & (y >= 0) & (y < 96)
            pictures.append(np.zeros((96, 128), bool))
            pictures[-1][y[shown], x[shown]] = True
        out.append((Camera(torch.tensor(view).float(), torch.tensor(K).float(), 128, 96), pictures))
    return out


REGION = Region(np.array([0, 0, 0.5]), 3.0, np.array([[0.0, 0, 1, 0]]))
INSIDE = np.random.default_rng(0).uniform((-0.3, -0.3, 0), (0.3, 0.3, 0.9), (60_000, 3))
ASIDE = np.random.default_rng(1).uniform((0.9, -0.1, 0), (1.1, 0.1, 0.3), (20_000, 3))


def test_a_hull_forgives_a_ragged_outline_and_leaves_out_what_stands_aside():
    outlines = [(camera, inside | aside, inside) for camera, (inside, aside) in outlined(INSIDE, ASIDE)]
    outlines[5][1][:, :64] = False  # half of it is missing in one photograph
    hull = hull_of(REGION, [(c, o) for c, o, _ in outlines])
    lo, hi = hull.points.min(0), hull.points.max(0)
    assert np.abs(lo - [-0.3, -0.3, 0]).max() < 0.1 and np.abs(hi - [0.3, 0.3, 0.9]).max() < 0.1
    camera, _, alone = outlines[5]
    assert (alone & hull.outline(camera))[:, :64].sum() > 0.95 * alone[:, :64].sum() > 100
    assert len(hull_of(REGION, [(c, np.zeros_like(o)) for c, o, _ in outlines]).points) == 0


def test_a_front_that_hangs_in_the_air_is_the_objects():
    """A drawer's front half a body's width before it, its sides too thin to show; a box stands on the floor."""
    front = np.random.default_rng(2).uniform((0.6, -0.25, 0.3), (0.65, 0.25, 0.6), (20_000, 3))
    beside = ASIDE * [1, -1, 1] + [0, 1.0, 0]
    drawn = outlined(INSIDE, front, beside)
    hull = hull_of(REGION, [(c, np.any(bodies, 0)) for c, bodies in drawn])
    assert abs(hull.points[:, 0].max() - 0.65) < 0.1 and hull.points[:, 1].max() < 0.45
    for camera, (_, seen, _) in drawn[::5]:
        assert (seen & hull.outline(camera)).sum() > 0.9 * seen.sum()


def test_fog_at_the_pictures_rim_is_not_what_they_were_taken_of():
    """Before a bright ceiling, above the object, where a third of the photographs reaches."""
    fog = np.random.default_rng(3).uniform((-0.15, -0.15, 1.5), (0.15, 0.15, 1.7), (20_000, 3))
    outlines = []
    for k, (camera, bodies) in enumerate(outlined(INSIDE, fog)):
        cut = 36 if k % 3 else 0
        low = camera.cropped(0, cut, 128, 96 - cut)
        outlines.append((low, np.any(bodies, 0)[cut:]))
        assert bodies[1][cut:].any() == (cut == 0)
    hull = hull_of(REGION, outlines)
    assert abs(hull.points[:, 2].max() - 0.9) < 0.1


def test_the_second_look_is_at_the_windows_that_both_hulls_fill():
    """Lenses of four times the coarse pictures' pixels; at the end something is drawn out to the side."""
    out = INSIDE * [0.3, 0.3, 0.2] + [0.5, 0, 0.5]
    drawn, looks = outlined(INSIDE, out), []
    lens = Lens("PINHOLE", 512, 384, np.array([440.0, 440.0, 256.0, 192.0]))
    model = Model({0: lens}, {}, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    for k, (camera, _) in enumerate(drawn):
        model.photos[k] = Photo(f"{'end' if k % 2 else 'start'}/{k}.jpg", 0, camera.viewmat.double().numpy())
    for end in (0, 1):
        cameras = {k: camera for k, (camera, _) in enumerate(drawn) if k % 2 == end}
        hull = hull_of(REGION, [(cameras[k], np.any(drawn[k][1][: 1 + end], 0)) for k in cameras])
        looks.append(Look({}, cameras, Splat({}, 0), torch.zeros(0, dtype=torch.bool), hull))
    near, windows = nearer(REGION, looks, model)
    longest = []
    for k, (_, bodies) in enumerate(drawn):
        rows, columns = windows[k]
        seen = np.any(bodies, 0)
        assert np.kron(seen, np.ones((4, 4), bool))[windows[k]].sum() == 16 * seen.sum()
        longest.append(max(rows.stop - rows.start, columns.stop - columns.start) / 512)
        assert longest[-1] < 1.5 * max(seen.any(1).sum(), seen.any(0).sum()) / 128 + 0.05
    both = np.concatenate([INSIDE, out])
    assert (near.box[0] < both.min(0)).all() and (near.box[1] > both.max(0)).all()
    assert near.share == pytest.approx(np.median(longest))
    boxed = nearer(replace(REGION, box=np.array([[-0.2, -9, -9], [9, 9, 0.5]])), looks, model)[0].box
    assert boxed[0][0] == -0.2 and boxed[1][2] == 0.5


def test_the_second_look_knows_what_stands_beside_the_box():
    xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    first = initial(REGION, xyz, rgb)
    box = np.stack([INSIDE.min(0), INSIDE.max(0)])
    near = replace(REGION, box=box, share=0.5)
    second = initial(near, xyz, rgb, before=first)
    own, beside = second.params["means"][: second.cloud], first.params["means"][: first.cloud]
    assert near.holds(own.detach().numpy()).all() and second.cloud == first.cloud
    beside = beside[~torch.from_numpy(near.holds(beside.detach().numpy()))]
    assert 0 < len(beside) < first.cloud
    assert torch.equal(second.params["means"][-len(beside) :], beside)
    assert {len(v) for v in second.params.values()} == {len(initial(near, xyz, rgb).params["means"]) + len(beside)}


def test_sharpening_moves_an_edge_to_the_picture_and_not_further():
    image = np.full((90, 120, 3), 60, np.uint8) + np.random.default_rng(0).integers(0, 12, (90, 120, 3)).astype(
        np.uint8
    )
    image[20:70, 30:90] += 120
    share = np.zeros((90, 120))
    share[22:70, 30:88] = 1  # two pixels short at two sides
    cut = sharpened(image, share)
    truth = np.zeros((90, 120), bool)
    truth[20:70, 30:90] = True
    assert (cut != truth).sum() < 0.25 * ((share > 0.5) != truth).sum()
    flat = np.full((90, 120, 3), 100, np.uint8)
    assert (sharpened(flat, share) != (share > 0.5)).sum() <= 0.15 * share.sum()


def test_a_leg_thinner_than_the_band_stays_though_it_is_coloured_like_the_floor():
    rng = np.random.default_rng(0)
    image = np.full((200, 240, 3), 90, np.uint8) + rng.integers(0, 12, (200, 240, 3)).astype(np.uint8)
    image[30:80, 40:200] += 120  # a table's top; its leg is as the floor
    share = np.zeros((200, 240))
    share[30:80, 40:200] = share[80:180, 60:64] = 1
    cut = sharpened(image, share)
    assert cut[90:170, 61:63].mean() > 0.95
    assert (cut != (share > 0.5)).sum() < 0.02 * share.sum()


def test_a_mask_goes_back_through_the_lens():
    lens = Lens("OPENCV", 320, 240, np.array([260.0, 260, 160, 120, -0.08, 0.01, 0, 0]))
    from p2gs.data.capture.write import pinhole_of

    pinhole = pinhole_of(lens)
    ray = np.array([[0.3, -0.2, 1.0]])
    u, v = (pinhole.K @ ray[0])[:2]
    mask = np.zeros((240, 320), bool)
    mask[int(v) - 4 : int(v) + 4, int(u) - 4 : int(u) + 4] = True
    out = distorted(mask, lens)
    rows, cols = np.nonzero(out)
    x, y = lens.project(ray)[0]
    assert abs(cols.mean() + 0.5 - x) < 1.0 and abs(rows.mean() + 0.5 - y) < 1.0


def shots(count=8):
    return [
        Shot(f"{s}/{i:04d}.jpg", f"/x/{s}/IMG_{i}.jpg", 40, 30, None, "", 1.0)
        for s in ("start", "end")
        for i in range(count)
    ]


def test_given_masks_are_found_by_name_and_scaled(tmp_path):
    import cv2

    for shot in shots():
        state, stem = shot.name.split("/")[0], shot.source.split("/")[-1]
        (tmp_path / state).mkdir(exist_ok=True)
        mask = np.zeros((60, 80), np.uint8)
        mask[20:40, 20:60] = 255
        cv2.imwrite(str(tmp_path / state / f"{stem}.png"), mask)  # a.jpg.png
    found = folder_masks(shots(), tmp_path)
    assert len(found) == 16 and all(m.shape == (30, 40) and (m > 127).sum() == 200 for m in found.values())
    (tmp_path / "start/IMG_3.jpg.png").unlink()
    with pytest.raises(UserError, match="IMG_3.jpg"):
        folder_masks(shots(), tmp_path)


def test_empty_masks_are_left_out_and_too_many_refused(tmp_path):
    masks = {s.name: np.full((4, 4), 255, np.uint8) for s in shots(10)}
    masks["start/0000.jpg"][:] = 0
    assert len(shown(masks, tmp_path)) == 19
    for i in range(5):
        masks[f"end/{i:04d}.jpg"][:] = 0
    with pytest.raises(UserError, match="5 of 10 masks are empty"):
        shown(masks, tmp_path)
