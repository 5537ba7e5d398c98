"""What makes a capture precise: features placed by their pixels, the board's known centres, cameras that are sure."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from p2gs.data.capture.board import CENTRE, corner_id, measured, template, with_centre
from p2gs.data.capture.certainty import UNSURE, spreads, without_unsure
from p2gs.data.capture.joint import adjusted
from p2gs.data.capture.keypoint_fit import refined
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.pipeline import _check_arc
from p2gs.data.generated.synthetic import look_at
from p2gs.types import UserError

FOCAL, WIDTH, HEIGHT = 600.0, 640, 480
LENS = Lens("RADIAL", WIDTH, HEIGHT, np.array([FOCAL, 324.0, 238.0, -0.05, 0.01]))


def cameras(count: int, slant: float) -> list[np.ndarray]:
    """World to camera [4, 4] about the plane x = 0, up to ``slant`` degrees off its normal."""
    out = []
    for i, angle in enumerate(np.radians(np.linspace(-slant, slant, count))):
        eye = np.array([2 * np.cos(angle), 2 * np.sin(angle), -0.3 + 0.3 * (i % 3)])
        out.append(look_at(eye, np.array([0, 0.02 * (i % 2), 0])))
    return out


def plane_model(count: int = 6, points: int = 150, slant: float = 55.0, seed: int = 0) -> Model:
    """Points of the plane x = 0 and their true pixels in ``count`` photographs."""
    rng = np.random.default_rng(seed)
    xyz = np.c_[np.zeros(points), rng.uniform(-0.6, 0.6, (points, 2)) * [1, 0.7]]
    ids = np.arange(1, points + 1)
    photos = {i: Photo(f"start/{i}.png", 0, view) for i, view in enumerate(cameras(count, slant))}
    model = Model({0: LENS}, photos, ids, xyz, np.zeros((points, 3), np.uint8))
    return replace(
        model, photos={i: replace(p, xy=model.pixels_of(i, xyz), point=ids.copy()) for i, p in photos.items()}
    )


def shifted(model: Model, noise: float, seed: int = 1) -> Model:
    rng = np.random.default_rng(seed)
    photos = {k: replace(p, xy=p.xy + noise * rng.normal(size=p.xy.shape)) for k, p in model.photos.items()}
    return replace(model, photos=photos)


def off(model: Model, truth: Model) -> np.ndarray:
    return np.concatenate([np.linalg.norm(model.photos[k].xy - truth.photos[k].xy, axis=1) for k in truth.photos])


def paint(model: Model, folder, gain=lambda i: 1.0) -> None:
    """The photographs of a random picture on the plane, each brighter or darker by ``gain``."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (900, 1200)).astype(np.float32), (0, 0), 4)
    texture = (texture - texture.mean()) * 6 + 128
    (folder / "start").mkdir()
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.pad(LENS.rays(np.stack([x.ravel(), y.ravel()], 1)), ((0, 0), (0, 1)), constant_values=1.0)
    for i, photo in model.photos.items():
        way = rays @ photo.viewmat[:3, :3]
        at = photo.position + way * (-photo.position[0] / way[:, 0])[:, None]
        column, row = ((at[:, 1] + 1) * 600 - 0.5, (at[:, 2] + 0.75) * 600 - 0.5)
        maps = [c.reshape(HEIGHT, WIDTH).astype(np.float32) for c in (column, row)]
        image = cv2.remap(texture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) * gain(i)
        cv2.imwrite(str(folder / photo.name), np.clip(image, 0, 255).astype(np.uint8))


def test_features_go_where_the_pixels_say(tmp_path):
    """Half a pixel of noise comes down to a twentieth, at slants up to 55 degrees and in photographs of other exposure;
    the point that all mean may be any near the true one, so a common shift is none."""
    truth = plane_model()
    paint(truth, tmp_path, gain=lambda i: 1 - 0.08 * (i % 3))
    noisy = shifted(truth, 0.5)
    found, share = refined(noisy, tmp_path, np.zeros(0, np.int64))
    assert np.median(off(noisy, truth)) > 0.5
    assert share > 0.95 and np.median(off(found, truth)) < 0.05 and np.quantile(off(found, truth), 0.9) < 0.15


def test_features_of_another_picture_and_fixed_ones_stay(tmp_path):
    truth = plane_model()
    paint(truth, tmp_path)
    strange = np.random.default_rng(9).uniform(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / truth.photos[5].name), strange)
    noisy = shifted(truth, 0.5)
    found, _ = refined(noisy, tmp_path, truth.ids[:20])
    assert np.mean((found.photos[5].xy == noisy.photos[5].xy).all(1)) > 0.8
    assert all((found.photos[k].xy[:20] == noisy.photos[k].xy[:20]).all() for k in noisy.photos)


def board_model(times: int) -> tuple[Model, dict[int, int]]:
    """A model, in other units, of the board's corners and centres a little off, and {number: id of the first point}."""
    rng, ids, xyz, points = np.random.default_rng(0), [], [], {}
    turn = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0]
    for marker, corners in template().items():
        for c, place in enumerate([*corners, corners.mean(0)]):
            points[corner_id(marker, c)] = 1 + len(ids)
            place = 3 * turn @ place + [1, 2, 3] + 1e-4 * rng.normal(size=3)
            for _ in range(times):
                ids.append(1 + len(ids))
                xyz.append(place)
    photo = Photo("start/0.png", 0, look_at(np.array([3.0, 2.0, 5.0]), np.array([1.0, 2.0, 3.0])))
    return Model({0: LENS}, {0: photo}, np.array(ids), np.array(xyz), np.zeros((len(ids), 3), np.uint8)), points


