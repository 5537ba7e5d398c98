"""The choice of the static hypothesis, the joint model's points, gains, board and floor, on point clouds with known
answers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs.data.capture.board import board_pose, find_board, template, with_corners, write_board
from p2gs.data.capture.frame import floor_of, to_world
from p2gs.data.capture.gains import solve_gains
from p2gs.data.capture.hypotheses import State, find_hypotheses
from p2gs.data.capture.joint import END_OFFSET, filtered, guided_pairs, merged, state_bias, states_of
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.static import check_link, choose, link
from p2gs.data.generated.synthetic import look_at
from p2gs.types import UserError

LENS = Lens("OPENCV", 960, 720, np.array([750.0, 750, 480, 360, -0.04, 0.01, 0, 0]))
DRAWER_MOTION = np.array([0.3, 0.0, 0.0])


def reconstruction(xyz, descriptors, state, seed, T=None, noise=0.3):
    """A state's model as structure from motion leaves it: noisy pixels, a frame of its own (T)."""
    rng = np.random.default_rng(seed)
    photos = {}
    model = Model({1: LENS}, photos, np.arange(1, len(xyz) + 1), xyz, np.zeros((len(xyz), 3), np.uint8))
    for i, angle in enumerate(np.linspace(-1.1, 1.1, 16)):
        height = (0.5, 1.0, 1.5)[i % 3]
        photos[i + 1] = Photo(
            f"{state}/{i:04d}.jpg",
            1,
            look_at(np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), height]), (0, 0, 0.45)),
        )
        pixels = model.pixels_of(i + 1, xyz)
        inside = np.isfinite(pixels).all(1) & (pixels > 0).all(1) & (pixels < [960, 720]).all(1)
        photos[i + 1].xy, photos[i + 1].point = (
            pixels[inside] + noise * rng.normal(size=(inside.sum(), 2)),
            model.ids[inside],
        )
    counts = np.bincount(model.observations()[0], minlength=len(xyz))
    keep = counts >= 3
    for p in photos.values():
        p.point = np.where(np.isin(p.point, model.ids[keep]), p.point, -1)
    model = Model(
        {1: LENS}, photos, model.ids[keep], xyz[keep] + 0.002 * rng.normal(size=(keep.sum(), 3)), model.rgb[keep]
    )
    return State(model if T is None else model.moved(T), descriptors[keep])


