"""``capture.html``: cameras and sparse cloud from above and from the side, a sheet of the masked photographs, the
figures; and ``hypotheses.html``: what may be the room."""

from __future__ import annotations

import html
import json
from pathlib import Path

import numpy as np

from p2gs.data.capture import frame
from p2gs.data.capture.hypotheses import Hypothesis
from p2gs.data.capture.joint import is_end, states_of
from p2gs.data.capture.model import Model

# Two clicks on a plan are two corners: the box of both plans, as an option of ``p2gs data capture``.
CLICKS = """
const box = JSON.parse(document.getElementById('box').dataset.box), at = {}, ends = {};
function place(plan, x, y) {  // of a pixel of the plan, in the scene
  const size = Number(plan.dataset.size);
  return [(x - 300) / 290 * size, (300 - y) / 290 * size];
}
function clicked(plan, x, y) {  // whether a box came of it
  const axes = plan.dataset.axes.split(',').map(Number), name = plan.dataset.axes, here = place(plan, x, y);
  if (!at[name]) { at[name] = here; return false; }
  axes.forEach((axis, i) => {
    box[0][axis] = Math.min(at[name][i], here[i]);
    box[1][axis] = Math.max(at[name][i], here[i]);
  });
  ends[name] = [at[name], here];
  delete at[name];
  return true;
}
function option() { return '--box ' + box.flat().map(v => v.toFixed(4)).join(' '); }
function length() {  // the two places as they were clicked; from above alone they are of one height
  const of = [[0, 0, 0], [0, 0, 0]];
  for (const name in ends)
    name.split(',').map(Number).forEach((axis, i) => ends[name].forEach((end, k) => { of[k][axis] = end[i]; }));
  return '--length M ' + of.flat().map(v => v.toFixed(4)).join(' ');
}
document.querySelectorAll('svg').forEach(plan => plan.addEventListener('click', event => {
  const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(plan.getScreenCTM().inverse());
  if (!clicked(plan, p.x, p.y)) return;
  document.getElementById('box').textContent = option();
  document.getElementById('length').textContent = length();
}));
"""
# of points: whether they lie on the object, whether both states show them at one place
COLOURS = {
    (False, True): ("the room, seen in both states", "#999"),
    (False, False): ("the room, seen in one state alone", "#ccc"),
    (True, True): ("the object, seen in both states: stands still", "#083"),
    (True, False): ("the object, seen in one state alone: moved, or was out of sight", "#c0c"),
}
CAMERAS = {False: ("cameras of the first state", "#c62"), True: ("cameras of the second state", "#26c")}
FOR, AGAINST = "#c0c", "#ccc"  # points that vote for a hypothesis, the others
MAX_DOTS = 4000
STYLE = "body{font:15px sans-serif;margin:2em}figure{display:inline-block;margin:0 1em}"


def contact_sheet(folder: Path, files: list[str], out: Path, width: int = 240, columns: int = 8) -> None:
    """A JPEG of RGBA images over green."""
    import cv2

    tiles = []
    for name in files:
        image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        height = round(image.shape[0] * width / image.shape[1])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        alpha = image[..., 3:] / 255
        grey = image[..., :3].mean(2, keepdims=True) * 0.35 + np.array([40, 110, 40], np.float32)
        tiles.append(np.clip(alpha * image[..., :3] + (1 - alpha) * grey, 0, 255).astype(np.uint8))
    rows = [_row(tiles[i : i + columns], columns * width) for i in range(0, len(tiles), columns)]
    cv2.imwrite(str(out), np.vstack(rows))


def _row(tiles: list[np.ndarray], width: int) -> np.ndarray:
    """Pictures [h, w, 3] beside one another on black, [the tallest's h, width, 3]."""
    row = np.zeros((max(t.shape[0] for t in tiles), width, 3), np.uint8)
    at = 0
    for tile in tiles:
        row[: tile.shape[0], at : at + tile.shape[1]] = tile
        at += tile.shape[1]
    return row


