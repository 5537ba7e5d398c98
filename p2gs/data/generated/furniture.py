"""Generated furniture: hollow carcasses with doors, drawers and flaps. Front is +x, left and right are y, up is z."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Callable, Optional

import numpy as np

from p2gs.data.generated.articulated import SyntheticObject, SyntheticPart, prismatic, revolute
from p2gs.data.generated.shapes import Primitive, ball, box, cylinder
from p2gs.data.generated.textures import PATTERNS, Pattern, Texture
from p2gs.registry import Registry

KINDS: Registry[Callable[[np.random.Generator], SyntheticObject]] = Registry("kind of object")
GAP = 0.012  # between neighbouring fronts


class Palette:
    """Textures that go together: one ground hue, varied from piece to piece."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.hue, self.spread = rng.uniform(0, 1), rng.uniform(0.02, 0.35)

    def texture(self, pattern: Optional[Pattern] = None, bright: float = 0.75, period: float = 0.25) -> Texture:
        rng = self.rng
        pattern = pattern or PATTERNS[rng.integers(len(PATTERNS))]
        hue, sat = self.hue + rng.uniform(-self.spread, self.spread), rng.uniform(0.25, 0.7)
        value = np.clip(bright * rng.uniform(0.8, 1.25), 0.2, 1)
        first = colorsys.hsv_to_rgb(hue % 1, sat, value)
        second = colorsys.hsv_to_rgb(
            (hue + rng.uniform(-0.08, 0.08)) % 1, sat * rng.uniform(0.4, 1.2) % 1, value * rng.uniform(0.45, 0.75)
        )
        return Texture(pattern, first, second, period * rng.uniform(0.6, 1.6), int(rng.integers(2**31)))

    def metal(self) -> Texture:
        v = self.rng.uniform(0.15, 0.85)
        return Texture("noise", (v, v, 0.97 * v), (0.8 * v, 0.8 * v, 0.85 * v), 0.1, int(self.rng.integers(2**31)))


@dataclass(frozen=True)
class Cell:
    """An opening of a carcass: front plane at x, y0..y1, z0..z1, ``depth`` behind it. outer: edges on the carcass'
    outside."""

    x: float
    y0: float
    y1: float
    z0: float
    z1: float
    depth: float
    outer: tuple[str, ...] = ()


def part_open(rng: np.random.Generator, lo: float, hi: float, chance: float = 0.3) -> tuple[float, float]:
    """(start, end) joint values: shut or a little open, then open somewhere in lo..hi."""
    end = rng.uniform(lo, hi)
    return (rng.uniform(0.1, 0.2) * end if rng.random() < chance else 0.0), end


def carcass(
    rng: np.random.Generator,
    palette: Palette,
    depth: float,
    width: float,
    height: float,
    columns: list[int],
    wall: float = 0.04,
):
    """A shelf without fronts, boards meeting without overlap. columns: number of cells, one above the other, per
    column.

    Returns (primitives, cells); corner at x = -depth/2 .. depth/2, y = -width/2 .. width/2, z = 0 .. height.
    """
    shell, inner = palette.texture(), palette.texture(bright=0.85)
    x0, x1, y0, y1 = -depth / 2, depth / 2, -width / 2, width / 2
    boards = [
        box((x0, y0, 0), (x1, y1, wall), shell),
        box((x0, y0, height - wall), (x1, y1, height), shell),
        box((x0, y0, wall), (x1, y0 + wall, height - wall), shell),
        box((x0, y1 - wall, wall), (x1, y1, height - wall), shell),
        box((x0, y0 + wall, wall), (x0 + wall / 2, y1 - wall, height - wall), inner),
    ]
    weights = rng.uniform(0.8, 1.25, len(columns))
    edges = y0 + width * np.concatenate([[0], np.cumsum(weights) / weights.sum()])
    cells, back = [], x0 + wall / 2
    for c, rows in enumerate(columns):
        if c > 0:
            boards.append(box((back, edges[c] - wall / 2, wall), (x1, edges[c] + wall / 2, height - wall), inner))
        lo = y0 + wall if c == 0 else edges[c] + wall / 2
        hi = y1 - wall if c == len(columns) - 1 else edges[c + 1] - wall / 2
        share = rng.uniform(0.7, 1.4, rows)
        levels = height * np.concatenate([[0], np.cumsum(share) / share.sum()])
        outer = tuple(n for n, yes in (("left", c == 0), ("right", c == len(columns) - 1)) if yes)
        for r in range(rows):
            if r > 0:
                boards.append(box((back, lo, levels[r] - wall / 2), (x1, hi, levels[r] + wall / 2), inner))
            cells.append(Cell(x1, edges[c], edges[c + 1], levels[r], levels[r + 1], depth - wall / 2, outer))
    return boards, cells


