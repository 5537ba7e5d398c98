"""The data sources that come with p2gs, by the name used in ``data: {format: NAME}``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal, Optional

from p2gs.data import artgs, dta, paris
from p2gs.data.base import DATASETS, TwoStateData, thin_out
from p2gs.data.frames import Frame
from p2gs.data.images import DepthMode
from p2gs.data.report import Report
from p2gs.types import TwoStateScene, UserError


@DATASETS.register("paris")
class ParisData(TwoStateData):
    """PARIS layout (see ``data.paris``). source: path below ``root/load``; found by itself where there is only one."""

    def __init__(
        self,
        root: str,
        source: Optional[str] = None,
        downscale: float = 1.0,
        max_views: Optional[int] = None,
        depth: DepthMode = "auto",
        seed: int = 0,
        normalize: Literal["object", "none"] = "object",
    ):
        super().__init__(root, downscale, max_views, depth, seed, normalize)
        self.source = source

    def index(self, root: Path, report: Report) -> list[Frame]:
        return paris.index(root, report, self.source)


@DATASETS.register("dta")
class DTAData(TwoStateData):
    """DTA layout (see ``data.dta``)."""

    def index(self, root: Path, report: Report) -> list[Frame]:
        return dta.index(root, report)


@DATASETS.register("artgs")
class ArtGSData(TwoStateData):
    """ArtGS layout (see ``data.artgs``)."""

    def index(self, root: Path, report: Report) -> list[Frame]:
        return artgs.index(root, report)


@DATASETS.register("synthetic")
class SyntheticData(TwoStateData):
    """A generated object (see ``data.synthetic``), written once to ``root`` in the ArtGS layout with its ground truth
    and read from there.

    root: folder to write to and read from; null keeps the scene in memory.  kind: demo, or a kind of generated object,
    null for any.
    object_seed: of the object and its cameras.  size: image side in pixels.  train_views, test_views: per state.
    """

    def __init__(
        self,
        root: Optional[str] = "demo_scene",
        kind: Optional[str] = "demo",
        object_seed: int = 0,
        size: int = 400,
        train_views: int = 64,
        test_views: int = 10,
        downscale: float = 1.0,
        max_views: Optional[int] = None,
        depth: DepthMode = "auto",
        seed: int = 0,
        normalize: Literal["object", "none"] = "object",
    ):
        super().__init__(root or "", downscale, max_views, depth, seed, normalize)
        self.root = root
        self.kind, self.object_seed, self.size = kind, object_seed, size
        self.train_views, self.test_views = train_views, test_views

    def read(self) -> TwoStateScene:
        """Raises UserError for an unknown kind, and where ``root`` holds anything but the scene of these arguments."""
        from p2gs.data.generated.generate import recipe, synthesize
        from p2gs.data.generated.synthetic import make_object, synthetic_scene

        if self.root is None:
            obj = make_object(self.kind, self.object_seed)
            scene = synthetic_scene(
                obj, round(self.size / self.downscale), self.train_views, self.test_views, self.object_seed
            )
            views = thin_out(scene.views, self.max_views)
            return scene.with_views(replace(v, depth=None) if self.depth == "never" else v for v in views)
        root = Path(self.root)
        wanted = recipe(self.object_seed, self.kind, self.size, self.train_views, self.test_views)
        if (root / "synthetic.json").is_file():
            if json.loads((root / "synthetic.json").read_text()) != wanted:
                raise UserError(f"{root}: holds another generated scene; remove it or give another data.root")
        else:
            synthesize(root, self.object_seed, self.kind, self.size, self.train_views, self.test_views)
        return super().read()

    def index(self, root: Path, report: Report) -> list[Frame]:
        return artgs.index(root, report)


def open_data(root: str, format: Optional[str] = None, **options) -> TwoStateData:
    """The data module for a scene folder; the format is found from the folder if not given. Raises UserError where it
    cannot be."""
    from p2gs.data.layouts import detect_format

    format = format or detect_format(Path(root))
    if format is None:
        raise UserError(f"{root}: is none of the layouts {', '.join(sorted(DATASETS))}; name one as data.format")
    return DATASETS[format](root=root, **options)
