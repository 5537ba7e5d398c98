"""``p2gs export RUN --format NAME...``: what can be written, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Callable, Iterable, Optional

from p2gs.export.asset import DENSITIES, Asset, load_asset
from p2gs.export.assets_dir import write_obj
from p2gs.export.texture import Baker
from p2gs.registry import Registry
from p2gs.types import UserError

Exporter = Callable[[Asset, Path], Path]
EXPORTERS: Registry[Exporter] = Registry("export format")
DEFAULT_UP = {"glb": "y"}  # glTF's rule; the others take the input's z
UNTEXTURED = {"ply"}
FOR_LOOKS = {"glb", "ply", "obj"}  # hold no collision pieces or masses, which take most of an export's time


@EXPORTERS.register("urdf")
def urdf(asset: Asset, out: Path) -> Path:
    """twin.urdf with assets/."""
    from p2gs.export.urdf import write_urdf

    return write_urdf(asset, out)


@EXPORTERS.register("mjcf")
def mjcf(asset: Asset, out: Path) -> Path:
    """twin.xml with assets/."""
    from p2gs.export.mjcf import write_mjcf

    return write_mjcf(asset, out)


@EXPORTERS.register("glb")
def glb(asset: Asset, out: Path) -> Path:
    """twin.glb, animated."""
    from p2gs.export.glb import write_glb

    return write_glb(asset, out)


@EXPORTERS.register("usd")
def usd(asset: Asset, out: Path) -> Path:
    """twin.usda with physics joints."""
    from p2gs.export.usd import write_usd

    return write_usd(asset, out)


@EXPORTERS.register("ply")
def ply(asset: Asset, out: Path) -> Path:
    """parts/<link>.ply at the start state, vertex colours."""
    from p2gs.export.mesh import write_mesh
    from p2gs.export.tsdf import Mesh

    folder = out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for link in asset.links:
        v = link.visual
        write_mesh(folder / f"{link.name}.ply", Mesh(v.vertices + link.origin, v.faces, v.colours))
    return folder


@EXPORTERS.register("obj")
def obj(asset: Asset, out: Path) -> Path:
    """parts/<link>.obj at the start state, vertex colours, perhaps a texture."""
    folder = out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for link in asset.links:
        v = link.visual
        write_obj(folder / f"{link.name}.obj", v.vertices + link.origin, v.faces, v.colours, link.texture)
    return folder


def export_run(
    run_dir: Path | str,
    formats: Iterable[str] = ("all",),
    out: Optional[Path | str] = None,
    scale: float = 1.0,
    up: Optional[str] = None,
    origin: str = "keep",
    extend_range: bool = False,
    texture: bool = False,
    material: str = "chipboard",
) -> list[Path]:
    """Write a finished run in the named formats (``all``: every one) into ``out`` (default the run's folder); returns the files.

    scale: metres per input unit.  up: z, y or x, by default what the format expects.  origin: keep, center or bottom.
    extend_range: joint limits go on beyond the observed motion until parts touch (twin.json keeps what was observed).
    texture: parts get baked textures in every format but PLY, which knows none.
    material: one of ``DENSITIES``, which the masses go by.
    Raises UserError for an unknown format or material, with the nearest name, and for textures that no named format holds.
    """
    names = list(dict.fromkeys(n for f in formats for n in (EXPORTERS if f == "all" else [f])))
    if not names:
        raise UserError(f"no export format given; known: {', '.join(EXPORTERS)}")
    writers = {name: EXPORTERS[name] for name in names}
    if texture and UNTEXTURED.issuperset(names):
        raise UserError(f"--texture: {', '.join(names)} holds vertex colours and no textures; name another format as well, or leave it out")
    out = Path(out) if out is not None else Path(run_dir)
    out.mkdir(parents=True, exist_ok=True)
    if material not in DENSITIES:
        raise UserError(f"--material is '{material}', expected one of {', '.join(DENSITIES)}")
    axes = {name: up or DEFAULT_UP.get(name, "z") for name in writers}
    solid = {axes[name] for name in writers if name not in FOR_LOOKS}
    assets: dict[str, Asset] = {}
    baker = Baker(run_dir) if texture else None
    written = []
    for name, write in writers.items():
        axis = axes[name]
        if axis not in assets:
            options = {"solid": axis in solid, "extend_range": extend_range, "texture": baker}
            assets[axis] = load_asset(run_dir, scale, axis, origin, DENSITIES[material], **options)
        written.append(write(assets[axis], out))
    return written
