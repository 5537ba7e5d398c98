"""The object's box by hand: clicked in the page, and what comes of it."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from p2gs.data.capture.coarse import Region, _cloud, object_rows
from p2gs.data.capture.hull import hull_of
from p2gs.data.capture.model import Lens, Model, Photo
from p2gs.data.capture.page import CLICKS, _plan, write_page
from p2gs.data.capture.world import given_box, given_length
from p2gs.data.generated.synthetic import look_at
from p2gs.types import Camera, UserError

BOX = np.array([[-0.2, -0.3, 0.0], [0.3, 0.4, 0.9]])


def model():
    views = [look_at(np.array([2 * np.cos(a), 2 * np.sin(a), 1.0]), (0, 0, 0.4)) for a in (-0.5, 0.0, 0.5)]
    photos = {i: Photo(f"start/{i}.png", 0, v) for i, v in enumerate(views)}
    lens = Lens("RADIAL", 640, 480, np.array([600.0, 320, 240, 0, 0]))
    return Model({0: lens}, photos, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not there")
def test_two_clicks_in_each_plan_are_the_option(tmp_path):
    """Clicks where the plan draws the box's corners give the box back, whichever corners are clicked."""
    plans = [_plan(model(), np.zeros(0, object), axes, "", BOX) for axes in ((0, 1), (0, 2))]
    clicks = []
    for plan in plans:
        size, axes = re.search(r'data-size="([^"]+)" data-axes="([^"]+)"', plan).groups()
        x, y, w, h = map(
            float, re.search(r'<rect x="([^"]+)" y="([^"]+)" width="([^"]+)" height="([^"]+)"', plan).groups()
        )
        clicks.append({"size": size, "axes": axes, "corners": [[x + w, y], [x, y + h]]})
    script = f"""
const start = {{dataset: {{box: '[[9,9,9],[9,9,9]]'}}}};
const document = {{getElementById: () => start, querySelectorAll: () => []}};
{CLICKS}
for (const c of {json.dumps(clicks)}) {{
  const plan = {{dataset: {{size: c.size, axes: c.axes}}}};
  const done = c.corners.map(([x, y]) => clicked(plan, x, y));
  if (done[0] || !done[1]) throw Error('two clicks make a box');
}}
console.log(option());
console.log(length());
"""
    out = subprocess.run(["node", "-e", script], capture_output=True, text=True, timeout=60, check=True).stdout
    out, ends = out.splitlines()
    assert ends.startswith("--length M ")  # the corners as they were clicked: high first
    assert np.abs(np.array(ends.split()[2:], float).reshape(2, 3) - BOX[::-1]).max() < 0.002
    assert out.startswith("--box ")
    assert np.abs(np.array(out.split()[1:], float).reshape(2, 3) - BOX).max() < 0.002  # a tenth of a pixel of the plan


def test_the_page_says_the_box_that_was_found(tmp_path, monkeypatch):
    monkeypatch.setattr("p2gs.data.capture.page.contact_sheet", lambda *a, **k: None)
    write_page(tmp_path, model(), {}, BOX, {"images": [], "gains": {}})
    assert "--box -0.2000 -0.3000 0.0000 0.3000 0.4000 0.9000" in (tmp_path / "capture.html").read_text()


def test_the_box_is_in_units_of_the_page(tmp_path):
    numbers = tuple(BOX.ravel())
    board, object_ = {"scale": {"source": "board"}}, {"scale": {"source": "object diagonal"}}
    assert given_box(None, object_, tmp_path) is None
    assert np.allclose(given_box(numbers, board, tmp_path), BOX)
    with pytest.raises(UserError, match="run without --box first"):
        given_box(numbers, object_, tmp_path)
    (tmp_path / "capture.json").write_text(json.dumps({"scale": {"factor": 2.0}}))
    assert np.allclose(given_box(numbers, object_, tmp_path), BOX / 2)
    assert given_length((3.0, 0, 0, 0, 0, 0, 4), object_, tmp_path) == pytest.approx(1.5)  # two units of the model
    (tmp_path / "capture.json").write_text(json.dumps({"scale": {"factor": 5.0}}))  # of the scene with that box
    assert np.allclose(given_box(numbers, object_, tmp_path), BOX / 2)  # the same command again
    assert given_length((3.0, 0, 0, 0, 0, 0, 4), object_, tmp_path) == pytest.approx(1.5)
    assert np.allclose(given_box(tuple(2 * BOX.ravel()), object_, tmp_path), 2 * BOX / 5)  # read off the new page
    assert given_length((3.0, 0, 0, 0, 0, 0, 4), board, tmp_path) == pytest.approx(0.75)
    with pytest.raises(UserError, match="each first below its second"):
        given_box(numbers[::-1], board, tmp_path)


def test_what_lies_outside_the_box_is_not_the_object():
    region = Region(np.array([0.05, 0.05, 0.45]), 2.0, np.array([[0.0, 0, 1, 0]]), BOX)
    cloud = _cloud(region, torch.Generator().manual_seed(0))
    assert len(cloud) > 5000 and (cloud > BOX[0]).all() and (cloud < BOX[1]).all() and cloud[:, 2].min() > 0.02
    everywhere = np.ones((96, 128), bool)
    views = [Camera(torch.tensor(p.viewmat).float(), torch.tensor([[120.0, 0, 64], [0, 120, 48], [0, 0, 1]]), 128, 96)
             for p in model().photos.values()]  # fmt: skip
    hull = hull_of(region, [(v, everywhere) for v in views])
    assert len(hull.points) > 1000 and (hull.points >= BOX[0]).all() and (hull.points <= BOX[1]).all()

    class Placed:
        params = {"means": torch.tensor([[0.0, 0, 0.5], [0.0, 0, 1.2], [0.0, 0.0, 0.001]])}
        cloud = 3

    assert object_rows(Placed(), region).tolist() == [True, False, False]
