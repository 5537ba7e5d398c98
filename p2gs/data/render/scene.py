"""``p2gs data render``: an asset in two states, ray-traced and written in one of the benchmarks' layouts."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Literal, Optional, Sequence

import numpy as np
import torch

from p2gs.data.generated.articulated import SyntheticJoint, concatenate
from p2gs.data.generated.synthetic import intrinsics, test_cameras, train_cameras
from p2gs.data.generated.write import Format, write_views
from p2gs.data.render.asset import Asset, AssetJoint, Shape
from p2gs.data.render.mjcf import read_mjcf
from p2gs.data.render.path_tracer import PathTracer
from p2gs.data.render.tracer import Soup, Tracer
from p2gs.data.render.urdf import read_urdf
from p2gs.types import Camera, TwoStateScene, UserError, View, short

SAME = 1e-5  # of the asset's units: triangles whose corners are this near to another's are drawn once


@dataclass(frozen=True)
class Span:
    """A joint's values in the two states: degrees or the asset's lengths."""

    joint: str
    start: float
    end: float


@dataclass(frozen=True)
class RenderOptions:
    """size: of the square images, pixels.  views, test_views: a state.  samples: rays a pixel, a square number.
    cameras: a scene in one of the layouts, whose cameras are taken instead.  seed: of the cameras.  depth: written
    where the layout has it.  renderer: who makes the colours; masks and depth are Embree's."""

    format: Format = "artgs"
    size: int = 400
    views: int = 64
    test_views: int = 10
    seed: int = 0
    samples: int = 9
    cameras: Optional[Path] = None
    depth: bool = True
    renderer: Literal["embree", "mitsuba"] = "embree"


def read_asset(path: Path) -> Asset:
    """A URDF or MJCF file, by its first element. Raises UserError."""
    if not path.is_file():
        raise UserError(f"{path}: there is no such file; expected a URDF or MJCF")
    head = path.read_bytes()[:20000]
    return read_mjcf(path) if re.search(rb"<\s*mujoco[\s>]", head) else read_urdf(path)


def listed(asset: Asset) -> list[str]:
    """A line for each joint that can move: name, kind and limits."""
    lines = []
    for j in asset.movable:
        turns = j.type == "revolute"
        low, high = (np.degrees(j.limits) if turns else j.limits) if j.limits else (None, None)
        span = "no limits" if low is None else f"{low:.4g} to {high:.4g}{' degrees' if turns else ''}"
        lines.append(f"{j.name}: {j.type}, {span}")
    return lines


def parse_spans(text: str, asset: Asset) -> list[Span]:
    """``NAME=START:END,...``. Raises UserError for an unknown joint, values that are none, and a joint that stays."""
    spans = []
    for word in text.split(","):
        found = re.fullmatch(r"(.+)=([^:=]+):([^:=]+)", word.strip())
        try:
            assert found is not None
            span = Span(found[1], float(found[2]), float(found[3]))
        except (AssertionError, ValueError):
            raise UserError(f"--joints: expected NAME=START:END, got {short(word)}") from None
        asset.joint(span.joint)
        if not np.isfinite([span.start, span.end]).all() or span.start == span.end:
            raise UserError(f"--joints: {span.joint} goes from {span.start:g} to {span.end:g}; expected two values")
        if span.joint in (s.joint for s in spans):
            raise UserError(f"--joints: {span.joint} is named twice")
        spans.append(span)
    return spans


def beyond_limits(asset: Asset, spans: Sequence[Span]) -> list[str]:
    """A sentence for each value outside its joint's limits."""
    out = []
    for span in spans:
        joint = asset.joint(span.joint)
        for value in (span.start, span.end):
            inner = _inner(joint, value)
            if joint.limits and not joint.limits[0] - 1e-6 <= inner <= joint.limits[1] + 1e-6:
                out.append(f"{span.joint} at {value:g} is outside its limits")
    return out


