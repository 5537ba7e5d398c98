"""Generated things other than furniture: laptops, scissors, valves, windows, lids, cutters."""

from __future__ import annotations

import numpy as np

from p2gs.data.generated.articulated import SyntheticObject, SyntheticPart, prismatic, revolute
from p2gs.data.generated.furniture import KINDS, Cell, Palette, assemble, door, part_open, tray
from p2gs.data.generated.shapes import box, cylinder, ring


@KINDS.register("laptop")
def laptop(rng: np.random.Generator) -> SyntheticObject:
    """A screen on a keyboard half, hinged at the back edge, from a small angle to a wide one."""
    palette = Palette(rng)
    depth, width, thick = rng.uniform(0.6, 0.8), rng.uniform(0.9, 1.1), rng.uniform(0.04, 0.06)
    body = [box((-depth / 2, -width / 2, 0), (depth / 2, width / 2, thick), palette.texture())]
    keys = palette.texture("checks", period=0.12)
    body.append(box((-0.35 * depth, -0.42 * width, thick), (0.1 * depth, 0.42 * width, thick + 0.008), keys))
    body.append(
        box((0.2 * depth, -0.15 * width, thick), (0.42 * depth, 0.15 * width, thick + 0.004), palette.texture())
    )
    z = thick + 0.014
    lid = [box((-depth / 2, -width / 2, z), (depth / 2, width / 2, z + 0.7 * thick), palette.texture())]
    lid.append(
        box(
            (-0.42 * depth, -0.44 * width, z - 0.004),
            (0.42 * depth, 0.44 * width, z),
            palette.texture("noise", bright=0.5),
        )
    )
    joint = revolute((0, -1, 0), (-depth / 2, 0, z - 0.007), rng.uniform(10, 45), rng.uniform(80, 125))
    return assemble("laptop", body, [SyntheticPart("lid", tuple(lid), joint)])


@KINDS.register("scissors")
def scissors(rng: np.random.Generator) -> SyntheticObject:
    """Two blades with rings that cross at a pin, one above the other."""
    palette = Palette(rng)
    thick, offset = 0.035, rng.uniform(0.16, 0.22)

    def half(side: float, z: float):
        blade, grip = palette.metal(), palette.texture()
        y = side * offset
        pieces = [box((-0.08, -0.045, z), (0.85, 0.045, z + thick), blade)]
        direction = np.array([-0.45, y])
        tilt = np.arctan2(direction[1], direction[0])
        arm = box(
            (-0.5 * np.linalg.norm(direction), -0.035, z), (0.5 * np.linalg.norm(direction), 0.035, z + thick), blade
        )
        pose = np.eye(4)
        c, s = np.cos(tilt), np.sin(tilt)
        pose[:2, :2], pose[:2, 3] = [[c, -s], [s, c]], direction / 2 - [0.05, 0]
        pieces.append(arm.moved(pose))
        centre = np.array([direction[0] - 0.05, y, z + thick / 2]) + np.array([-0.15, 0.03 * side, 0])
        return pieces + ring(centre, (0, 0, 1), 0.15, 0.024, grip)

    lower, upper = half(1.0, 0.0), half(-1.0, thick + 0.004)
    pin = [cylinder((0, 0, -0.02), (0, 0, -0.001), 0.05, palette.metal())]
    start, end = part_open(rng, 30, 70, chance=0.6)
    return assemble(
        "scissors",
        lower + pin,
        [SyntheticPart("blade", tuple(upper), revolute((0, 0, 1), (0, 0, 0), start + 4, end + 4))],
    )


