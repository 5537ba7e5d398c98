"""The 3D view of RUN/report.html: the mesh and the Gaussians side by side, one camera and one slider a joint for both.

The mesh is drawn by a small viewer of its own (report_viewer.js), the Gaussians by Spark (sparkjsdev.github.io, MIT
licence; the bundle is made by spark/package.json). Both are in the page, so that it needs no network.
"""

from __future__ import annotations

import base64
import math
from importlib import resources
from pathlib import Path

from p2gs.ops.palette import part_colour
from p2gs.types import ArticulatedObject

PAGE_FACES = 15_000  # triangles a part


def view_section(run_dir: Path, obj: ArticulatedObject) -> str:
    """The 3D view; nothing without meshes."""
    if not (run_dir / "meshes").is_dir():
        return ""
    from p2gs.export.asset import load_asset
    from p2gs.export.files.glb import glb_bytes
    from p2gs.export.files.splats_spz import spz_bytes

    asset = load_asset(run_dir, up="y", max_faces=PAGE_FACES, solid=False, splats=True)
    sliders = [
        f'<label><span>{chip(link.part)}{link.part} {link.hinge.type}</span><input type="range" min="0" max="1" '
        'step="0.005" value="0" '
        f'data-part="{link.part}" aria-label="joint {link.part}"><output>0</output></label>'
        for link in asset.moving
    ]
    full = [(link.name, link.splats) for link in asset.links if link.splats is not None and len(link.splats)]
    splats = [_embedded(spz_bytes(gaussians), "splats", f'data-node="{name}"') for name, gaussians in full]
    spark = resources.files("p2gs.export").joinpath("spark").joinpath("spark.js.gz").read_bytes()
    return (
        f'<h2>Move it</h2>\n<div class="views"><figure><canvas id="view" data-turn="{front(obj):.3f}" '
        'aria-label="the mesh in 3D"></canvas>'
        '<figcaption class="soft" id="view-note">The mesh. Drag to turn, scroll or pinch to come nearer. Zero is the '
        "start state."
        "</figcaption>"
        '</figure><figure><canvas id="splats" aria-label="the Gaussians in 3D"></canvas>'
        '<figcaption class="soft" id="splats-note">The Gaussians, which the photographs were explained '
        "with.</figcaption></figure></div>\n"
        f'<div class="sliders">{"".join(sliders)}<label><span>part colours</span><input type="checkbox" '
        'id="paint"></label></div>\n'
        + "\n".join([_embedded(glb_bytes(asset), "glb"), _embedded(spark, "spark"), *splats])
        + f"\n<script>\n{_script('report_viewer.js')}</script>\n<script>\n{_script('report_splats.js')}</script>"
    )


def _embedded(content: bytes, kind: str, more: str = "") -> str:
    """A block of data in the page, of class ``kind``."""
    return f'<script type="text/plain" class="{kind}" {more}>{base64.b64encode(content).decode()}</script>'


def _script(name: str) -> str:
    return resources.files("p2gs.export").joinpath(name).read_text()


def front(obj: ArticulatedObject) -> float:
    """Turn of the page's camera, radians about the up axis, towards the side on which the moving parts show best."""
    from p2gs.gaussians.views import best_camera, bounds, orbit

    ring = orbit(obj, 24)
    eye = ring[best_camera(obj, ring)].position.double() - bounds(obj).mean(0)
    return math.atan2(float(eye[0]), -float(eye[1]))


def chip(part: int) -> str:
    """A square of the part's colour."""
    rgb = ",".join(str(round(255 * c)) for c in part_colour(part))
    return f'<span class="chip" style="background:rgb({rgb})"></span>'
