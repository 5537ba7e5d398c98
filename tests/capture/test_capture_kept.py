"""What a capture keeps: stages that are not computed again, masks that may be edited, the page of what was seen."""

import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs.data.capture.cache import Cache
from p2gs.data.capture.given_masks import folder_masks
from p2gs.data.capture.hypotheses import Hypothesis
from p2gs.data.capture.kept_masks import check_unedited, kept_masks, mask_names
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.page import AGAINST, FOR, on_object, write_hypotheses
from p2gs.data.capture.photos import Shot
from p2gs.data.generated.synthetic import look_at
from p2gs.types import UserError

SIZE = (12, 9)


def shots(*sources):
    """A copy of each source, numbered by state, as the command numbers them."""
    out, count = [], {"start": 0, "end": 0}
    for state, source in sources:
        out.append(Shot(f"{state}/{count[state]:04d}.jpg", f"/photos/{state}/{source}", *SIZE, None, "phone", 1.0))
        count[state] += 1
    return out


def drawn(mine):
    """A mask of its own for each."""
    masks = {}
    for i, shot in enumerate(mine):
        masks[shot.name] = np.zeros(SIZE[::-1], np.uint8)
        masks[shot.name][: 1 + i % 9, : 1 + i // 9] = 255
    return masks


NUMBERED = [(state, f"{i:04d}.jpg") for state in ("start", "end") for i in range(1, 10)]
FRAMES = [(state, f"walk.mp4#{t:.2f}s") for state in ("start", "end") for t in np.linspace(1, 1.8, 9)]
ALIKE = [(state, f"a{i}.{kind}") for state in ("start", "end") for i in range(5) for kind in ("jpg", "png")]


@pytest.mark.parametrize("sources", [NUMBERED, FRAMES, ALIKE], ids=["numbered", "a video", "same stems"])
def test_masks_are_found_again_by_their_photographs(sources, tmp_path):
    mine = shots(*sources)
    masks = drawn(mine)
    del masks["end/0008.jpg"]  # of a photograph that could not be placed
    made = kept_masks(Cache(tmp_path / ".capture"), tmp_path / "masks", mine, 1, lambda: masks, print)
    found = folder_masks(mine, tmp_path / "masks")
    assert made.keys() == found.keys() == {s.name for s in mine} - {"end/0008.jpg"}
    for name, mask in masks.items():
        np.testing.assert_array_equal(found[name], mask)
        np.testing.assert_array_equal(made[name], mask)
    assert len(set(mask_names(mine).values())) == len(mine)


def test_masks_are_made_once_and_edited_ones_are_not_lost(tmp_path):
    mine, cache, folder, calls = shots(*NUMBERED), Cache(tmp_path / ".capture"), tmp_path / "masks", []

    def masks(depends):
        check_unedited(cache, folder)
        return kept_masks(cache, folder, mine, depends, lambda: calls.append(depends) or drawn(mine), lambda text: None)

    masks(1), masks(1)
    assert calls == [1]
    (folder / "start/0003.png").unlink()
    masks(1)
    assert calls == [1, 1]
    cv2.imwrite(str(folder / "end/0002.png"), np.full(SIZE[::-1], 255, np.uint8))
    for depends in (1, 2):
        with pytest.raises(UserError, match=r"end/0002\.png: was edited; give --masks"):
            masks(depends)
    assert cv2.imread(str(folder / "end/0002.png")).min() == 255
    (folder / "end/0002.png").unlink()
    masks(2)
    assert calls == [1, 1, 2]


def test_a_stage_cut_off_is_made_again(tmp_path):
    cache, made = Cache(tmp_path), []

    def get(depends, whole=lambda result: True):
        return cache.get("stage", depends, lambda: made.append(depends) or {"n": len(made)}, lambda text: None, whole)

    assert get(1) == get(1) == {"n": 1}
    (tmp_path / "stage.json").write_text('{"key": "abc", "res')
    assert get(1) == {"n": 2}
    (tmp_path / "stage.json").write_text("[]")
    assert get(1) == {"n": 3}
    assert get(1, lambda result: False) == {"n": 4}
    with pytest.raises(ZeroDivisionError):
        cache.get("stage", 1, lambda: {"n": 1 / 0}, lambda text: None, lambda result: False)
    assert cache.kept("stage") is None  # what it made before may be half overwritten


@pytest.fixture
def model():
    """Three photographs; point 0 in all, point 1 in two, point 2 in one of them."""
    lens = Lens("PINHOLE", 40, 30, np.array([40.0, 40, 20, 15]))
    xyz, photos = np.array([[0, 0, 0.0], [0.2, 0, 0], [0, 0.2, 0]]), {}
    for key, seen in ((1, [0, 1, 2]), (2, [0, 1]), (3, [0])):
        photo = photos[key] = Photo(f"start/{key}.jpg", 1, look_at(np.array([2.0, key - 2, 1]), (0, 0, 0)))
        local = xyz[seen] @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3]
        photo.xy, photo.point = lens.project(local), np.array(seen) + 1
    return Model({1: lens}, photos, np.arange(1, 4), xyz, np.zeros((3, 3), np.uint8))


