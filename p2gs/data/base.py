"""What every data source is to the rest of p2gs: a LightningDataModule that yields one ``TwoStateScene``.

A new source is a subclass with one method, ``read()``, registered by name::

    @DATASETS.register("mine")
    class MyData(TwoStateData):
        def read(self) -> TwoStateScene: ...
"""

from __future__ import annotations

from pathlib import Path
from typing import Iterator, Literal, Optional, Sequence, TypeVar

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


class ViewLoader:
    """An endless loader of ``(step, view)`` pairs, addressed by step so that a resumed run sees what an unbroken one would.

    n_views: views to choose from.  seed: of the order.  length: batches in a Lightning epoch (default: one pass over the views).
    ``state_dict`` holds the next step; Lightning saves and restores it with the checkpoint.
    """

    def __init__(self, n_views: int, seed: int = 0, length: Optional[int] = None):
        self.n_views, self.seed, self.length, self.step = n_views, seed, length or n_views, 0

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[tuple[int, int]]:
        while True:
            step, self.step = self.step, self.step + 1
            yield step, view_index(self.seed, step, self.n_views)

    def state_dict(self) -> dict:
        return {"step": self.step}

    def load_state_dict(self, state: dict) -> None:
        self.step = int(state["step"])


class TwoStateData(LightningDataModule):
    """One object in two states.

    Args:
        root: folder of the scene.
        downscale: images are divided by this factor in width and height when read (1 = as on disk).
        max_views: at most so many training views a state, a farthest-point subset of the cameras (None = all).
        depth: ``auto`` reads depth where it is there, ``never`` leaves it out, ``always`` demands it.
        seed: of the order in which views are visited.
        normalize: ``object`` trains with the object's box (found from the masks) centred and 2 units in diagonal, ``none`` as on disk.

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
        self.depth, self.seed, self.normalize = depth, seed, normalize
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
        """The scene as training sees it: internal units, ``box`` set; made once. ``similarity`` leads back to input units."""
        if self._scene is None:
            raw = self._raw or self.read()  # not kept: depth would be held twice
            self._scene = normalise(raw) if self.normalize == "object" else with_box(raw)
        return self._scene

    def setup(self, stage: Optional[str] = None) -> None:
        self.scene()

    def train_dataloader(self) -> ViewLoader:
        """``(step, view)`` over the training views of both states (start's first), in the order of ``scene().select(split="train")``."""
        return ViewLoader(len(self.scene().select(split="train")), self.seed)


def with_box(scene: TwoStateScene) -> TwoStateScene:
    """The same scene, its box found from the masks."""
    return TwoStateScene(scene.name, scene.views, scene.similarity, object_box(scene.select(split="train")))


def thin_out(frames: Sequence[Shot], max_views: Optional[int]) -> list[Shot]:
    """At most ``max_views`` training frames (or views) a state, spread over the cameras' positions; other splits stay whole."""
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