class PosedAsset:
    """An asset with its joints' spans, moved and scaled so that both states lie in the unit ball: what is drawn, and
    the ground truth. parts: part 0 is what none of the named joints moves."""

    def __init__(self, asset: Asset, spans: Sequence[Span]):
        self.name, self.asset, self.spans = asset.path.stem, asset, list(spans)
        values = [{s.joint: _inner(asset.joint(s.joint), (s.start, s.end)[t]) for s in spans} for t in (0, 1)]
        self.shapes = {name: once(shapes) for name, shapes in asset.links.items()}
        poses = [asset.poses(v) for v in values]
        points = [_apply(P[n], s.vertices) for P in poses for n, shapes in self.shapes.items() for s in shapes]
        if not points:
            raise UserError(f"{asset.path}: no link has a visible shape")
        corners = np.concatenate(points)
        centre = (corners.min(0) + corners.max(0)) / 2
        self.scale = 1 / float(np.linalg.norm(corners - centre, axis=1).max())
        fit = np.diag([self.scale] * 3 + [1.0])
        fit[:3, 3] = -self.scale * centre
        self.poses = [{n: fit @ T for n, T in P.items()} for P in poses]
        self.part = asset.parts([s.joint for s in spans])
        self.parts = range(len(spans) + 1)
        for k, span in enumerate(spans):
            if not any(self.part[n] == k + 1 and shapes for n, shapes in self.shapes.items()):
                raise UserError(f"--joints: nothing that can be seen moves with {span.joint} alone")
        self.joints = [self._truth(s) for s in spans]

    def _truth(self, span: Span) -> SyntheticJoint:
        """The joint's axis where its parent is at the start."""
        j = self.asset.joint(span.joint)
        frame = self.poses[0][j.parent] @ j.placed
        axis = frame[:3, :3] @ j.axis
        factor = self.scale if j.type == "prismatic" else 1.0
        kind = "prismatic" if j.type == "prismatic" else "revolute"
        axis = axis / np.linalg.norm(axis)
        return SyntheticJoint(kind, axis, frame[:3, 3], factor * span.start, factor * span.end)

    def mesh(self, part: int, t: float) -> tuple[np.ndarray, np.ndarray]:
        """(vertices [V, 3], faces [F, 3]) of one part at state 0 or 1."""
        pose = self.poses[round(t)]
        of = [(n, s) for n, shapes in self.shapes.items() if self.part[n] == part for s in shapes]
        if not of:
            return np.zeros((0, 3)), np.zeros((0, 3), int)
        return concatenate([(_apply(pose[n], s.vertices), s.faces) for n, s in of])

    def soup(self, state: int) -> Soup:
        """All triangles of a state with their looks."""
        rows, images = [], []
        for name, shapes in self.shapes.items():
            for s in shapes:
                count, textured = len(s.faces), s.image is not None and s.uv is not None
                uv = s.uv[s.faces] if s.uv is not None and textured else np.zeros((count, 3, 2))
                corners = _apply(self.poses[state][name], s.vertices)[s.faces]
                which = np.full(count, len(images) if textured else -1)
                rows.append((corners, np.full(count, self.part[name]), np.tile(s.colour, (count, 1)), uv, which))
                images += [s.image] if textured else []
        return Soup(*(np.concatenate(column) for column in zip(*rows, strict=True)), images=images)


def render_scene(
    posed: PosedAsset, options: RenderOptions, say: Callable[[str], None] = lambda text: None
) -> TwoStateScene:
    """Both states drawn, in memory. say: told of each view."""
    views = []
    for state in (0, 1):
        make = PathTracer if options.renderer == "mitsuba" else Tracer
        tracer, cameras = make(posed.soup(state), options.samples), cameras_of(options, state)
        for k, (name, split, camera) in enumerate(cameras):
            drawn = tracer.draw(camera)
            pixels = (torch.from_numpy(a) for a in (drawn.image, drawn.alpha, drawn.depth))
            views.append(View(name, state, split, camera, *pixels))
            say(f"{('start', 'end')[state]}: {k + 1} of {len(cameras)} views")
    return TwoStateScene(posed.name, tuple(views))


def cameras_of(options: RenderOptions, state: int) -> list[tuple]:
    """(name, split, camera) of a state's views."""
    if options.cameras is not None:
        return [(v.name, v.split, v.camera) for v in _scene_cameras(options.cameras) if v.state == state]
    K = torch.from_numpy(intrinsics(options.size)).float()
    splits = {"train": train_cameras(options.views, options.seed + state), "test": test_cameras(options.test_views)}
    return [
        (f"{i:04d}", split, Camera(torch.from_numpy(m).float(), K, options.size, options.size))
        for split, of in splits.items()
        for i, m in enumerate(of)
    ]


def _scene_cameras(root: Path) -> Sequence[View]:
    from p2gs.data import modules  # noqa: F401  (registers the layouts)
    from p2gs.data.base import DATASETS
    from p2gs.data.layouts import detect_format

    found = detect_format(root) if root.is_dir() else None
    if found is None:
        raise UserError(f"--cameras: {root} is no scene in one of the layouts")
    return DATASETS[found](str(root), depth="never").raw_scene().views


def render(
    path: Path, spans: str, out: Path, options: RenderOptions, say: Callable[[str], None] = lambda text: None
) -> Path:
    """Read, draw and write; returns ``out``. spans: ``NAME=START:END,...``. Raises UserError; writes nothing then."""
    asset = read_asset(path)
    if not asset.movable:
        raise UserError(f"{path}: no joint of it can move")
    posed = PosedAsset(asset, parse_spans(spans, asset))
    for sentence in beyond_limits(asset, posed.spans):
        say(f"note: {sentence}")
    if round(options.samples**0.5) ** 2 != options.samples:
        raise UserError(f"--samples: {options.samples} is not a square number")
    recipe = {"asset": path.name, "joints": spans, "size": options.size, "seed": options.seed}
    return write_views(
        lambda: render_scene(posed, options, say), posed, out, options.format, options.depth, ("render.json", recipe)
    )


def once(shapes: list[Shape]) -> list[Shape]:
    """The same shapes without triangles that lie on others (PartNet's files have a textured front and a plain back in
    one place); the textured one stays."""
    known: set[bytes] = set()
    out = []
    for shape in sorted(shapes, key=lambda s: s.image is None):
        corners = np.round(shape.vertices[shape.faces] / SAME).astype(np.int64)
        order = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=1)
        keys = np.take_along_axis(corners, order[..., None], axis=1).reshape(len(corners), 9)
        keep = np.zeros(len(keys), bool)
        for i, key in enumerate(map(bytes, keys)):
            if key not in known:
                known.add(key)
                keep[i] = True
        if keep.any():
            used, faces = np.unique(shape.faces[keep], return_inverse=True)
            uv = None if shape.uv is None else shape.uv[used]
            out.append(Shape(shape.vertices[used], faces.reshape(-1, 3), shape.colour, shape.image, uv))
    return out


def _inner(joint: AssetJoint, value: float) -> float:
    return float(np.radians(value)) if joint.type == "revolute" else value


def _apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]
