"""Blurred photographs are left out, of a video the sharpest frames are taken."""

import cv2
import numpy as np
import pytest
from test_capture_photos import LIMIT, SIZE, picture, sentence

from p2gs.data.capture.photos import copy_photos, drop_blurred
from p2gs.data.capture.sharpness import edge_blur
from p2gs.data.capture.video import sharp_frames
from p2gs.types import UserError


def test_the_width_of_edges_is_a_length():
    """Of a picture at 640 px that is blurred by a known sigma, on top of what a pixel does: whatever its contrast."""
    for seed in range(3):
        sharp = picture(seed, 640, 480, 60)
        larger = cv2.resize(sharp, None, fx=2.5, fy=2.5, interpolation=cv2.INTER_NEAREST)
        assert edge_blur(sharp) == pytest.approx(0.8, abs=0.1)
        for sigma in (1.0, 1.5, 2.5, 4.0):
            wide = pytest.approx(np.hypot(sigma, 0.75), rel=0.25)
            blurred = cv2.GaussianBlur(sharp, (0, 0), sigma)
            assert edge_blur(blurred) == wide and edge_blur((blurred * 0.3).astype(np.uint8) + 40) == wide
            assert edge_blur(cv2.GaussianBlur(larger, (0, 0), 2.5 * sigma)) == wide
        shaken = cv2.blur(sharp, (13, 1))  # a box of 13 px has the sigma 3.7; edges along the motion stay sharp
        assert edge_blur(shaken) > 2.5
    assert edge_blur(np.full((480, 640, 3), 77, np.uint8)) == 0


def shots_of(tmp_path, blur):
    """Copies of photographs of one thing, each blurred by so many pixels of 640 (sigma)."""
    for i, sigma in enumerate(blur):
        (tmp_path / "in").mkdir(exist_ok=True)
        pixels = picture(i, 640, 480)
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma) if sigma else pixels
        cv2.imwrite(str(tmp_path / "in" / f"{i}.png"), pixels)
    return copy_photos(tmp_path / "in", "start", tmp_path / "out", SIZE, LIMIT)


def test_blurred_photographs_are_left_out_with_a_reason(tmp_path):
    kept, reasons = drop_blurred(shots_of(tmp_path, [0, 0, 0, 1.2, 0, 0, 3, 0, 0, 0]))
    assert set(reasons) == {"start/0003.jpg", "start/0006.jpg"}
    assert len(kept) == 8 and not {s.name for s in kept} & set(reasons)
    assert "the median is" in reasons["start/0003.jpg"] and "expected at most 1.9" in reasons["start/0006.jpg"]


@pytest.mark.parametrize("blur", [[0] * 7 + [1.5] * 3, [3.0] * 10])
def test_too_few_sharp_photographs_are_refused(tmp_path, blur):
    with pytest.raises(UserError) as refused:
        drop_blurred(shots_of(tmp_path, blur))
    left = sum(b == 0 for b in blur)
    assert str(refused.value) == (
        f"{tmp_path / 'in'}: only {left} of 10 photographs are sharp, expected at least 8; hold still for each, with "
        "more light"
    )


def test_slightly_soft_photographs_are_kept(tmp_path):
    """A blur of 2 px at 1600 takes no photograph out of reconstruction."""
    kept, reasons = drop_blurred(shots_of(tmp_path, [0.8] * 10))
    assert len(kept) == 10 and not reasons


def test_captures_are_sharp_and_their_blurred_copies_are_not(repo):
    files = [
        file
        for name in ("cupboard_board", "fridge")
        for file in sorted((repo.parent / "shared" / "captures" / name / "start").glob("*.jpg"))[::6]
    ]
    if not files:
        pytest.skip("no captures beside the repository")
    for file in files:
        pixels = cv2.imread(str(file))[..., ::-1]
        width = [edge_blur(cv2.GaussianBlur(pixels, (0, 0), s * 960 / 1600) if s else pixels) for s in (0, 2, 4, 8)]
        assert width[0] < 1 and width[2] < 1.9 < width[3] and sorted(width) == width


def film(path, fourcc, frames, sharp=None):
    """A video of 30 frames a second; those that are not in ``sharp`` are blurred."""
    video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*fourcc), 30, (352, 288))
    if not video.isOpened():
        pytest.skip(f"this OpenCV cannot write {fourcc}")
    for i in range(frames):
        pixels = picture(i, 352, 288)
        video.write(pixels if sharp is None or i in sharp else cv2.GaussianBlur(pixels, (0, 0), 3))
    video.release()
    return path


def test_the_sharpest_frame_of_each_stretch_is_taken(tmp_path):
    """Ten stretches of six frames, of which every second is looked at."""
    rng = np.random.default_rng(4)
    sharp = [6 * i + 2 * int(rng.integers(3)) for i in range(10)]
    path = film(tmp_path / "walk.avi", "MJPG", 60, sharp)
    found = list(sharp_frames(path, 10))
    assert [round(t * 30) for t, _ in found] == sharp
    for i, (_, frame) in zip(sharp, found, strict=True):
        assert np.abs(frame[..., ::-1].astype(int) - picture(i, 352, 288)).mean() < 12
    shots = copy_photos(path, "end", tmp_path / "out", SIZE, 10)
    assert [s.source for s in shots] == [f"{path}#{i / 30:.2f}s" for i in sharp]
    assert {s.lens for s in shots} == {("video", 352, 288, None)} and len(drop_blurred(shots)[0]) == 10


@pytest.mark.parametrize(
    "ending, fourcc", [(".3gp", "mp4v"), (".mts", "MPG2"), (".mpg", "MPG1"), (".mpeg", "MPG2"), (".wmv", "WMV2")]
)
def test_videos_of_phones_and_camcorders_are_read(tmp_path, ending, fourcc):
    path = film(tmp_path / f"walk{ending.upper()}", fourcc, 40)
    assert len(copy_photos(path, "start", tmp_path / "out", SIZE, 12)) == 12


def test_a_video_that_is_none_or_too_short_is_refused(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"no video" * 100)
    assert "cannot be read as a video" in sentence(tmp_path / "walk.mp4", tmp_path / "out")
    short = film(tmp_path / "short.avi", "MJPG", 5)
    assert "fewer than 8 frames" in sentence(short, tmp_path / "out")


def test_a_blurred_video_is_refused_by_its_name(tmp_path):
    path = film(tmp_path / "walk#1.avi", "MJPG", 40, sharp=[])
    with pytest.raises(UserError, match=r"walk#1.avi: only 0 of 10 frames are sharp"):
        drop_blurred(copy_photos(path, "start", tmp_path / "out", SIZE, 10))