def handle(
    rng: np.random.Generator, palette: Palette, x: float, y: float, z: float, upright: bool, size: float
) -> list[Primitive]:
    """A bar on two feet or a knob in front of the plane x."""
    metal = palette.metal()
    if rng.random() < 0.35:
        return [cylinder((x, y, z), (x + 0.03, y, z), 0.012, metal), ball((x + 0.042, y, z), 0.026, metal)]
    along = np.array([0, 0, 1.0]) if upright else np.array([0, 1.0, 0])
    centre, half = np.array([x + 0.045, y, z]), 0.5 * size
    bar = cylinder(centre - half * along, centre + half * along, 0.014, metal)
    feet = [
        cylinder(centre + s * 0.8 * half * along - [0.045, 0, 0], centre + s * 0.8 * half * along, 0.010, metal)
        for s in (-1, 1)
    ]
    return [bar, *feet]


def door(
    rng: np.random.Generator,
    palette: Palette,
    cell: Cell,
    side: str,
    angles=None,
    thick: float = 0.045,
    texture: Optional[Texture] = None,
) -> SyntheticPart:
    """A front hinged at its outer front edge. side: left (low y), right, bottom or top."""
    texture = texture or palette.texture()
    y0, y1, z0, z1 = cell.y0 + GAP / 2, cell.y1 - GAP / 2, cell.z0 + GAP / 2, cell.z1 - GAP / 2
    x0, x1 = cell.x + 0.004, cell.x + 0.004 + thick
    board = box((x0, y0, z0), (x1, y1, z1), texture)
    frame = []
    if rng.random() < 0.5:  # a raised panel
        m = 0.18 * min(y1 - y0, z1 - z0)
        frame = [box((x1, y0 + m, z0 + m), (x1 + 0.012, y1 - m, z1 - m), palette.texture())]
    x_front = x1 + (0.012 if frame else 0)
    inset = 0.12 * (y1 - y0) + 0.02
    if side in ("left", "right"):
        y_hinge, y_handle = (y0, y1 - inset) if side == "left" else (y1, y0 + inset)
        grip = handle(rng, palette, x_front, y_handle, (z0 + z1) / 2, True, 0.25 * (z1 - z0))
        # about +z a positive angle turns +y towards -x: a door hinged at low y opens with a negative one
        axis, origin = (0, 0, -1.0 if side == "left" else 1.0), (x1, y_hinge, (z0 + z1) / 2)
    else:
        z_hinge, z_handle = (z0, z1 - 0.15 * (z1 - z0)) if side == "bottom" else (z1, z0 + 0.15 * (z1 - z0))
        grip = handle(rng, palette, x_front, (y0 + y1) / 2, z_handle, False, 0.35 * (y1 - y0))
        axis, origin = (0, 1.0 if side == "bottom" else -1.0, 0), (x1, (y0 + y1) / 2, z_hinge)
    limit = 115 if side in (*cell.outer, "bottom", "top") else 80
    start, end = angles or part_open(rng, 40, limit)
    if rng.random() < 0.5:  # the sign of an axis is a convention, so both occur
        axis, start, end = tuple(-a for a in axis), -start, -end
    return SyntheticPart(f"door_{side}", (board, *frame, *grip), revolute(axis, origin, start, end))


