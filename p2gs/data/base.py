"""What every data source is to the rest of p2gs: a LightningDataModule that yields one ``TwoStateScene``.

A new source is a subclass with one method, ``read()``, registered by name::

    @DATASETS.register("mine")
    class MyData(TwoStateData):
        def read(self) -> TwoStateScene: ...
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Iterator, Literal, NamedTuple, Optional, Sequence, Sized, TypeVar

import numpy as np
from lightning.pytorch import LightningDataModule

from p2gs.data.box import farthest_cameras, normalise, object_box
from p2gs.data.frames import Frame
from p2gs.data.images import DepthMode, check_sizes, read_views
from p2gs.data.report import Report, StrictReport
from p2gs.data.views import view_index
from p2gs.registry import Registry
from p2gs.types import TwoStateScene, UserError, View

Shot = TypeVar("Shot", Frame, View)
DATASETS: Registry[type["TwoStateData"]] = Registry("data format")


class Visit(NamedTuple):
    """Which photograph a step looks at. step: of the phase, from 0.  state: 0 or 1.  view: its number among the state's
    training views."""

    step: int
    state: int = 0
    view: int = 0


class ViewLoader:
    """The batches of a phase: an endless row of visits, each a pure function of (seed, step), so that a resumed run
    sees what an unbroken one would.

    views: training views of each state that the phase looks at; the states take turns, and each view comes once before
    any comes twice. None (a phase that renders no photograph): the step alone.  seed: of the order.  first: the step to
    begin at.
    """

    def __init__(self, views: dict[int, int], seed: int = 0, first: int = 0):
        self.views, self.seed, self.first = views, seed, first

    def __getitem__(self, step: int) -> Visit:
        if not self.views:
            return Visit(step)
        turn, which = divmod(step, len(self.views))
        state = sorted(self.views)[which]
        return Visit(step, state, view_index(self.seed + 7919 * state, turn, self.views[state]))

    def __iter__(self) -> Iterator[Visit]:
        return (self[step] for step in itertools.count(self.first))


class TwoStateData(LightningDataModule):
    """One object in two states.

    Args:
        root: folder of the scene.
        downscale: images are divided by this factor in width and height when read (1 = as on disk).
        max_views: at most so many training views a state, a farthest-point subset of the cameras (None = all).
        depth: ``auto`` reads depth where it is there, ``never`` leaves it out, ``always`` demands it.
        seed: of the order in which phases visit views, beside the run's.
        normalize: ``object`` trains with the object's box (found from the masks) centred and 2 units in diagonal,
        ``none`` as on disk.

    strict_paths: the run's; files that lead out of ``root`` are refused, not only named.
    """

    strict_paths = False

    def __init__(
        self,
        root: str,
        downscale: float = 1.0,
        max_views: Optional[int] = None,
        depth: DepthMode = "auto",
        seed: int = 0,
        normalize: Literal["object", "none"] = "object",
    ):
        super().__init__()
        if downscale < 1.0:
            raise UserError(f"data.downscale is {downscale:g}, but it divides the image size and must be at least 1")
        if max_views is not None and max_views < 1:
            raise UserError(f"data.max_views is {max_views}, but it must be at least 1")
        self.root: Optional[str] = root
        self.downscale, self.max_views = downscale, max_views
        self.depth: DepthMode = depth
        self.seed, self.normalize = seed, normalize
        self._files: Optional[list[Path]] = None
        self._raw: Optional[TwoStateScene] = None
        self._scene: Optional[TwoStateScene] = None

    def read(self) -> TwoStateScene:
        """The scene in input units. Raises UserError for the first problem met in the files."""
        root = Path(self.root or "")
        if not root.is_dir():
            raise UserError(f"{root}: scene folder is missing")
        report = StrictReport(root=root, strict=self.strict_paths)
        indexed = self.index(root, report)
        frames = thin_out(indexed, self.max_views)
        left_out = report.opened - {p.resolve() for f in indexed for p in f.files}
        self._files = sorted(left_out | {p.resolve() for f in frames for p in f.files})
        views = read_views(frames, report, self.downscale, self.depth)
        check_sizes(frames, views, report)
        return TwoStateScene(root.resolve().name, tuple(views))

    def files(self) -> list[Path]:
        """The files that decide the scene, once it has been read: a run's stages are made again when one changes.

        Where ``read`` is a subclass's own, every file below ``root``; override it where that is too much.
        """
        if self._files is not None or not self.root:
            return self._files or []
        return sorted(path for path in Path(self.root).resolve().rglob("*") if path.is_file())

    def index(self, root: Path, report: Report) -> list[Frame]:
        """The scene's frames (layouts on disk override this)."""
        raise NotImplementedError(f"{type(self).__name__} has to define read() or index()")

    def raw_scene(self) -> TwoStateScene:
        """The scene in input units (similarity is the identity); read once."""
        if self._raw is None:
            self._raw = self.read()
        return self._raw

    def scene(self) -> TwoStateScene:
        """The scene as training sees it: internal units, ``box`` set; made once. ``similarity`` leads back to input
        units."""
        if self._scene is None:
            raw = self._raw or self.read()  # not kept: depth would be held twice
            self._scene = normalise(raw) if self.normalize == "object" else with_box(raw)
        return self._scene

    def setup(self, stage: Optional[str] = None) -> None:
        self.scene()

    def train_dataloader(self) -> ViewLoader:
        """The visits of the phase in training from the step that it has reached."""
        assert self.trainer is not None  # Lightning asks for the loader when it has attached the trainer
        phase: Any = self.trainer.lightning_module
        return self.visits(phase.views, phase.seed, phase.step)

    def visits(self, views: dict[int, Sized], seed: int, first: int = 0) -> ViewLoader:
        """The visits of a phase of that seed which looks at these views of each state, beginning at step ``first``."""
        return ViewLoader({state: len(of) for state, of in views.items()}, seed + 104729 * self.seed, first)


def with_box(scene: TwoStateScene) -> TwoStateScene:
    """The same scene, its box found from the masks."""
    return TwoStateScene(scene.name, scene.views, scene.similarity, object_box(scene.select(split="train")))


def thin_out(frames: Sequence[Shot], max_views: Optional[int]) -> list[Shot]:
    """At most ``max_views`` training frames (or views) a state, spread over the cameras' positions; other splits stay
    whole."""
    if max_views is None:
        return list(frames)
    keep: set[int] = {i for i, f in enumerate(frames) if f.split != "train"}
    for state in (0, 1):
        mine = [i for i, f in enumerate(frames) if f.split == "train" and f.state == state]
        if mine:
            positions = np.stack([_position(frames[i]) for i in mine])
            keep |= {mine[j] for j in farthest_cameras(positions, max_views)}
    return [f for i, f in enumerate(frames) if i in keep]


def _position(shot: Shot) -> np.ndarray:
    return shot.position if isinstance(shot, Frame) else shot.camera.position.numpy()
