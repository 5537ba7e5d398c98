"""Collision pieces keep out of each other's way over the whole range, and give way no more than they must."""

import numpy as np
import pytest
import trimesh
from solids import intersect

from p2gs.export.links import Hinge, Link, joint_motion
from p2gs.export.physics.clearance import GAP, clear_links, without
from p2gs.export.physics.convex import Piece, cut, hull, separation
from p2gs.export.physics.inertia import Inertia
from p2gs.ops.mesh import Mesh


def block(lo, hi) -> Piece:
    lo, hi = np.array(lo, float), np.array(hi, float)
    return hull(np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])]), 1e-6)


def link(name, pieces, hinge=None) -> Link:
    """Pieces in world axes at the start."""
    at = np.zeros(3) if hinge is None else hinge.origin
    pieces = [Piece(p.vertices - at, p.faces) for p in pieces]
    return Link(
        name,
        int(name[-1]) if hinge else 0,
        Mesh.empty(),
        pieces,
        Inertia(1.0, np.zeros(3), np.eye(3)),
        hinge,
        (0.5, 0.5, 0.5),
    )


def slide(axis, reach) -> Hinge:
    return Hinge("prismatic", np.array(axis, float), np.zeros(3), min(0.0, reach), max(0.0, reach), reach, 1.0)


def turn(axis, at, angle) -> Hinge:
    return Hinge("revolute", np.array(axis, float), np.array(at, float), min(0.0, angle), max(0.0, angle), angle, 1.0)


def posed(part: Link, value: float) -> list[Piece]:
    T = np.eye(4) if part.joint is None else joint_motion(part.joint, value)
    return [Piece((p.vertices + part.origin) @ T[:3, :3].T + T[:3, 3], p.faces) for p in part.collision]


def touching(a: Link, x: float, b: Link, y: float) -> bool:
    return any(intersect(p, q) for p in posed(a, x) for q in posed(b, y))


def cabinet():
    """Walls, a drawer that overlaps the floor and a wall by 2 mm, and a door in a frame that it overlaps."""
    walls = [block((-0.5, -0.4, -0.5), (-0.45, 0.4, 0.5)), block((0.45, -0.4, -0.5), (0.5, 0.4, 0.5))]
    floor, middle = block((-0.5, -0.4, -0.5), (0.5, 0.4, -0.45)), block((-0.025, -0.4, -0.5), (0.025, 0.4, 0.5))
    drawer = [block((0.023, -0.38, -0.452), (0.447, 0.35, -0.42)), block((0.023, -0.42, -0.452), (0.447, -0.38, 0.2))]
    door = [block((-0.49, -0.44, -0.49), (-0.01, -0.398, 0.49))]
    return [
        link("base", [*walls, floor, middle]),
        link("part_1", door, turn((0, 0, 1), (-0.47, -0.42, 0), -1.2)),
        link("part_2", drawer, slide((0, -1, 0), 0.4)),
    ]


def test_every_pair_is_free_over_the_whole_range():
    links = cabinet()
    assert touching(links[0], 0, links[1], 0) and touching(links[0], 0, links[2], 0)  # or there is nothing to clear
    cleared = clear_links(links)
    base, door, drawer = cleared.links
    for share in np.linspace(0, 1, 18):
        for part in (door, drawer):
            assert not touching(base, 0, part, share * part.joint.motion)
        assert not touching(door, share * door.joint.motion, drawer, share * drawer.joint.motion)
    assert not cleared.blocking and all(lost < 0.1 for lost in cleared.lost.values())
    assert all(len(new.collision) == len(old.collision) for new, old in zip(cleared.links, links, strict=True))