@KINDS.register("valve")
def valve(rng: np.random.Generator) -> SyntheticObject:
    """A spoked hand wheel on a pipe; one spoke carries a grip, so that its turn can be seen."""
    palette = Palette(rng)
    pipe = palette.texture()
    radius, spokes, height = rng.uniform(0.38, 0.5), int(rng.integers(3, 6)), rng.uniform(0.45, 0.6)
    base = [
        cylinder((0, -0.7, 0), (0, 0.7, 0), 0.17, pipe),
        cylinder((0, 0, 0.15), (0, 0, height - 0.06), 0.09, palette.texture()),
    ]
    base += [cylinder((0, y - 0.03, 0), (0, y + 0.03, 0), 0.26, palette.metal()) for y in (-0.66, 0.66)]
    wheel = ring((0, 0, height), (0, 0, 1), radius, 0.04, palette.texture(), 24)
    wheel.append(cylinder((0, 0, height - 0.05), (0, 0, height + 0.06), 0.085, palette.metal()))
    for a in 2 * np.pi * np.arange(spokes) / spokes:
        tip = np.array([np.cos(a), np.sin(a), 0])
        wheel.append(cylinder(0.08 * tip + [0, 0, height], radius * tip + [0, 0, height], 0.024, palette.texture()))
    wheel.append(cylinder((radius, 0, height + 0.03), (radius, 0, height + 0.2), 0.035, palette.texture()))
    start, end = part_open(rng, 35, 100)
    sign = 1 if rng.random() < 0.5 else -1
    return assemble(
        "valve", base, [SyntheticPart("wheel", tuple(wheel), revolute((0, 0, 1), (0, 0, 0), sign * start, sign * end))]
    )


def _window_frame(palette: Palette, width: float, height: float, depth: float, bar: float):
    frame = palette.texture("wood")
    return [
        box((-depth / 2, -width / 2, 0), (depth / 2, width / 2, bar), frame),
        box((-depth / 2, -width / 2, height - bar), (depth / 2, width / 2, height), frame),
        box((-depth / 2, -width / 2, bar), (depth / 2, -width / 2 + bar, height - bar), frame),
        box((-depth / 2, width / 2 - bar, bar), (depth / 2, width / 2, height - bar), frame),
    ]


def _sash(palette: Palette, x: float, thick: float, y0: float, y1: float, z0: float, z1: float, bar: float):
    """A frame with an opaque pane."""
    wood = palette.texture()
    return [
        box((x, y0, z0), (x + thick, y1, z0 + bar), wood),
        box((x, y0, z1 - bar), (x + thick, y1, z1), wood),
        box((x, y0, z0 + bar), (x + thick, y0 + bar, z1 - bar), wood),
        box((x, y1 - bar, z0 + bar), (x + thick, y1, z1 - bar), wood),
        box(
            (x + 0.3 * thick, y0 + bar, z0 + bar),
            (x + 0.7 * thick, y1 - bar, z1 - bar),
            palette.texture("noise", bright=0.9),
        ),
    ]


@KINDS.register("sliding_window")
def sliding_window(rng: np.random.Generator) -> SyntheticObject:
    """Two sashes in a frame; one slides in front of the other, sideways or up."""
    palette = Palette(rng)
    upright = rng.random() < 0.4
    width, height = (
        (rng.uniform(0.8, 1.0), rng.uniform(1.2, 1.4)) if upright else (rng.uniform(1.2, 1.5), rng.uniform(0.8, 1.0))
    )
    bar, sash, t = 0.07, 0.055, 0.05
    frame = _window_frame(palette, width, height, 0.2, bar)
    y0, y1, z0, z1 = -width / 2 + bar + 0.006, width / 2 - bar - 0.006, bar + 0.006, height - bar - 0.006
    middle_y, middle_z = (y0 + y1) / 2, (z0 + z1) / 2
    if upright:
        fixed = _sash(palette, -0.07, t, y0, y1, middle_z - sash / 2, z1, sash)
        moving = _sash(palette, 0.01, t, y0, y1, z0, middle_z + sash / 2, sash)
        room, axis, origin = z1 - middle_z - sash / 2, (0, 0, 1), (0, 0, z0)
    else:
        fixed = _sash(palette, -0.07, t, middle_y - sash / 2, y1, z0, z1, sash)
        moving = _sash(palette, 0.01, t, y0, middle_y + sash / 2, z0, z1, sash)
        room, axis, origin = y1 - middle_y - sash / 2, (0, 1, 0), (0, y0, middle_z)
    start, end = part_open(rng, 0.45, 0.95)
    joint = prismatic(axis, origin, start * room, end * room)
    return assemble("sliding_window", frame + fixed, [SyntheticPart("sash", tuple(moving), joint)])


