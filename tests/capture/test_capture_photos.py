"""Photographs and videos become upright copies without tags; what cannot be used is refused in one sentence."""

import random
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from p2gs.data.capture.joint import END_OFFSET, merged
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.photos import copy_photos, lens_groups
from p2gs.types import UserError

SIZE, LIMIT = 1600, 60
PLACE = "HIDDENPLACE"
# what is stored for an upright picture, by EXIF 2.3's words for orientation: "the 0th row is the visual right side" ...
STORED = {
    1: lambda u: u,
    2: lambda u: u[:, ::-1],
    3: lambda u: u[::-1, ::-1],
    4: lambda u: u[::-1],
    5: lambda u: u.swapaxes(0, 1),
    6: lambda u: u.swapaxes(0, 1)[::-1],
    7: lambda u: u.swapaxes(0, 1)[::-1, ::-1],
    8: lambda u: u.swapaxes(0, 1)[:, ::-1],
}


def picture(seed=0, width=320, height=240, count=150):
    """[height, width, 3] uint8 of rectangles: steps of any height and no blur."""
    rng = np.random.default_rng(seed)
    out = np.full((height, width, 3), 128, np.uint8)
    for _ in range(count):
        x, y, w, h = rng.integers(0, (width, height, width // 3, height // 3))
        out[y : y + h, x : x + w] = rng.integers(0, 256, 3)
    return out


def tags(orientation=1, focal=26, model="Phone X", own=5.7):
    """EXIF with a place in it."""
    exif = Image.Exif()
    exif[0x0112], exif[0x0110], exif[0x013B] = orientation, model, PLACE
    exif.get_ifd(0x8769).update({0xA405: focal, 0x920A: own})
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 12.0), 3: "E", 4: (8.0, 32.0, 4.0), 28: PLACE.encode()})
    return exif