@pytest.mark.parametrize("times", [1, 3])
def test_the_boards_centres_lie_where_they_are_printed(times):
    model, points = board_model(times)
    placed, known, rms = measured(model, points, times)
    assert len(known) == 12 * times and 1e-5 < rms < 2e-4
    for marker, corners in template().items():
        rows = [points[corner_id(marker, CENTRE)] - 1 + k for k in range(times)]
        assert np.abs(placed.xyz[rows] - corners.mean(0)).max() < 1e-12
        corner = placed.xyz[points[corner_id(marker, 0)] - 1]  # no longer 3 metres a metre, and not moved otherwise
        assert 0 < np.abs(corner - corners[0]).max() < 2e-4
    few = {k: v for k, v in points.items() if k < 5}
    assert measured(model, few, times) == (model, [], None)
    bent = replace(model, xyz=model.xyz + 0.02 * np.sin(20 * model.xyz[:, :1]))
    same, none, rms = measured(bent, points, times)
    assert same is bent and none == [] and rms > 0.001


def test_a_markers_centre_is_where_its_diagonals_meet():
    H = np.array([[90, 12, 300], [-8, 70, 200], [0.2, 0.1, 1.0]])
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]])
    seen = np.c_[square, np.ones(5)] @ H.T
    seen = seen[:, :2] / seen[:, 2:]
    assert np.abs(with_centre(seen[:4]) - seen).max() < 1e-9


def test_known_points_calibrate_the_lens_of_a_flat_scene(tmp_path):
    """A plane does not tell a lens from a bent plane; some of its points known, and one observation in ten wrong by
    three pixels."""
    pytest.importorskip("pycolmap")
    truth = plane_model(count=9, slant=50)
    noisy, rng = shifted(truth, 0.03), np.random.default_rng(4)
    photos = {}
    for k, p in noisy.photos.items():
        wrong = rng.random(len(p.xy)) < 0.1
        photos[k] = replace(p, xy=p.xy + np.where(wrong[:, None], [3.0, -1.0], 0.0))
    lens = replace(LENS, params=np.array([FOCAL * 1.03, 320.0, 240.0, 0.0, 0.0]))
    model = Model({0: lens}, photos, truth.ids, truth.xyz, truth.rgb)
    for _ in range(2):
        model = adjusted(model, tmp_path, True, print, truth.ids[:40].tolist())
    assert np.abs(model.xyz[:40] - truth.xyz[:40]).max() < 1e-9
    assert np.abs(model.lenses[0].params[:3] - LENS.params[:3]).max() < 1.0
    apart = [np.linalg.norm(model.photos[k].position - p.position) for k, p in truth.photos.items()]
    assert max(apart) < 0.003


def test_the_spread_of_a_camera_is_what_noise_makes_of_it():
    """Against 200 fits of its pose to pixels with noise."""
    truth, noise, rng = plane_model(count=3, points=40), 0.4, np.random.default_rng(0)
    photo, centres = truth.photos[1], []

    def residual(x, pixels):
        view = np.eye(4)
        view[:3, :3] = cv2.Rodrigues(x[:3])[0] @ photo.viewmat[:3, :3]
        view[:3, 3] = photo.viewmat[:3, 3] + x[3:]
        return (LENS.project(truth.xyz @ view[:3, :3].T + view[:3, 3]) - pixels).ravel()

    for _ in range(200):
        x = least_squares(residual, np.zeros(6), args=(photo.xy + noise * rng.normal(size=photo.xy.shape),)).x
        R = cv2.Rodrigues(x[:3])[0] @ photo.viewmat[:3, :3]
        centres.append(-R.T @ (photo.viewmat[:3, 3] + x[3:]))
    measured_spread = float(np.sqrt(np.var(centres, axis=0).sum()))
    assert 0.7 < spreads(shifted(truth, noise))[1] / measured_spread < 1.4


def test_photographs_that_show_too_little_are_left_out():
    model = shifted(plane_model(count=6), 0.3)
    few = {k: np.arange(len(p.xy)) < (8 if k == 2 else 2 if k == 3 else 999) for k, p in model.photos.items()}
    photos = {k: replace(p, xy=p.xy[few[k]], point=p.point[few[k]]) for k, p in model.photos.items()}
    model = replace(model, photos=photos)
    assert sorted(without_unsure(model).photos) == [0, 1, 4, 5]
    spread, distance = spreads(model), model.centre()[1]
    assert spread[3] == np.inf and spread[2] > UNSURE * distance > spread[0]


def test_a_state_with_few_sure_photographs_is_refused():
    model = plane_model(count=6)
    with pytest.raises(UserError, match="only 6 photographs are placed surely"):
        _check_arc(model, "start")
    with pytest.raises(UserError, match="state 'end': only 0 photographs"):
        _check_arc(model, "end")
