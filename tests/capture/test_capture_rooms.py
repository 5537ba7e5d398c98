"""Rooms with known cameras (bench/capture_room.py): are they what they say, and what does a capture make of them?"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))
import capture_room
import rooms

from p2gs.data.capture.board import COLUMNS, GAP, MARKER, ROWS, find_markers, template
from p2gs.data.capture.child import run_job
from p2gs.data.capture.sfm import default_effort


def corners_on_the_floor(room):
    """Marker -> [4, 3] corners of the printed sheet in the room, by the layout of the page."""
    sheet = room.still[-1]
    middle = sheet.pose[:3, 3] + [0, 0, sheet.size[2]]
    wide, high = COLUMNS * (MARKER + GAP) - GAP, ROWS * (MARKER + GAP) - GAP
    left, top = (0.297 - wide) / 2, (0.210 - high) / 2 - 0.010
    corner = middle + [-0.297 / 2 + left, 0.210 / 2 - top, 0]
    return {m: c + corner for m, c in template().items()}


def test_markers_lie_where_the_true_cameras_say(tmp_path):
    capture_room.write_room(tmp_path, "board", seed=0, photos=6)
    room, truth = capture_room.make_room("board", 0), json.loads((tmp_path / "gt" / "cameras.json").read_text())
    lens, known, off = np.array([truth["k1"], truth["k2"], 0, 0]), corners_on_the_floor(room), []
    for name, pose in truth["c2w"].items():
        view = np.linalg.inv(np.array(pose) @ np.diag([1.0, -1, -1, 1]))
        for marker, corners in find_markers(tmp_path / f"{name}.jpg").items():
            local = known[marker] @ view[:3, :3].T + view[:3, 3]
            pixels = cv2.projectPoints(local, np.zeros(3), np.zeros(3), np.array(truth["K"]), lens)[0][:, 0]
            off.append(np.linalg.norm(corners - pixels, axis=1))
    assert len(off) >= 6 and np.median(off) < 0.2, off


def test_the_truth_is_a_joint_that_takes_the_front_from_start_to_end():
    for seed in range(6):
        room = capture_room.make_room("plain", seed)
        shut, opened = (room.posed(end)[0][1].corners for end in (False, True))
        axis, o = np.array(room.joint["axis"]["d"]), np.array(room.joint["axis"]["o"])
        if room.joint["type"] == "translate":
            expected = shut + axis * room.joint["translate"]["r"]
        else:
            turn = cv2.Rodrigues(axis * np.radians(room.joint["rotate"]["r"]))[0]
            expected = (shut - o) @ turn.T + o
        assert np.abs(opened - expected).max() < 1e-9
        assert opened[:, 0].max() > shut[:, 0].max() + 0.1  # it opens towards the cameras


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("kind", "apart"), [("textured", 1.0), ("plain", 3.0), ("board", 3.0)])
def test_what_is_accepted_is_right(tmp_path, kind, apart):
    """A plain room is refused or right; the board alone links two states to a millimetre or two (docs/data.md)."""
    pytest.importorskip("pycolmap")
    row = rooms.run(tmp_path, kind, 1, 24)
    assert kind != "textured" or "refused" not in row
    assert "refused" in row or row["apart_mm"] < apart


@pytest.mark.slow
def test_the_same_photographs_give_the_same_model(tmp_path):
    """Twice the same to the last bit, on two threads."""
    pytest.importorskip("pycolmap")
    capture_room.write_room(tmp_path, "textured", seed=0, photos=8)
    names = sorted(p.name for p in (tmp_path / "start").iterdir())
    group = {"names": names, "model": "RADIAL", "params": None, "known_focal": False}
    job = {"images": str(tmp_path / "start"), "groups": [group], "effort": default_effort(False), "threads": 2}
    written = []
    for k in ("a", "b"):
        found = run_job("reconstruct", {**job, "out": str(tmp_path / k)}, tmp_path / f"{k}_job")
        assert found["registered"] >= 6
        written.append({p.name: p.read_bytes() for p in sorted((tmp_path / k / "model").iterdir())})
    assert written[0] == written[1]