def written(folder, count=8, ending=".jpg", pixels=None, **of):
    """A folder of ``count`` photographs with tags."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        image = Image.fromarray(picture(i) if pixels is None else pixels)
        image.save(folder / f"IMG_{i}{ending}", exif=tags(**of), quality=95)
    return folder


def sentence(source, folder, size=SIZE):
    with pytest.raises(UserError) as refused:
        copy_photos(source, "start", folder, size, LIMIT)
    text = str(refused.value)
    assert text.startswith(str(source)) and "\n" not in text
    return text


@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp", ".tif"])
def test_copies_are_upright_whatever_way_the_phone_was_held(tmp_path, ending):
    upright = np.zeros((240, 320, 3), np.uint8)
    upright[:120, :160], upright[:120, 160:], upright[120:, :160] = (200, 30, 30), (30, 200, 30), (30, 30, 200)
    (tmp_path / "in").mkdir()
    for orientation, stored in STORED.items():
        image = Image.fromarray(np.ascontiguousarray(stored(upright)))
        image.save(tmp_path / "in" / f"{orientation}{ending}", exif=tags(orientation))
    for shot in copy_photos(tmp_path / "in", "start", tmp_path / "out", SIZE, LIMIT):
        copy = cv2.imread(str(tmp_path / "out" / shot.name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        assert (shot.width, shot.height) == (320, 240) and copy.shape == (240, 320, 3)
        assert np.abs(copy[..., ::-1].astype(int) - upright).mean() < 6, shot.source  # the edges ring a little


def no_tags_in(file):
    data = file.read_bytes()
    assert not [mark for mark in (b"Exif", b"http://ns.adobe", PLACE.encode(), b"Phone X") if mark in data]
    with Image.open(file) as image:
        assert not dict(image.getexif()) and not image.getexif().get_ifd(0x8825)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp", ".tif"])
def test_copies_do_not_tell_the_place(tmp_path, ending):
    pixels = np.dstack([picture(), np.full((240, 320), 255, np.uint8)])
    pixels[:50, :50, 3] = 0
    folder = written(tmp_path / "in", ending=ending, pixels=pixels if ending == ".png" else None)
    assert PLACE.encode() in (folder / f"IMG_0{ending}").read_bytes()
    shots = copy_photos(folder, "start", tmp_path / "out", SIZE, LIMIT)
    files = [f for f in (tmp_path / "out").rglob("*") if f.is_file()]
    assert len(files) == len(shots) * (2 if ending == ".png" else 1)
    for file in files:
        no_tags_in(file)


def test_heic_is_read_where_pillow_heif_is(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    folder = written(tmp_path / "in", ending=".HEIC", focal=24)
    shots = copy_photos(folder, "start", tmp_path / "out", SIZE, LIMIT)
    for i, shot in enumerate(shots):
        copy = cv2.imread(str(tmp_path / "out" / shot.name))[..., ::-1]
        assert np.abs(copy.astype(int) - picture(i)).mean() < 8
        assert shot.focal is not None and shot.device.startswith("Phone X")
        no_tags_in(tmp_path / "out" / shot.name)


def test_heic_without_pillow_heif_is_refused(tmp_path, monkeypatch):
    folder = written(tmp_path / "in")
    (folder / "IMG_3.jpg").rename(folder / "IMG_3.heic")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    text = sentence(folder, tmp_path / "out")
    assert "IMG_3.heic" in text and "p2gs[heic]" in text and "most compatible" in text


def test_no_photograph_is_lost_for_damaged_tags(tmp_path):
    folder, rng = tmp_path / "in", random.Random(0)
    data = (written(folder, 1) / "IMG_0.jpg").read_bytes()
    start = data.index(b"Exif\0\0") + 6
    end = data.index(b"\xff\xdb", start)  # quantization tables: the picture begins
    for i in range(300):
        bad = bytearray(data)
        for _ in range(rng.choice((1, 2, 4, 16, 64))):
            bad[rng.randrange(start, end)] = rng.choice((0, 1, 2, 255, rng.randrange(256)))
        (folder / f"IMG_{i}.jpg").write_bytes(bad)
    shots = copy_photos(folder, "start", tmp_path / "out", SIZE, 300)
    assert len(shots) == 300
    for shot in shots:
        upright = (shot.width, shot.height) == (320, 240)  # else the damage says that it lies on its side
        assert upright or (shot.width, shot.height) == (240, 320)
        # 8 to 3000 mm on a picture whose diagonal, 400 px, is 43.27 mm
        assert shot.focal is None or 73 < shot.focal < 27800
        copy = cv2.imread(str(tmp_path / "out" / shot.name))[..., ::-1]
        assert abs(copy.mean() - picture(0).mean()) < 2


@pytest.mark.parametrize("content", [b"", b"no photograph at all", "half"])
def test_a_photograph_without_pixels_is_refused_by_its_name(tmp_path, content):
    folder = written(tmp_path / "in")
    whole = (folder / "IMG_5.jpg").read_bytes()
    (folder / "IMG_5.jpg").write_bytes(whole[: len(whole) // 2] if content == "half" else content)
    assert "IMG_5.jpg: cannot be read as a photograph" in sentence(folder, tmp_path / "out")


@pytest.mark.parametrize("mm, known", [(26, True), (8, True), (3000, True), (0, False), (1, False), (65535, False)])
def test_only_focal_lengths_that_lenses_have_are_taken(tmp_path, mm, known):
    pixels = picture(width=720, height=480)  # as film: 36 mm are 720 px
    shots = copy_photos(written(tmp_path / "in", pixels=pixels, focal=mm), "start", tmp_path / "out", 360, LIMIT)
    for shot in shots:
        assert (shot.focal == pytest.approx(360 * mm / 36, rel=1e-3)) if known else shot.focal is None


def taken(tmp_path, state, *phones):
    """Shots of a state, eight by each phone or lens: (pixels' width, tags)."""
    for i, (width, of) in enumerate(phones):
        written(tmp_path / state / str(i), pixels=picture(width=width, height=width * 3 // 4), **of)
    for i in range(len(phones)):
        for file in (tmp_path / state / str(i)).iterdir():
            file.rename(tmp_path / state / f"{i}_{file.name}")
    return copy_photos(tmp_path / state, state, tmp_path / "out", SIZE, LIMIT)


MAIN, WIDE = dict(focal=26, own=5.7), dict(focal=13, own=1.57)


def test_the_lenses_of_a_phone_are_apart(tmp_path):
    groups = lens_groups(taken(tmp_path, "start", (320, MAIN), (320, WIDE), (640, MAIN)))
    assert [len(g["names"]) for g in groups] == [8, 8, 8]
    assert [g["params"][0] for g in groups] == pytest.approx([26 / 43.27 * 400, 13 / 43.27 * 400, 26 / 43.27 * 800])
    assert [g["params"][1:3] for g in groups] == [[160, 120], [160, 120], [320, 240]]


def test_lenses_are_apart_where_only_their_own_focal_length_is_told(tmp_path):
    groups = lens_groups(taken(tmp_path, "start", (320, MAIN | {"focal": 0}), (320, WIDE | {"focal": 0})))
    assert [(len(g["names"]), g["params"]) for g in groups] == [(8, []), (8, [])]


def solved(shots):
    """A model as structure from motion leaves it: a lens for each group, no points."""
    lenses, photos = {}, {}
    for key, group in enumerate(lens_groups(shots), 1):
        one = next(s for s in shots if s.name == group["names"][0])
        params = np.array(group["params"] or [300.0, one.width / 2, one.height / 2, 0, 0])
        lenses[key] = Lens("RADIAL", one.width, one.height, params)
        photos |= {len(photos) + i: Photo(n, key, np.eye(4)) for i, n in enumerate(group["names"], 1)}
    none = np.zeros(0, np.int64)
    return Model(lenses, photos, none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def lens_pairs(tmp_path, first, second, told=True):
    """For each of the second state's groups the focal length of the lens that it has in the joint model, and whether
    the first state has that lens."""
    shots = taken(tmp_path, "start", *first), taken(tmp_path, "end", *second)
    start, end = (solved(s) for s in shots)
    lens_of = {s.name: s.lens for s in shots[0] + shots[1]} if told else None
    joint = merged(start, end, np.eye(4), np.zeros((0, 2), np.int64), lens_of)
    assert len(joint.photos) == len(start.photos) + len(end.photos)
    out = []
    for group in end.lenses:
        keys = {joint.photos[k + END_OFFSET].lens for k, p in end.photos.items() if p.lens == group}
        (key,) = keys
        assert joint.lenses[key].params[0] == end.lenses[group].params[0] or not told
        out.append((round(float(joint.lenses[key].params[0] * 43.27 / 400)), key in start.lenses))
    return out


def test_states_share_a_lens_where_it_is_one(tmp_path):
    assert lens_pairs(tmp_path, [(320, MAIN), (320, WIDE)], [(320, WIDE), (320, MAIN)]) == [(13, True), (26, True)]


@pytest.mark.parametrize("other", [MAIN | {"model": "Phone Y"}, MAIN | {"focal": 52}])
def test_another_phone_or_lens_of_the_same_size_has_its_own(tmp_path, other):
    assert lens_pairs(tmp_path, [(320, MAIN)], [(320, other)]) == [(other["focal"], False)]


def test_lenses_of_a_size_are_one_where_nothing_is_told(tmp_path):
    assert lens_pairs(tmp_path, [(320, MAIN)], [(320, MAIN | {"focal": 52})], told=False) == [(26, True)]


def test_what_is_given_instead_of_a_folder_is_named(tmp_path):
    folder = written(tmp_path / "in")
    photo, other = folder / "IMG_0.jpg", tmp_path / "film.xyz"
    other.write_bytes(b"0" * 100)
    assert "is one photograph, expected a folder of at least 8" in sentence(photo, tmp_path / "out")
    assert "is neither a folder nor a known video" in sentence(other, tmp_path / "out")
    assert "there is no such folder" in sentence(tmp_path / "nothing", tmp_path / "out")


def test_photographs_in_a_folder_below_are_pointed_at(tmp_path):
    written(tmp_path / "card" / "DCIM" / "100APPLE", 9)
    written(tmp_path / "card" / "DCIM" / ".thumbnails", 20)
    for given, told in (("card", "DCIM/100APPLE"), ("card/DCIM", "100APPLE")):
        assert f"has 0 photographs, expected at least 8 from around the object; its folder {told} has 9" in sentence(
            tmp_path / given, tmp_path / "out"
        )
    (tmp_path / "empty").mkdir()
    assert sentence(tmp_path / "empty", tmp_path / "out").endswith("from around the object")


@pytest.mark.parametrize(
    "size, told", [((9000, 220), "is 9000x220 pixels, 1600x39 as a copy"), ((300, 190), "300x190")]
)
def test_the_copy_is_large_enough(tmp_path, size, told):
    folder = written(tmp_path / "in", pixels=np.full((size[1], size[0], 3), 90, np.uint8))
    text = sentence(folder, tmp_path / "out")
    assert "IMG_0.jpg: is " in text and told in text and text.endswith("expected at least 200 on the shorter side")


def test_200_megapixels_are_read(tmp_path):
    folder = written(tmp_path / "in", 7)
    pixels = np.full((12240, 16320), 60, np.uint8)
    pixels[:, 8160:] = 200
    cv2.imwrite(str(folder / "IMG_7.jpg"), pixels)
    before = Image.MAX_IMAGE_PIXELS
    shot = copy_photos(folder, "start", tmp_path / "out", SIZE, LIMIT)[-1]
    assert before == Image.MAX_IMAGE_PIXELS and (shot.width, shot.height) == (1600, 1200)
    copy = cv2.imread(str(tmp_path / "out" / shot.name))
    assert np.abs(copy[:, :790].astype(int) - 60).max() < 4 and np.abs(copy[:, 810:].astype(int) - 200).max() < 4


def test_bombs_are_refused_before_they_are_unpacked(tmp_path):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    folder = written(tmp_path / "in")
    for side, told in ((30_000, "has 30000x30000 pixels, expected at most 201 million"), (15_000, "has 15000x15000")):
        head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
        bomb = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")
        (folder / "IMG_2.jpg").write_bytes(bomb)
        text = sentence(folder, tmp_path / "out")
        assert "IMG_2.jpg" in text and (told in text or "could be decompression bomb" in text)
