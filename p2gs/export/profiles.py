"""``p2gs export RUN --profile NAME``: the files that one simulator takes as they are, in a folder of their own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Callable, Mapping, Optional

from p2gs.export.asset import Asset
from p2gs.registry import Registry


@dataclass(frozen=True)
class Context:
    """What a profile may know beside the asset.  run: the result folder.  meta: the user's (``metadata.read_meta``)."""

    run: Path
    meta: Mapping[str, object] = field(default_factory=dict)

    @property
    def picture(self) -> Optional[Path]:
        """A rendering of the twin at the start, where the fit made one."""
        path = self.run / "media" / "start.png"
        return path if path.is_file() else None


Profile = Callable[[Asset, Path, Context], list[Path]]
PROFILES: Registry[Profile] = Registry("export profile")
PROFILE_UP = {"partnet": "y"}  # the others stand on z


@PROFILES.register("mujoco")
def mujoco(asset: Asset, out: Path, context: Context) -> list[Path]:
    """twin.xml with assets/."""
    from p2gs.export.files.mjcf import write_mjcf

    return [write_mjcf(asset, out)]


@PROFILES.register("sapien")
def sapien(asset: Asset, out: Path, context: Context) -> list[Path]:
    """twin.urdf with assets/, without the element that only MuJoCo knows."""
    from p2gs.export.files.urdf import write_urdf

    return [write_urdf(asset, out, mujoco=False)]


@PROFILES.register("isaac")
def isaac(asset: Asset, out: Path, context: Context) -> list[Path]:
    """twin.usda with textures/."""
    from p2gs.export.files.usd import write_usd

    return [write_usd(asset, out)]


@PROFILES.register("simready")
def simready(asset: Asset, out: Path, context: Context) -> list[Path]:
    """NAME/usd/NAME.usda with textures, metadata, thumbnail."""
    from p2gs.export.files.simready import write_simready

    return write_simready(asset, out, context.meta, context.run / "twin.json", context.picture)


@PROFILES.register("partnet")
def partnet(asset: Asset, out: Path, context: Context) -> list[Path]:
    """mobility.urdf and the other files of PartNet-Mobility."""
    from p2gs.export.files.partnet import write_partnet

    return write_partnet(asset, out, context.meta)
