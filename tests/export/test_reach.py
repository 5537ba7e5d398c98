"""Joints go on until their pieces touch: distances and angles by hand."""

import numpy as np
import pytest
from test_clearance import block, link, slide, turn

from p2gs.export.physics.clearance import GAP
from p2gs.export.physics.reach import FULL_TURN, HELD, extend_links


def margin(links):
    points = np.concatenate([p.vertices + x.origin for x in links for p in x.collision])
    return 0.5 * GAP * np.linalg.norm(np.ptp(points, axis=0))


def test_a_slide_stops_in_front_of_a_wall_on_either_side():
    walls = [block((-0.5, -1.0, -0.5), (0.5, -0.9, 0.5)), block((-0.5, 0.6, -0.5), (0.5, 0.7, 0.5))]
    links = [link("base", walls), link("part_1", [block((-0.2, -0.4, -0.2), (0.2, 0.4, 0.2))], slide((0, -1, 0), 0.1))]
    base, box = extend_links(links)
    assert base.joint is None
    m = margin(links)
    assert box.joint.upper == pytest.approx(0.5 - m, abs=2e-3) and box.joint.lower == pytest.approx(
        -(0.2 - m), abs=2e-3
    )
    assert box.joint.upper <= 0.5 - m and box.joint.motion == 0.1  # never into the wall; what was observed is kept


def test_a_drawer_stays_in_its_runners():
    cheeks = [block((x, -0.4, -0.5), (x + 0.05, 0.4, 0.5)) for x in (-0.5, 0.45)]
    links = [link("base", cheeks), link("part_1", [block((-0.4, -0.4, -0.2), (0.4, 0.4, 0.2))], slide((0, -1, 0), 0.3))]
    drawer = extend_links(links)[1].joint
    assert drawer.upper == pytest.approx(0.8 * (1 - HELD)) and drawer.lower == pytest.approx(-0.8 * (1 - HELD))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_door_stops_at_the_frame_and_at_a_post(sign):
    """Shut it lies against a frame; open, a post stands at 135 degrees."""
    frame = block((0.0, 0.02, -0.5), (1.0, 0.05, 0.5))
    at = np.deg2rad(-135)
    post = block(
        (0.7 * np.cos(at) - 0.02, 0.7 * np.sin(at) - 0.02, -0.5),
        (0.7 * np.cos(at) + 0.02, 0.7 * np.sin(at) + 0.02, 0.5),
    )
    door = block((0.01, -0.005, -0.4), (0.9, 0.005, 0.4))
    links = [link("base", [frame, post]), link("part_1", [door], turn((0, 0, sign), (0, 0, 0), -sign * np.deg2rad(60)))]
    joint = extend_links(links)[1].joint
    opened, shut = (-joint.lower, joint.upper) if sign > 0 else (joint.upper, -joint.lower)
    reach = np.arcsin((0.02 * np.sqrt(2) + 0.005) / 0.7)  # the post's near corner stands about so far from its middle
    assert np.deg2rad(135) - 1.2 * reach - 0.02 < opened < np.deg2rad(135) - 0.02 / 0.7
    assert 0 <= shut < 0.02


def test_what_meets_nothing_goes_half_round():
    links = [
        link("base", [block((-1, -1, -1), (1, 1, -0.9))]),
        link("part_1", [block((0, 0, 0), (0.5, 0.1, 0.1))], turn((0, 0, 1), (0, 0, 0), 1.0)),
    ]
    joint = extend_links(links)[1].joint
    assert joint.upper == pytest.approx(FULL_TURN) and joint.lower == pytest.approx(-FULL_TURN)


def test_each_end_is_followed_among_the_others_as_they_were_there():
    """Two drawers one over the other; the lower one's end is photographed with a bar of the upper in front of it."""
    sill = block((-0.5, -0.5, -1.0), (0.5, 3.0, -0.9))
    own = block((-0.2, 0.0, -0.3), (0.2, 0.5, 0.0))
    bar = block((-0.2, 1.0, 0.5), (0.2, 1.1, 0.9))
    links = [
        link("base", [sill]),
        link("part_1", [own], slide((0, 1, 0), 0.2)),
        link("part_2", [bar], slide((0, 0, -1), 0.7)),
    ]
    first = extend_links(links)[1].joint
    assert first.upper == pytest.approx(0.5 - margin(links), abs=5e-3)  # the bar has come down by then
    assert first.lower == pytest.approx(-0.5 - 0.5 * (1 - HELD) + 0.0, abs=1e-6)
