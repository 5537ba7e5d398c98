"""Marker corners by the whole marker, against where they were drawn."""

import cv2
import numpy as np
import pytest

from p2gs.data.capture.board import find_markers, template, write_board
from p2gs.data.capture.marker_fit import fitted


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("board") / "board.png"
    write_board(path)
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def photographed(page, seed, wide):
    """The page under a random homography, about ``wide`` pixels across a marker, and where its markers' corners are."""
    rng = np.random.default_rng(seed)
    h, w = page.shape
    dpm = 300 / 0.0254  # pixels a metre
    left, top = (0.297 - 0.19) / 2, (0.210 - 0.14) / 2 - 0.010
    known = {m: (np.stack([left + c[:, 0], top - c[:, 1]], 1)) * dpm for m, c in template().items()}
    scale = wide / (0.040 * dpm)
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float64)
    there = corners * scale + rng.normal(0, 0.05 * scale * h, (4, 2)) + [60, 50]
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), there.astype(np.float32))
    fine, size = 8, (480, 360)
    big = np.diag([fine, fine, 1.0]) @ H  # drawn finely, then averaged over pixels: no aliasing
    drawn = cv2.warpPerspective(page, _half(big), (size[0] * fine, size[1] * fine), borderValue=120)
    image = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    image = 30 + 0.7 * image + rng.normal(0, 2, image.shape)
    truth = {m: cv2.perspectiveTransform(c[None], H)[0] for m, c in known.items()}
    return np.clip(image, 0, 255).astype(np.uint8), truth


def _half(H):
    """H of pixel corners as OpenCV wants it, of pixel centres."""
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    return np.linalg.inv(shift) @ H @ shift


@pytest.mark.parametrize("wide", [14.0, 30.0])
def test_corners_are_found_to_a_tenth_of_a_pixel(page, wide):
    off = []
    for seed in range(4):
        image, truth = photographed(page, seed, wide)
        rng = np.random.default_rng(seed)
        for marker, corners in truth.items():
            found = fitted(image.astype(np.float32), marker, corners + rng.normal(0, 0.4, (4, 2)))
            assert found is not None
            off.append(np.linalg.norm(found - corners, axis=1))
    assert np.median(off) < 0.1 and np.max(off) < 0.5


def test_another_picture_is_no_marker(page):
    image, truth = photographed(page, 0, 30.0)
    assert fitted(image.astype(np.float32), 3, truth[4]) is None  # its neighbour
    assert fitted(np.full((360, 480), 128, np.float32), 3, truth[3]) is None


def test_a_photograph_and_its_mirror_image_give_the_same_corners(page, tmp_path):
    image, truth = photographed(page, 1, 30.0)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "b.png"), image[:, ::-1])
    plain, mirrored = find_markers(tmp_path / "a.png"), find_markers(tmp_path / "b.png", mirrored=True)
    assert len(plain) >= 10 and plain.keys() == mirrored.keys()
    for marker, corners in plain.items():
        assert np.abs(corners - truth[marker]).max() < 0.3
        turned = np.stack([image.shape[1] - mirrored[marker][:, 0], mirrored[marker][:, 1]], 1)
        assert np.abs(turned - corners).max() < 0.02
