"""``p2gs export RUN --format NAME...``: what can be written, by name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Callable, Iterable, Mapping, Optional

from p2gs.export.asset import DENSITIES, Asset, load_asset, open_note
from p2gs.export.assets_dir import write_obj
from p2gs.export.links import Link
from p2gs.export.metadata import read_meta
from p2gs.export.naming import with_names
from p2gs.export.profiles import PROFILE_UP, PROFILES, Context
from p2gs.registry import Registry
from p2gs.surface.texture import Baker
from p2gs.types import UserError

Exporter = Callable[[Asset, Path], Path]
EXPORTERS: Registry[Exporter] = Registry("export format")
SPLATS = {"splats", "spz"}  # hold Gaussians
DEFAULT_UP = {"glb": "y", "splats": "y", "spz": "y"}  # glTF's and SPZ's rule; the others take the input's z
UNTEXTURED = {"ply", *SPLATS}
FOR_LOOKS = {"glb", "ply", "obj", *SPLATS}  # hold no collision pieces or masses, which take most of an export's time


@EXPORTERS.register("urdf")
def urdf(asset: Asset, out: Path) -> Path:
    """twin.urdf with assets/."""
    from p2gs.export.files.urdf import write_urdf

    return write_urdf(asset, out)


@EXPORTERS.register("mjcf")
def mjcf(asset: Asset, out: Path) -> Path:
    """twin.xml with assets/."""
    from p2gs.export.files.mjcf import write_mjcf

    return write_mjcf(asset, out)


@EXPORTERS.register("glb")
def glb(asset: Asset, out: Path) -> Path:
    """twin.glb, animated."""
    from p2gs.export.files.glb import write_glb

    return write_glb(asset, out)


@EXPORTERS.register("usd")
def usd(asset: Asset, out: Path) -> Path:
    """twin.usda with physics joints."""
    from p2gs.export.files.usd import write_usd

    return write_usd(asset, out)


@EXPORTERS.register("splats")
def splats(asset: Asset, out: Path) -> Path:
    """splats.glb: the Gaussians, animated."""
    from p2gs.export.files.splats_gltf import write_splats

    return write_splats(asset, out)


@EXPORTERS.register("spz")
def spz(asset: Asset, out: Path) -> Path:
    """splats.spz: the Gaussians at the start state, compressed."""
    from p2gs.export.files.splats_spz import write_spz

    return write_spz(asset, out)


def shown_links(asset: Asset, folder: Path) -> list[Link]:
    """Those with a surface; a bare base's file of an earlier export goes."""
    for link in asset.links:
        if link.bare:
            for old in folder.glob(f"{link.name}.*"):
                old.unlink()
    return [link for link in asset.links if not link.bare]


@EXPORTERS.register("ply")
def ply(asset: Asset, out: Path) -> Path:
    """parts/<link>.ply at the start state, vertex colours."""
    from p2gs.ops.mesh import Mesh
    from p2gs.surface.mesh import write_mesh

    folder = out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for link in shown_links(asset, folder):
        v = link.visual
        write_mesh(folder / f"{link.name}.ply", Mesh(v.vertices + link.origin, v.faces, v.colours))
    return folder


@EXPORTERS.register("obj")
def obj(asset: Asset, out: Path) -> Path:
    """parts/<link>.obj at the start state, vertex colours, perhaps a texture."""
    folder = out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for link in shown_links(asset, folder):
        v = link.visual
        write_obj(folder / f"{link.name}.obj", v.vertices + link.origin, v.faces, v.colours, link.texture)
    return folder


@dataclass(frozen=True)
class ExportOptions:
    """scale: metres per input unit.  up: z, y or x, by default what the format expects.  origin: keep, center or
    bottom.
    extend_range: joint limits go on beyond the observed motion until parts touch (twin.json keeps what was observed).
    texture: parts get baked textures in every format but PLY and splats, which know none.
    material: one of ``DENSITIES``, which the masses go by.
    names: links are called by what they are, which geometry tells but for those given here by part
    (``naming.with_names``).
    fixed: whether the base stands fast in the world (URDF: on a link ``world``); None: as the format has it. A bare one
    always does.
    splats: USD also has each part's Gaussians.
    """

    scale: float = 1.0
    up: Optional[str] = None
    origin: str = "keep"
    extend_range: bool = False
    texture: bool = False
    material: str = "chipboard"
    names: Optional[Mapping[str, str]] = None
    fixed: Optional[bool] = None
    splats: bool = False

    def __post_init__(self) -> None:
        if self.material not in DENSITIES:
            raise UserError(f"--material is '{self.material}', expected one of {', '.join(DENSITIES)}")

    def load(self, run_dir: Path | str, up: str, solid: bool, splats: bool, baker: Optional[Baker]) -> Asset:
        """The run's asset under these options, as far as the formats need it."""
        made = {"solid": solid, "splats": splats, "extend_range": self.extend_range, "texture": baker}
        asset = load_asset(run_dir, self.scale, up, self.origin, DENSITIES[self.material], **made)
        if asset.links[0].bare and self.fixed is False:
            raise UserError(
                f"--floating: {run_dir} has no base that could fall over: none of what stands still has a surface, so "
                "its joints hang on the world"
            )
        # a base without mass is the world, which readers take from a link of that name alone
        asset = replace(asset, fixed=asset.links[0].bare or self.fixed, material=self.material)
        return asset if self.names is None else with_names(asset, self.names)