def tray(rng: np.random.Generator, lo, hi, texture: Texture, wall: float = 0.022) -> list[Primitive]:
    """An open box between two corners, boards meeting without overlap; its front (+x) side is left to the caller."""
    (x0, y0, z0), (x1, y1, z1) = lo, hi
    return [
        box((x0, y0, z0), (x1, y1, z0 + wall), texture),
        box((x0, y0, z0 + wall), (x1, y0 + wall, z1), texture),
        box((x0, y1 - wall, z0 + wall), (x1, y1, z1), texture),
        box((x0, y0 + wall, z0 + wall), (x0 + wall, y1 - wall, z1), texture),
    ]


def drawer(
    rng: np.random.Generator,
    palette: Palette,
    cell: Cell,
    reach=None,
    thick: float = 0.045,
    texture: Optional[Texture] = None,
) -> SyntheticPart:
    """A front with an open box behind it. reach: (start, end) as shares of the box' length."""
    y0, y1, z0, z1 = cell.y0 + GAP / 2, cell.y1 - GAP / 2, cell.z0 + GAP / 2, cell.z1 - GAP / 2
    x0, x1 = cell.x + 0.004, cell.x + 0.004 + thick
    length = rng.uniform(0.75, 0.92) * cell.depth
    side = 0.055  # clear of the carcass' walls
    inner = tray(
        rng,
        (x0 - length, y0 + side, z0 + side),
        (x0, y1 - side, z1 - side - 0.15 * (z1 - z0)),
        palette.texture(bright=0.85),
    )
    front = box((x0, y0, z0), (x1, y1, z1), texture or palette.texture())
    grip = handle(rng, palette, x1, (y0 + y1) / 2, (z0 + z1) / 2, False, rng.uniform(0.2, 0.4) * (y1 - y0))
    start, end = reach or part_open(rng, 0.35, 0.85)
    axis = (1.0, 0, 0)
    if rng.random() < 0.3:
        axis, start, end = (-1.0, 0, 0), -start, -end
    joint = prismatic(axis, (x1, (y0 + y1) / 2, (z0 + z1) / 2), start * length, end * length)
    return SyntheticPart("drawer", (front, *inner, *grip), joint)


def assemble(name: str, static: list[Primitive], moving: list[SyntheticPart]) -> SyntheticObject:
    return SyntheticObject(name, (SyntheticPart("base", tuple(static)), *moving)).fitted()


def demo_cabinet() -> SyntheticObject:
    """The demo: a door over a drawer, both shut at the start."""
    rng = np.random.default_rng(11)
    palette = Palette(rng)
    pale, inside = ((0.82, 0.62, 0.40), (0.60, 0.40, 0.22)), ((0.90, 0.84, 0.72), (0.66, 0.58, 0.46))
    shell, lining = Texture("wood", *pale, 0.30, 1), Texture("noise", *inside, 0.22, 2)
    depth, width, height, wall, split = 0.8, 0.9, 1.1, 0.04, 0.40
    x0, x1, y = -depth / 2, depth / 2, width / 2
    boards = [
        box((x0, -y, 0), (x1, y, wall), shell),
        box((x0, -y, height - wall), (x1, y, height), shell),
        box((x0, -y, wall), (x1, wall - y, height - wall), shell),
        box((x0, y - wall, wall), (x1, y, height - wall), shell),
        box((x0, wall - y, wall), (x0 + 0.02, y - wall, height - wall), lining),
        box((x0 + 0.02, wall - y, split - 0.02), (x1, y - wall, split + 0.02), lining),
        box((x0 + 0.02, wall - y, 0.74), (0.2, y - wall, 0.765), lining),
    ]
    jar = cylinder(
        (-0.08, -0.12, 0.765),
        (-0.08, -0.12, 0.93),
        0.09,
        Texture("stripes", (0.85, 0.30, 0.25), (0.95, 0.90, 0.80), 0.09, 5),
    )
    low = Cell(x1, -y, y, 0, split, depth - 0.02, ("left", "right"))
    high = Cell(x1, -y, y, split, height, depth - 0.02, ("left", "right"))
    moving = [
        door(
            rng,
            palette,
            high,
            "left",
            (0, 70),
            texture=Texture("checks", (0.30, 0.52, 0.56), (0.20, 0.36, 0.42), 0.30, 3),
        ),
        drawer(rng, palette, low, (0, 0.6), texture=Texture("noise", (0.86, 0.66, 0.26), (0.60, 0.40, 0.16), 0.20, 4)),
    ]
    return assemble("cabinet", [*boards, jar], moving)