@KINDS.register("casement_window")
def casement_window(rng: np.random.Generator) -> SyntheticObject:
    """One or two wings that open outwards."""
    palette = Palette(rng)
    wings = int(rng.integers(1, 3))
    width, height = rng.uniform(0.6, 0.75) * (1 + 0.6 * (wings - 1)), rng.uniform(0.9, 1.2)
    frame = _window_frame(palette, width, height, 0.14, 0.08)
    frame.append(
        box(
            (-0.02, -width / 2 + 0.08, height / 2 - 0.02),
            (0.02, width / 2 - 0.08, height / 2 + 0.02),
            palette.texture(),
        )
    )
    edges = np.linspace(-width / 2 + 0.02, width / 2 - 0.02, wings + 1)
    outer = [("left", "right")] if wings == 1 else [("left",), ("right",)]
    cells = [Cell(0.07, edges[i], edges[i + 1], 0.02, height - 0.02, 0.1, outer[i]) for i in range(wings)]
    return assemble("casement_window", frame, [door(rng, palette, c, str(rng.choice(c.outer))) for c in cells])


@KINDS.register("lid_box")
def lid_box(rng: np.random.Generator) -> SyntheticObject:
    """A chest with a lid hinged at the back, at times with something inside."""
    palette = Palette(rng)
    depth, width, height, wall = rng.uniform(0.6, 0.8), rng.uniform(0.8, 1.2), rng.uniform(0.4, 0.6), 0.05
    shell = palette.texture()
    body = tray(rng, (-depth / 2, -width / 2, 0), (depth / 2 - wall, width / 2, height), shell, wall)
    body.append(box((depth / 2 - wall, -width / 2, 0), (depth / 2, width / 2, height), shell))
    if rng.random() < 0.6:
        body.append(cylinder((0, -0.1, wall), (0, -0.1, 0.7 * height), 0.12, palette.texture()))
    z = height + 0.006
    lid = [box((-depth / 2, -width / 2 - 0.02, z), (depth / 2 + 0.03, width / 2 + 0.02, z + 0.06), palette.texture())]
    x, metal = 0.3 * depth, palette.metal()
    lid.append(cylinder((x, -0.12, z + 0.09), (x, 0.12, z + 0.09), 0.02, metal))
    lid += [box((x - 0.015, y - 0.015, z + 0.06), (x + 0.015, y + 0.015, z + 0.085), metal) for y in (-0.1, 0.1)]
    start, end = part_open(rng, 40, 105)
    return assemble(
        "lid_box", body, [SyntheticPart("lid", tuple(lid), revolute((0, -1, 0), (-depth / 2, 0, z), start, end))]
    )


@KINDS.register("cutter")
def cutter(rng: np.random.Generator) -> SyntheticObject:
    """A knife whose blade slides out of a hollow grip; the slider on top moves with it."""
    palette = Palette(rng)
    length, wide, shell = 1.1, 0.22, palette.texture("stripes")
    body = [
        box((-length / 2, -wide / 2, 0), (length / 2, wide / 2, 0.03), shell),
        box((-length / 2, -wide / 2, 0.03), (length / 2, -wide / 2 + 0.03, 0.10), shell),
        box((-length / 2, wide / 2 - 0.03, 0.03), (length / 2, wide / 2, 0.10), shell),
        box((-length / 2, -wide / 2, 0.10), (length / 2, -0.035, 0.13), shell),
        box((-length / 2, 0.035, 0.10), (length / 2, wide / 2, 0.13), shell),
    ]
    x0, x1, y = -0.4 * length, length / 2 + 0.02, wide / 2 - 0.036
    blade = [
        box((x0, -y, 0.05), (x1, y, 0.075), palette.texture("speckle", bright=0.85)),
        box((-0.25, -0.028, 0.075), (-0.12, 0.028, 0.17), palette.texture()),
    ]
    start, end = part_open(rng, 0.25, 0.5)
    joint = prismatic((1, 0, 0), (0, 0, 0.06), start * length, end * length)
    return assemble("cutter", body, [SyntheticPart("blade", tuple(blade), joint)])