def own_folder(run_dir: Path | str, out: Optional[Path | str], option: str) -> Path:
    """``out``, which must be another folder than the run's: other programs read its files by the names base and
    part_1."""
    if out is None or Path(out).resolve() == Path(run_dir).resolve():
        raise UserError(
            f"{option}: {run_dir} keeps the names base and part_1 that other programs read; give another folder with "
            "--out"
        )
    return Path(out)


def without_splats(asset: Asset) -> Asset:
    """The asset for formats that are not to have them."""
    return replace(asset, links=[replace(link, splats=None) for link in asset.links])


def export_run(
    run_dir: Path | str,
    formats: Iterable[str] = ("all",),
    out: Optional[Path | str] = None,
    note: Callable[[str], None] = lambda text: None,
    **options,
) -> list[Path]:
    """Write a finished run in the named formats (``all``: every one) into ``out`` (default the run's folder); returns
    the files.

    note: told what a user should know of the result.  options: fields of ``ExportOptions``; with ``names``, ``out``
    must be another folder than the run's. Raises UserError for an unknown format or material, with the nearest name,
    and for textures that no named format holds.
    """
    kinds = list(dict.fromkeys(n for f in formats for n in (EXPORTERS if f == "all" else [f])))
    if not kinds:
        raise UserError(f"no export format given; known: {', '.join(EXPORTERS)}")
    writers = {name: EXPORTERS[name] for name in kinds}
    chosen = ExportOptions(**options)
    if chosen.texture and UNTEXTURED.issuperset(kinds):
        raise UserError(
            f"--texture: {', '.join(kinds)} holds vertex colours and no textures; name another format as well, or "
            "leave it out"
        )
    if chosen.names is not None:
        out = own_folder(run_dir, out, "--name")
    out = Path(out) if out is not None else Path(run_dir)
    out.mkdir(parents=True, exist_ok=True)
    axes = {name: chosen.up or DEFAULT_UP.get(name, "z") for name in writers}
    solid = {axes[name] for name in writers if name not in FOR_LOOKS or chosen.extend_range}
    assets: dict[str, Asset] = {}
    baker = Baker(run_dir) if chosen.texture else None
    written = []
    for name, write in writers.items():
        axis = axes[name]
        if axis not in assets:
            gaussians = chosen.splats or axis in {axes.get(kind) for kind in SPLATS}
            assets[axis] = chosen.load(run_dir, axis, axis in solid, gaussians, baker)
        asset = assets[axis] if chosen.splats or name in SPLATS else without_splats(assets[axis])
        written.append(write(asset, out))
    told = next((text for text in map(open_note, assets.values()) if text), None)
    if told:
        note(told)
    return written


def export_profile(
    run_dir: Path | str,
    profile: str,
    out: Optional[Path | str],
    meta: Optional[Path | str] = None,
    note: Callable[[str], None] = lambda text: None,
    **options,
) -> list[Path]:
    """Write a finished run as one simulator takes it, named and textured, into ``out``, another folder than the run's;
    returns the files.

    meta: a file of ``metadata.read_meta``.  note, options: as for ``export_run``; a profile sets ``up`` and ``texture``
    itself. Raises UserError for an unknown profile, with the nearest name.
    """
    write = PROFILES[profile]
    out = own_folder(run_dir, out, "--profile")
    own = PROFILE_UP.get(profile, "z")
    if options.get("up") not in (None, own):
        raise UserError(f"--up is '{options['up']}', but files of the profile {profile} stand on {own}")
    chosen = replace(ExportOptions(**options), up=own, texture=True)
    chosen = replace(chosen, names=chosen.names or {})
    context = Context(Path(run_dir), read_meta(meta) if meta is not None else {})
    out.mkdir(parents=True, exist_ok=True)
    asset = chosen.load(run_dir, own, True, chosen.splats, Baker(run_dir))
    told = open_note(asset)
    if told:
        note(told)
    return write(asset, out, context)