def _fill(rng: np.random.Generator, palette: Palette, cell: Cell, drawers: float) -> SyntheticPart:
    wide, tall = cell.y1 - cell.y0, cell.z1 - cell.z0
    if rng.random() < drawers or tall < 0.25:
        return drawer(rng, palette, cell)
    if tall < 0.6 * wide and rng.random() < 0.5:
        return door(rng, palette, cell, "bottom" if rng.random() < 0.7 else "top", part_open(rng, 40, 90))
    return door(rng, palette, cell, str(rng.choice(cell.outer)) if cell.outer else str(rng.choice(["left", "right"])))


def _storage(
    rng: np.random.Generator,
    name: str,
    columns: list[int],
    drawers: float,
    size: tuple[float, float, float],
    open_cells: int = 0,
) -> SyntheticObject:
    palette = Palette(rng)
    depth, width, height = size
    boards, cells = carcass(rng, palette, depth, width, height, columns)
    left_open = (
        set(rng.choice(len(cells), min(open_cells, len(cells) - 1), replace=False).tolist()) if open_cells else set()
    )
    moving = [_fill(rng, palette, c, drawers) for i, c in enumerate(cells) if i not in left_open]
    return assemble(name, boards, moving)


@KINDS.register("cabinet")
def cabinet_of_many(rng: np.random.Generator) -> SyntheticObject:
    """Doors, flaps and drawers in one to three columns, 1 to 6 moving parts, at times an open compartment."""
    columns = [int(rng.integers(1, 3)) for _ in range(int(rng.integers(1, 4)))]
    if sum(columns) == 1:
        columns = [2]
    size = (rng.uniform(0.6, 0.9), rng.uniform(0.7, 1.0) * (0.5 + 0.4 * len(columns)), rng.uniform(0.9, 1.4))
    return _storage(rng, "cabinet", columns, 0.4, size, open_cells=int(rng.random() < 0.4))


@KINDS.register("chest")
def chest_of_drawers(rng: np.random.Generator) -> SyntheticObject:
    """Drawers only, two to five, some side by side."""
    columns = [int(rng.integers(2, 5))] if rng.random() < 0.6 else [int(rng.integers(1, 3)), int(rng.integers(1, 3))]
    return _storage(rng, "chest", columns, 1.0, (rng.uniform(0.6, 0.8), rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.2)))


@KINDS.register("fridge")
def fridge(rng: np.random.Generator) -> SyntheticObject:
    """Two doors side by side or one above the other, shelves inside, at times a drawer below."""
    palette = Palette(rng)
    side_by_side = rng.random() < 0.5
    size = (rng.uniform(0.65, 0.8), rng.uniform(0.75, 1.0), rng.uniform(1.4, 1.7))
    boards, cells = carcass(rng, palette, *size, [1, 1] if side_by_side else [2], 0.06)
    shell = boards[0].texture
    shelf = Texture("noise", (0.85, 0.9, 0.92), (0.65, 0.75, 0.8), 0.2, 3)
    for c in cells:
        for z in np.linspace(c.z0, c.z1, int(rng.integers(3, 5)))[1:-1]:
            boards.append(box((c.x - c.depth, c.y0 + 0.06, z), (c.x - 0.12, c.y1 - 0.06, z + 0.015), shelf))
    side = str(rng.choice(["left", "right"]))
    moving = [door(rng, palette, c, c.outer[0] if side_by_side else side, thick=0.07, texture=shell) for c in cells]
    return assemble("fridge", boards, moving)