def two_states(room: int, drawer: int, board=False):
    """A room (floor and wall) with ``room`` points, a drawer's front with ``drawer``, which comes out by
    ``DRAWER_MOTION``."""
    rng = np.random.default_rng(3)
    floor = np.c_[
        rng.uniform(-1.2, 1.6, (room // 2, 1)), rng.uniform(-1.5, 1.5, (room // 2, 1)), np.zeros((room // 2, 1))
    ]
    wall = np.c_[
        np.full((room - room // 2, 1), -1.0),
        rng.uniform(-1.5, 1.5, (room - room // 2, 1)),
        rng.uniform(0, 2, (room - room // 2, 1)),
    ]
    front = np.c_[
        np.full((drawer, 1), 0.3), rng.uniform(-0.25, 0.25, (drawer, 1)), rng.uniform(0.35, 0.55, (drawer, 1))
    ]
    xyz = np.concatenate([floor, wall, front])
    moves = np.arange(len(xyz)) >= room
    d = np.abs(rng.normal(size=(len(xyz), 128))).astype(np.float32) ** 3
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 1.3 * Rotation.from_euler("xyz", [20, 40, -30], degrees=True).as_matrix(), (0.3, -1, 2)
    end = xyz + moves[:, None] * DRAWER_MOTION
    return reconstruction(xyz, d, "start", 1), reconstruction(end, d, "end", 2, T), T


def test_the_room_is_chosen_though_the_drawer_has_more_votes():
    start, end, T = two_states(room=150, drawer=400)
    found = find_hypotheses(start, end)
    assert len(found) >= 2
    assert len(found[1].pairs) > len(found[0].pairs)  # the drawer has the majority
    chosen = found[choose(found, None, Path("x"))].T
    assert np.linalg.norm(np.linalg.inv(T) @ chosen - np.eye(4)) < 0.02
    assert choose(found, 1, Path("x")) == 1  # a user's word is taken


def test_a_capture_that_shows_the_drawer_alone_is_refused():
    start, end, _ = two_states(room=0, drawer=400)
    with pytest.raises(UserError, match="moving part"):
        choose(find_hypotheses(start, end), None, Path("x"))


def test_states_without_anything_in_common_are_refused():
    start, end, _ = two_states(room=150, drawer=0)
    stranger = replace(end, descriptors=np.roll(end.descriptors, 7, axis=1))
    with pytest.raises(UserError, match="too little in common"):
        choose(find_hypotheses(start, stranger), None, Path("x"))


def test_the_joint_model_joins_the_room_and_not_the_drawer():
    start, end, T = two_states(room=200, drawer=200)
    pairs = guided_pairs(start, end, T)
    room = start.model.ids <= 200
    assert room[pairs[:, 0]].sum() > 0.8 * room.sum()
    assert not room[pairs[:, 0]].all() or len(pairs) <= room.sum()
    assert (~room[pairs[:, 0]]).sum() == 0
    joint = filtered(merged(start.model, end.model, T, pairs), 12.0)
    assert len(joint.photos) == 32 and len(joint.lenses) == 1
    assert states_of(joint).all(1).sum() > 0.8 * room.sum()
    bias = state_bias(joint)
    assert bias.shift < 0.003 and bias.turn < 0.1
    # an end state that hangs 2 cm off shows
    shift = np.eye(4)
    shift[0, 3] = 0.02
    off = merged(start.model, end.model, T @ shift, pairs)
    assert 0.015 < state_bias(off).shift < 0.025
    assert all(k > END_OFFSET for k, p in off.photos.items() if p.name.startswith("end"))


def test_gains_are_recovered_with_zero_mean():
    rng = np.random.default_rng(0)
    true = 0.15 * rng.normal(size=(20, 3)) + np.where(np.arange(20)[:, None] < 10, 0.1, -0.1) * [1, 0, -1]
    true -= true.mean(0)
    colours = rng.uniform(-2, 0, (300, 3))
    rows, images = np.nonzero(rng.random((300, 20)) < 0.4)
    logs = colours[rows] + true[images] + 0.02 * rng.normal(size=(len(rows), 3))
    logs[rng.random(len(rows)) < 0.1] += 0.8  # highlights
    found = solve_gains(rows, images, logs)
    got = np.array([found[i] for i in range(20)])
    assert np.abs(got.mean(0)).max() < 1e-12
    assert np.abs(got - true).max() < 0.02


def test_the_floor_is_up_and_at_zero():
    start, _, _ = two_states(room=300, drawer=50)
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("xyz", [100, 20, 30], degrees=True).as_matrix()
    model = start.model.moved(tilted)
    floor = floor_of(model)
    assert floor.source == "floor plane"
    placed = model.moved(to_world(floor, model, 1.0))
    assert np.abs(placed.xyz[placed.ids <= 150, 2]).max() < 0.015
    assert min(p.position[2] for p in placed.photos.values()) > 0.4


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_board_gives_scale_and_up(tmp_path, mirrored):
    """The printed sheet, warped into photographs by known cameras, is found and measured."""
    import cv2

    write_board(tmp_path / "board.png")
    sheet = cv2.imread(str(tmp_path / "board.png"))
    if mirrored:
        sheet = np.ascontiguousarray(sheet[:, ::-1])
    per_pixel = 0.0254 / 300 * 2.5  # model units a pixel: the model's unit is 0.4 m
    lens = Lens("PINHOLE", 960, 720, np.array([900.0, 900, 480, 360]))
    photos = {}
    to_plane = np.array(
        [[per_pixel, 0, -sheet.shape[1] / 2 * per_pixel], [0, -per_pixel, sheet.shape[0] / 2 * per_pixel], [0, 0, 1]]
    )
    for i, angle in enumerate(np.linspace(-1, 1, 6)):
        view = look_at(np.array([2.0 * np.cos(angle), 2.0 * np.sin(angle), 1.5]), (0, 0, 0))
        H = lens.K @ view[:3][:, [0, 1, 3]] @ to_plane
        photos[i] = Photo(f"start/{i}.png", 0, view)
        (tmp_path / "start").mkdir(exist_ok=True)
        warped = cv2.warpPerspective(sheet, H, (960, 720), flags=cv2.INTER_AREA, borderValue=(120, 120, 120))
        cv2.imwrite(str(tmp_path / photos[i].name), warped)
    none = np.zeros(0, np.int64)
    model = Model({0: lens}, photos, none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    seen = find_board([p.name for p in photos.values()], tmp_path)
    assert len(seen) >= 4
    model, corners = with_corners(model, seen)
    T, rms = board_pose(model, corners)
    assert len(corners) >= 40 and rms < 0.001
    assert abs(np.cbrt(np.linalg.det(T[:3, :3])) / 2.5 - 1) < 0.005
    assert abs(T[2, 2]) / np.linalg.norm(T[:3, 2]) > np.cos(np.radians(0.5))  # the sheet lies level
    assert len(template()) == 12


def joined_by_corners(seen_end):
    """A joint model whose states share marker corners alone; where the end sees them [4, 4] from where they are."""
    start, end, T = two_states(room=0, drawer=200)
    floor = np.c_[np.random.default_rng(5).uniform((0.6, -0.1), (0.8, 0.1), (40, 2)), np.zeros(40)]
    joint = merged(start.model, end.model, T, np.zeros((0, 2), np.int64))
    ids = np.arange(10_000, 10_040)
    photos = {}
    for key, photo in joint.photos.items():
        points = floor @ seen_end[:3, :3].T + seen_end[:3, 3] if photo.name.startswith("end") else floor
        pixels = joint.pixels_of(key, points)
        fine = np.isfinite(pixels).all(1)
        photos[key] = replace(
            photo, xy=np.vstack([photo.xy, pixels[fine]]), point=np.concatenate([photo.point, ids[fine]])
        )
    rgb = np.vstack([joint.rgb, np.zeros((40, 3), np.uint8)])
    return Model(joint.lenses, photos, np.concatenate([joint.ids, ids]), np.vstack([joint.xyz, floor]), rgb)


def test_states_that_see_the_board_at_two_places_are_refused():
    check_link(link(joined_by_corners(np.eye(4))), True, Path("x"))
    moved, turned = np.eye(4), np.eye(4)
    moved[0, 3] = 0.01
    turned[:3, :3] = Rotation.from_euler("z", 0.4, degrees=True).as_matrix()
    for wrong in (moved, turned):
        with pytest.raises(UserError, match=r"the marker board .* 0\.\d\d % of the cameras' distance apart"):
            check_link(link(joined_by_corners(wrong)), True, Path("x"))
    start, end, T = two_states(room=0, drawer=200)
    with pytest.raises(UserError, match="too rarely"):
        check_link(link(merged(start.model, end.model, T, np.zeros((0, 2), np.int64))), True, Path("x"))


def test_states_that_few_points_join_are_refused():
    """A plain room: a handful of the points that looked alike are seen often enough, or they say it only roughly."""
    start, end, T = two_states(room=200, drawer=200)
    pairs = guided_pairs(start, end, T)
    joint = merged(start.model, end.model, T, pairs)
    check_link(link(joint), False, Path("x"))
    assert state_bias(merged(start.model, end.model, T, pairs[:20])).shift_sd > 1.5 * state_bias(joint).shift_sd
    with pytest.raises(UserError, match=r"x: both states see what stands still too rarely; .*newspapers"):
        check_link(link(merged(start.model, end.model, T, pairs[:5])), False, Path("x"))
    rough = replace(end.model, xyz=end.model.xyz + 0.01 * np.random.default_rng(0).normal(size=end.model.xyz.shape))
    seen = {
        k: replace(p, xy=rough.pixels_of(k, rough.xyz[np.searchsorted(rough.ids, p.point)]))
        for k, p in rough.photos.items()
    }
    with pytest.raises(
        UserError, match=r"both states see what stands still up to 0\.\d\d % of the cameras' distance apart"
    ):
        check_link(link(merged(start.model, replace(rough, photos=seen), T, pairs[:8])), False, Path("x"))