def test_parts_that_touch_nothing_stay_as_they_are():
    links = [
        link("base", [block((0, 0, 0), (1, 1, 0.1))]),
        link("part_1", [block((0, 0, 0.2), (1, 1, 0.3))], slide((0, 0, 1), 0.5)),
    ]
    cleared = clear_links(links)
    assert all(
        np.array_equal(a.collision[0].vertices, b.collision[0].vertices)
        for a, b in zip(links, cleared.links, strict=True)
    )
    assert set(cleared.lost.values()) == {0.0}


def test_a_false_surface_in_the_way_loses_only_what_the_part_passes_through():
    """A drawer slides through a sheet that closes the front: the sheet keeps a hole, the drawer its shape."""
    sheet, drawer = block((-0.5, -0.42, -0.5), (0.5, -0.4, 0.5)), block((-0.2, -0.3, -0.1), (0.2, 0.3, 0.1))
    cleared = clear_links([link("base", [sheet]), link("part_1", [drawer], slide((0, -1, 0), 0.5))])
    base, part = cleared.links
    assert len(base.collision) == 4 and part.collision[0].volume == pytest.approx(drawer.volume, rel=0.05)
    assert cleared.lost["base"] == pytest.approx(0.4 * 0.2, abs=0.02)
    assert not any(touching(base, 0, part, v) for v in np.linspace(0, 0.5, 18))


def test_a_door_before_a_drawer_is_reported_and_not_cut():
    door = link("part_1", [block((-0.5, -0.45, -0.5), (0.5, -0.41, 0.5))], turn((0, 0, 1), (-0.5, -0.43, 0), -1.57))
    drawer = link("part_2", [block((-0.3, -0.35, -0.1), (0.4, 0.3, 0.1))], slide((0, -1, 0), 0.3))
    base = link("base", [block((-0.5, -0.4, -0.6), (0.5, 0.4, -0.55))])
    cleared = clear_links([base, door, drawer])
    assert ("part_2", "part_1") in cleared.blocking
    assert cleared.lost["part_1"] < 0.02 and cleared.lost["part_2"] < 0.02
    _, a, b = cleared.links
    assert not any(touching(a, -1.57, b, v) for v in np.linspace(0, 0.3, 18))  # with the door open it has room


def test_the_gap_is_as_wide_as_said():
    base, part = clear_links(
        [
            link("base", [block((0, 0, 0), (1, 1, 0.1))]),
            link("part_1", [block((0, 0, 0.098), (1, 1, 0.2))], slide((1, 0, 0), 0.5)),
        ]
    ).links
    depth = separation(base.collision[0], part.collision[0])[0]
    assert depth == pytest.approx(-GAP * np.linalg.norm([1, 1, 0.2]), rel=1e-6)


def test_cut_and_separation_agree_with_manifold():
    rng = np.random.default_rng(0)
    pytest.importorskip("manifold3d", reason="manifold3d is not installed")
    for _ in range(10):
        a, b = (hull(rng.normal(size=(12, 3)) + shift, 1e-6) for shift in (0.0, rng.normal(size=3) * 2))
        n = rng.normal(size=3)
        n, d = n / np.linalg.norm(n), float(rng.normal() * 0.3)
        solid = trimesh.Trimesh(a.vertices, a.faces)
        part = cut(a, n, d)
        want = (
            solid.slice_plane(n * d, -n, cap=True, engine="manifold").volume if (a.vertices @ n > d).any() else a.volume
        )
        assert (0.0 if part is None else part.volume) == pytest.approx(want, abs=1e-6)
        both = trimesh.boolean.intersection([solid, trimesh.Trimesh(b.vertices, b.faces)], engine="manifold")
        assert (separation(a, b)[0] > 0) == (both.volume > 1e-9)


def test_what_is_left_beside_a_sweep_and_the_sweep_make_up_the_piece():
    piece, sweep = block((0, 0, 0), (1, 1, 1)), block((0.4, -1, 0.4), (0.6, 2, 0.6))
    left = without(piece, sweep, 1e-6)
    assert len(left) == 4 and sum(p.volume for p in left) == pytest.approx(1 - 0.04, abs=1e-4)