@KINDS.register("oven")
def oven(rng: np.random.Generator) -> SyntheticObject:
    """A flap that opens downwards under a panel with knobs, often a drawer below."""
    palette = Palette(rng)
    boards, cells = carcass(rng, palette, 0.75, rng.uniform(0.8, 1.0), 1.0, [2 if rng.random() < 0.6 else 1])
    top = cells[-1]
    panel = Cell(top.x, top.y0, top.y1, top.z0, top.z1 - 0.16, top.depth, top.outer)
    boards.append(box((top.x, top.y0, top.z1 - 0.15), (top.x + 0.05, top.y1, top.z1), palette.texture()))
    z, middle = top.z1 - 0.075, (top.z0 + top.z1) / 2
    knobs = [cylinder((top.x + 0.05, y, z), (top.x + 0.09, y, z), 0.035, palette.metal()) for y in (-0.25, 0, 0.25)]
    boards.append(
        box((top.x - top.depth, top.y0 + 0.05, middle), (top.x - 0.05, top.y1 - 0.05, middle + 0.02), palette.metal())
    )
    moving = [door(rng, palette, panel, "bottom", part_open(rng, 45, 90))]
    moving += [drawer(rng, palette, c) for c in cells[:-1]]
    return assemble("oven", [*boards, *knobs], moving)


@KINDS.register("nested_drawers")
def nested_drawers(rng: np.random.Generator) -> SyntheticObject:
    """A drawer that comes out with a shallow tray above its box that slides less far."""
    palette = Palette(rng)
    boards, (cell,) = carcass(rng, palette, 0.9, rng.uniform(0.8, 1.0), rng.uniform(0.5, 0.65), [1])
    outer = drawer(rng, palette, cell, (0.0, rng.uniform(0.65, 0.85)))
    joint, back = outer.joint, outer.primitives[4]
    assert joint is not None  # a drawer slides
    x0, y0, z1 = back.corners[:, 0].max(), back.corners[:, 1].min(), back.corners[:, 2].max()
    y1, length = back.corners[:, 1].max(), cell.x - back.corners[:, 0].max()
    lag = rng.uniform(0.0, 0.15) * length  # the tray stays behind, so that far it needs room at the drawer's back
    x_back, x_front = x0 + 0.02 + lag, x0 + 0.02 + lag + 0.55 * length
    inner = tray(rng, (x_back, y0 + 0.01, z1 - 0.13), (x_front, y1 - 0.01, z1 - 0.01), palette.texture("checks"))
    lip = box((x_front, y0 + 0.01, z1 - 0.13), (x_front + 0.022, y1 - 0.01, z1 - 0.01), palette.texture())
    slide = prismatic(joint.axis, (x_front, 0, z1), 0.0, joint.motion - np.sign(joint.motion) * lag)
    return assemble("nested_drawers", boards, [outer, SyntheticPart("tray", (*inner, lip), slide)])


@KINDS.register("table")
def table(rng: np.random.Generator) -> SyntheticObject:
    """A desk: top on legs, drawers side by side under it, at times a door below one of them."""
    palette = Palette(rng)
    count = int(rng.integers(1, 4))
    boards, cells = carcass(rng, palette, 0.7, rng.uniform(1.1, 1.5), rng.uniform(0.26, 0.34), [1] * count)
    wood, width = boards[0].texture, -2 * cells[0].y0
    corners = [(x, y) for x in (-0.34, 0.34) for y in (-width / 2, width / 2)]
    legs = [box((x, y, -0.6), (x - 0.07 * np.sign(x), y - 0.07 * np.sign(y), 0), wood) for x, y in corners]
    top = box(
        (-0.4, -width / 2 - 0.05, cells[0].z1), (0.44, width / 2 + 0.05, cells[0].z1 + 0.05), palette.texture("wood")
    )
    return assemble("table", [*boards, *legs, top], [drawer(rng, palette, c) for c in cells])