def test_points_on_the_object_are_those_most_photographs_have_in_the_mask(model):
    white, black = np.full((30, 40), 255, np.uint8), np.zeros((30, 40), np.uint8)
    names = [p.name for p in model.photos.values()]
    assert on_object(model, dict(zip(names, (white, white, black), strict=True))).tolist() == [True, True, True]
    assert on_object(model, dict(zip(names, (white, black, black), strict=True))).tolist() == [False, False, True]
    assert on_object(model, {names[0]: white}).tolist() == [False, False, True]  # no mask: it does not show the object


def test_hypotheses_are_drawn_where_none_can_be_chosen(model, tmp_path):
    write_hypotheses(tmp_path, model, [Hypothesis(np.eye(4), np.array([[1, 0]]), 0.1, 0.0)])
    page = (tmp_path / "hypotheses.html").read_text()
    assert "--static 0" in page and page.count(f'fill="{FOR}"') == 2 and page.count(f'fill="{AGAINST}"') == 4
    write_hypotheses(tmp_path, model, [])
    assert "There is none" in (tmp_path / "hypotheses.html").read_text()


def test_what_was_copied_and_is_gone_is_copied_again(tmp_path, capsys):
    from p2gs.app import run

    for state in ("a", "b"):
        (tmp_path / state).mkdir()
        for i in range(9):
            image = np.random.default_rng(i).integers(0, 255, (240, 320, 3), np.uint8)
            cv2.imwrite(str(tmp_path / state / f"{i}.jpg"), image)
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": []}))
    out = tmp_path / "scene"
    words = ["data", "capture", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(out)]
    words += ["--poses", str(tmp_path / "transforms.json")]
    told = []
    for _ in range(3):
        assert run(words) == 2
        told.append(capsys.readouterr().out)
        shutil.rmtree(out / ".capture/photos/end") if len(told) == 2 else None
    assert ["photos_end: unchanged" in t for t in told] == [False, True, False]
    assert len(list((out / ".capture/photos/end").glob("*.jpg"))) == 9


def test_photographs_that_cannot_be_placed_are_named(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    from p2gs.app import run

    for state in ("a", "b"):
        (tmp_path / state).mkdir()
        for i in range(9):
            image = np.random.default_rng(i).integers(0, 255, (60, 80, 3), np.uint8)
            cv2.imwrite(
                str(tmp_path / state / f"{i}.png"), cv2.resize(image, (320, 240), interpolation=cv2.INTER_NEAREST)
            )
    words = ["data", "capture", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "scene")]
    assert run([*words, "--careful"]) == 2
    assert "only 0 of 9 photographs could be placed, not 0.png, 1.png, 2.png and others" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--height", "inf"], "expected metres above 0"),
        (["--poses", "x", "--static", "0"], "which --poses says already"),
    ],
)
def test_options_that_make_no_sense_are_refused(more, sentence, tmp_path, capsys):
    from p2gs.app import run

    assert run(["data", "capture", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "s"), *more]) == 2
    assert sentence in capsys.readouterr().err


def test_one_folder_for_both_states_is_refused(tmp_path, capsys):
    from p2gs.app import run

    assert run(["data", "capture", str(tmp_path), f"{tmp_path}/.", "--out", str(tmp_path / "s")]) == 2
    assert "is given for both states" in capsys.readouterr().err
