"""The data sources that come with p2gs, by the name used in ``data: {format: NAME}``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Optional

from p2gs.data import artgs, dta, paris
from p2gs.data.base import DATASETS, TwoStateData
from p2gs.data.frames import Frame
from p2gs.data.images import DepthMode
from p2gs.data.report import Report
from p2gs.types import UserError


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


def open_data(root: str, format: Optional[str] = None, **options) -> TwoStateData:
    """The data module for a scene folder; the format is found from the folder if not given. Raises UserError where it cannot be."""
    from p2gs.data.layouts import detect_format

    format = format or detect_format(Path(root))
    if format is None:
        raise UserError(f"{root}: is none of the layouts {', '.join(sorted(DATASETS))}; name one as data.format")
    return DATASETS[format](root=root, **options)
