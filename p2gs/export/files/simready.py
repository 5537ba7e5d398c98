"""NVIDIA's SimReady packaging of a twin: NAME/usd/NAME.usda with labels, metadata, textures and a thumbnail.

After the requirements NP.005 (folders), SR.001 to SR.004 (metadata, thumbnail) and SL.* (labels) of SimReady Foundation
2026.08.
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import Any, Mapping, Optional

import numpy as np

from p2gs.export.asset import Asset
from p2gs.export.files.usd import write_usd

FOLDER = "usd"  # the one between the asset's folder and its file
THUMBNAIL = 256  # pixels a side


def write_simready(
    asset: Asset, out: Path, meta: Mapping[str, object], source: Path, picture: Optional[Path]
) -> list[Path]:
    """OUT/NAME/usd/NAME.usda and its thumbnail; NAME is the metadata's ``asset_name``, else the twin's.

    meta: of the user, over what is known here.  source: that the twin was made from.  picture: for the thumbnail, if
    there is one.
    """
    name = file_name(str(meta.get("asset_name", asset.name)))
    folder = out / name / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    known = {"asset_name": name, "asset_type": "prop", "source_file": source.name, "usd_date_generated": _today()}
    points = np.concatenate([link.visual.vertices + link.origin for link in asset.links])
    facts = {
        "rigid_body_count": len(asset.links),
        "asset_extents": np.ptp(points, axis=0).tolist(),
        "mass": sum(link.inertia.mass for link in asset.links),
    }
    told = known | dict(meta) | {"asset_name": name}
    data: dict[str, Any] = {"SimReady_Metadata": told | facts} | {key: told[key] for key in known}
    labels = [("class", str(told["category"]))] if "category" in told else []
    if "qcode" in told:
        labels.append(("wikidata_qcode", str(told["qcode"])))
    written = [write_usd(asset, folder, name, data, labels)]
    if picture is not None:
        written.append(
            write_thumbnail(picture, folder / ".thumbs" / f"{THUMBNAIL}x{THUMBNAIL}" / f"{written[0].name}.png")
        )
    return written


def file_name(text: str) -> str:
    """A name as prims and files have it: small letters, digits and underscores, no digit first."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return name if name[:1].isalpha() else f"asset_{name}"


def write_thumbnail(picture: Path, path: Path) -> Path:
    """The middle square of a picture, ``THUMBNAIL`` pixels a side."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(picture) as image:
        side = min(image.size)
        left, top = (image.width - side) // 2, (image.height - side) // 2
        image.convert("RGB").crop((left, top, left + side, top + side)).resize((THUMBNAIL, THUMBNAIL)).save(path)
    return path


def _today() -> str:
    return datetime.date.today().isoformat()