def on_object(model: Model, masks: dict[str, np.ndarray]) -> np.ndarray:
    """[P] bool: points that most of the photographs in which they were found have within the mask. masks: [H, W] uint8
    by photograph's name."""
    rows, images, pixels = model.observations()
    inside = np.zeros(len(rows), bool)
    for key, photo in model.photos.items():
        mask = masks.get(photo.name)
        if mask is not None:
            mine = np.flatnonzero(images == key)
            x, y = np.clip(pixels[mine].astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
            inside[mine] = mask[y, x] > 127
    found, within = np.bincount(rows, minlength=len(model.ids)), np.bincount(rows[inside], minlength=len(model.ids))
    return within > found / 2


def _plan(model: Model, colours: np.ndarray, axes: tuple[int, int], title: str, box: np.ndarray | None = None) -> str:
    """An SVG of the scene along one axis. colours: [P] of the points. box: [2, 3], drawn where there is one."""
    size = 3.0 * max(np.abs([p.position for p in model.photos.values()]).max(), 1e-6) / 2
    xyz = model.xyz

    def at(p) -> tuple[float, float]:
        return 300 + 290 * p[axes[0]] / size, 300 - 290 * p[axes[1]] / size

    parts = []
    for i in np.random.default_rng(0).permutation(len(xyz))[:MAX_DOTS]:
        if np.abs(xyz[i]).max() < size:
            parts.append('<circle cx="%.1f" cy="%.1f" r="1.3" fill="%s"/>' % (*at(xyz[i]), colours[i]))
    for p in model.photos.values():
        a, b = at(p.position), at(p.position + 0.06 * size * p.forward)
        line = '<line x1="%.1f" y1="%.1f" x2="%.1f" y2="%.1f" stroke="%s" stroke-width="2"/>'
        parts.append(line % (*a, *b, CAMERAS[is_end(p.name)][1]))
    if box is not None:
        (x0, y0), (x1, y1) = at(box[0]), at(box[1])
        parts.append(
            f'<rect x="{x0:.1f}" y="{y1:.1f}" width="{x1 - x0:.1f}" height="{y0 - y1:.1f}" fill="none" stroke="#090" '
            'stroke-width="2"/>'
        )
    return (
        f'<figure><svg viewBox="0 0 600 600" width="480" data-size="{size:.6g}" data-axes="{axes[0]},{axes[1]}">'
        f"{''.join(parts)}</svg><figcaption>{html.escape(title)}</figcaption></figure>"
    )


def write_hypotheses(scene: Path, model: Model, found: list[Hypothesis]) -> None:
    """hypotheses.html in the scene's folder: for each of them which points of the first state vote for it. model: the
    first state's own reconstruction."""
    world = model.moved(frame.to_world(frame.floor_of(model), model, 1.0))
    parts = []
    for i, hypothesis in enumerate(found):
        colours = np.full(len(model.ids), AGAINST, object)
        colours[hypothesis.pairs[:, 0]] = FOR
        told = {k: v for k, v in hypothesis.to_dict().items() if v is not None}
        plans = [
            _plan(world, colours, axes, title) for axes, title in (((0, 1), "from above"), ((0, 2), "from the side"))
        ]
        figures = html.escape(", ".join(f"{k} {v}" for k, v in told.items()))
        parts.append(f"<h2>--static {i}</h2><p>{figures}</p>{''.join(plans)}")
    (scene / "hypotheses.html").write_text(
        f"""<!doctype html><meta charset="utf-8"><title>hypotheses</title><style>{STYLE}</style>
<h1>What stood still?</h1><p>Each hypothesis says how the second state's photographs lie to the first's; its points are
<b style="color:{FOR}">coloured</b>, the first state's others grey. The room's points lie all about the object, a moved
part's on that part alone. spread: how far the points reach, over the cameras' distance; outside: the share of them
beside the object. <code>p2gs data capture --static N</code> takes the one that you know to be the room.</p>
{"".join(parts) or "<p>There is none.</p>"}"""
    )


def write_page(scene: Path, model: Model, masks: dict[str, np.ndarray], box: np.ndarray, facts: dict) -> None:
    """capture.html and contact.jpg in the scene's folder. model: scene coordinates; masks: [H, W] uint8 by photograph's
    name; box: [2, 3] of the object."""
    files = [i["file"] for i in facts["images"] if i["file"]]
    contact_sheet(scene, files, scene / "contact.jpg")
    still, mine = states_of(model).all(1), on_object(model, masks)
    colours = np.array([COLOURS[bool(a), bool(b)][1] for a, b in zip(mine, still, strict=True)], object)
    legend = "".join(f'<li style="color:{c}">{n}</li>' for n, c in [*COLOURS.values(), *CAMERAS.values()])
    left_out = "".join(
        f"<li>{html.escape(i['source'])}: {html.escape(i['reason'])}</li>" for i in facts["images"] if not i["file"]
    )
    corners = html.escape(json.dumps(box.round(4).tolist()))
    option = "--box " + " ".join(f"{x:.4f}" for x in box.ravel())
    brief = {k: v for k, v in facts.items() if k not in ("images", "gains")}
    (scene / "capture.html").write_text(
        f"""<!doctype html><meta charset="utf-8"><title>capture</title><style>{STYLE}</style>
<h1>{html.escape(scene.name)}</h1>
{_plan(model, colours, (0, 1), "from above", box)}
{_plan(model, colours, (0, 2), "from the side", box)}<ul>{legend}<li style="color:#090">the object's box</li></ul>
<p>Masks of the wrong thing? Click two opposite corners of the object in each picture above, wide enough for both
states, and run the same command with <code id="box" data-box="{corners}">{option}</code> (now: the box that was
found).</p><p>Is a length known (a rug, the object's width)? Click its two ends from above, and from the side
too where they are at different heights, and run the same command with
<code id="length">--length M x0 y0 z0 x1 y1 z1</code>, M in metres.</p>
<h2>Masks</h2><img src="contact.jpg" style="max-width:100%"><h2>Left out</h2><ul>{left_out or "<li>nothing</li>"}</ul>
<h2>Figures</h2><pre>{html.escape(json.dumps(brief, indent=1))}</pre>
<script>{CLICKS}</script>"""
    )
