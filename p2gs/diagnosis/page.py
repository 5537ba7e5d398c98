"""RUN/diagnostics.json and RUN/diagnostics.html: from which one can tell at which stage an object was lost."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from pathlib import Path
from typing import Sequence

import numpy as np

from p2gs.data.box import INTERNAL_DIAGONAL
from p2gs.diagnosis.measures import StageResults, diagnose
from p2gs.diagnosis.pictures import diagnostic_strips
from p2gs.diagnosis.verdict import LIMITS, STAGES, lost_at, told_saved, verdicts
from p2gs.export.pages.report import read_scalars, table
from p2gs.export.pages.report_view import chip
from p2gs.types import ArticulatedObject, UserError

TITLES = {
    "single_state": "Reconstruction of each state",
    "discovery": "Motion evidence, parts and labels",
    "canonical_fusion": "Fusion of both states",
    "articulation": "Learning",
    "finish": "Polish and joints",
}


def write_diagnosis(
    run_dir: Path | str,
    stages: StageResults,
    twin: ArticulatedObject,
    views,
    *,
    min_margin: float,
    backend: str = "auto",
    twin_backend: str | None = None,
    device="cpu",
) -> dict:
    """Measure, judge, draw and write: what the end of every fit does. Parameters as of ``diagnosis.measures.diagnose``,
    twin in internal units. Returns what the JSON holds."""
    d = diagnose(stages, twin, views, min_margin=min_margin, backend=backend, twin_backend=twin_backend, device=device)
    strips = diagnostic_strips(stages, twin, views, min_margin, backend)
    return write_diagnostics(run_dir, d, strips, INTERNAL_DIAGONAL / twin.similarity.scale)


def write_diagnostics(
    run_dir: Path | str, diagnosis: dict, strips: Sequence[tuple[str, str, np.ndarray]], diagonal: float
) -> dict:
    """Both files; returns what the JSON holds.

    diagnosis: of ``diagnosis.measures.diagnose``.  strips: (stage, text, picture).  diagonal: of the object's box,
    input units. Losses at the start and end of each training stage come from RUN/logs (left out where nothing was
    logged).
    """
    run_dir = Path(run_dir)
    said = verdicts(diagnosis, diagonal)
    limits = {name: {"value": value, "why": why} for name, (value, why) in LIMITS.items()}
    head = {"format": diagnosis["format"], "lost_at": lost_at(said), "verdict": said}
    d = {**head, **diagnosis, "losses": losses(run_dir / "logs"), "limits": limits}
    part = run_dir / "diagnostics.tmp"
    part.write_text(json.dumps(d, indent=1) + "\n")
    part.replace(run_dir / "diagnostics.json")
    (run_dir / "diagnostics.html").write_text(page(d, strips, run_dir.resolve().name))
    return d


def losses(logs: Path) -> dict[str, dict[str, list[float]]]:
    """{training stage: {loss: [first, last] value in the log}}."""
    out: dict[str, dict[str, list[float]]] = {}
    for folder in sorted(p for p in logs.iterdir() if p.is_dir()) if logs.is_dir() else []:
        curves = {tag.split("/loss/")[1]: v for tag, v in read_scalars(folder).items() if "/loss/" in tag and len(v)}
        if curves:
            out[folder.name] = {n: [float(f"{v[i, 1]:.6g}") for i in (0, -1)] for n, v in sorted(curves.items())}
    return out


def page(d: dict, strips: Sequence[tuple[str, str, np.ndarray]], name: str) -> str:
    """One self-contained HTML page."""
    css = resources.files("p2gs.export").joinpath("report.css").read_text()
    body = [
        f"<h1>{html.escape(name)}: diagnosis</h1>",
        '<p class="lead">What each stage says of itself, without ground truth.</p>',
    ]
    body += ["<h2>Verdict</h2>", _verdict(d)]
    for stage in STAGES:
        body += [f'<h2 id="{stage}">{TITLES[stage]}</h2>', *SECTIONS[stage](d)]
        for where, text, picture in strips:
            if where == stage:
                body.append(
                    f'<img src="{png(picture)}" alt="{html.escape(text)}"><p class="soft">{html.escape(text)}</p>'
                )
    rows = [[f"<code>{n}</code>", f"{v['value']:g}", html.escape(v["why"])] for n, v in d["limits"].items()]
    body += ["<h2>Limits of the verdict</h2>", table(["measure", "limit", ""], rows)]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{html.escape(name)} - p2gs diagnosis</title>\n<link rel="icon" href="data:,">\n<style>\n{css}'
        ".scroll { margin-bottom: 1rem; } td:last-child { white-space: normal; }\n</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def png(picture: np.ndarray) -> str:
    """A picture, uint8 [H, W, 3], as a data URI."""
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise UserError("a picture of the diagnosis cannot be written as PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def _verdict(d: dict) -> str:
    first = d["lost_at"]
    head = (
        f'<p>The first stage with a warning: <a href="#{first}">{TITLES[first].lower()}</a>.</p>'
        if first
        else "<p>No warnings.</p>"
    )
    items = []
    for v in d["verdict"]:
        text = f"{TITLES[v['stage']]}: {html.escape(v['text'])}"
        items.append(f"<li><b>{text}</b></li>" if v["level"] == "warning" else f"<li>{text}</li>")
    return f"{head}\n<ul>{''.join(items)}</ul>"


def _single(d: dict) -> list[str]:
    rows = [
        [
            k,
            f"{s['psnr']:.1f}",
            f"{s['psnr_sharpened']:.1f}",
            f"{s['alpha_iou']:.3f}",
            f"{s['gaussians']:,}",
            f"{s['fog']:.0%}",
        ]
        for k, s in d["single_state"].items()
    ]
    return [
        table(
            ["state", "PSNR, training views [dB]", "sharpened", "silhouette IoU", "Gaussians", "half-transparent"], rows
        )
    ]


def _discovery(d: dict) -> list[str]:
    out = []
    if d["motion_evidence"] is not None:
        keys = ("moved", "static", "unknown")
        rows = [
            [k, *(_count(s[n]) for n in keys), _share(s.get("moved_without_part"))]
            for k, s in d["motion_evidence"].items()
        ]
        out.append(table(["state", "moved", "static", "unknown", "moved, but in no part"], rows))
    found = d["discovery"]
    if found is not None:
        rows = []
        for i, e in enumerate(found["explanations"]):
            tried = e.get("reductions", [])
            gone = ", ".join(f"{r['change']} {r['type']} ({told_saved(r)})" for r in tried)
            mark = "chosen" if i == found["chosen"] else ""
            rows.append(
                [
                    str(i + 1),
                    f"{e['cost']:.4f}",
                    f"{e['rank']:.3f}",
                    mark,
                    f"{', '.join(e.get('types', []))}{'; ' * bool(gone)}{gone}",
                ]
            )
        out.append(
            table(
                [
                    "explanation",
                    "image loss",
                    "energy above the chosen",
                    "",
                    "parts; what was dropped or merged (what it saved)",
                ],
                rows,
            )
        )
        tried = [t for t in found.get("reconsidered", []) if "energy" in t and "after" in t]
        if tried:
            rows = [
                [t["change"], t["type"], f"{t['cost']:.4f}", f"{t['after']:.4f}", f"{t['energy']:+.4f}"] for t in tried
            ]
            out.append(table(["tried on the chosen one", "type", "image loss", "with it", "energy"], rows))
        sought = [t for t in found.get("reconsidered", []) if t["change"] == "sought"]
        if sought:
            rows = [[t["type"], _share(t["proposed"]), _share(t["own_share"])] for t in sought]
            head = ["sought in what no part explains", "saves in its own pixels, as proposed", "refined"]
            out.append(table(head, rows))
        rows = [[f"{p['part']}", p["type"], _amount(p), f"{p['confidence']:.2f}"] for p in found["parts"]]
        out.append(table(["part of discovery", "type", "start to end", "share explained"], rows))
    rows = [
        [k, " + ".join(map(str, s["gaussians"])), _share(s["ambiguous"]), f"{s['moved']:,}", _share(s["moved_static"])]
        for k, s in d["labels"].items()
    ]
    head = [
        "state, as labelled in the twin",
        "solid Gaussians by part",
        "unclear labels",
        "seen to have moved",
        "of them static",
    ]
    return [*out, table(head, rows)]


def _fusion(d: dict) -> list[str]:
    f = d["fusion"]
    rows = [
        [f"{chip(k)}{k}", f"{n:,}", f"{m:,}"] for k, (n, m) in enumerate(zip(f["gaussians"], f["matched"], strict=True))
    ]
    text = f"canonical time {f['canonical_time']:.3f}; contradicted by free space: "
    text += f"relabelled {_count(f['relabelled'])}, dropped {_count(f['dropped'])}"
    if any(f.get("owners") or []):
        text += f"; {sum(f['owners']):,} went to the part that hides them in the other state"
    for state, o in zip(("start", "end"), f.get("openings") or [], strict=False):
        text += (
            f"; {state}: {o['unconfirmed']:,} that the other state says nothing of, {o['removed']:,} gave way to "
            "the walls behind"
        )
        text += f" and {o['boards']} boards before these" if o.get("boards") else ""
    return [
        table(["part of discovery", "Gaussians", "with a partner in the other state"], rows),
        f'<p class="soft">{text}</p>',
    ]


def _articulation(d: dict) -> list[str]:
    a = d["articulation"]
    rows = [["mean difference to photographs", _number(a["image_loss_start"]), _number(a["image_loss_end"])]]
    rows += [
        [f"loss {html.escape(n)}", _number(v[0]), _number(v[1])] for n, v in d["losses"].get("articulation", {}).items()
    ]
    return [table(["", "start", "end"], rows)]


def _finish(d: dict) -> list[str]:
    p = d["polish"]
    out = []
    ways = [(k, p[k]) for k in ("start_to_end", "end_to_start") if k in p]
    if ways:
        rows = [[k.replace("_", " "), _number(w["before"]), _number(w["after"])] for k, w in ways]
        out.append(table(["image loss", "before the polish", "after"], rows))
    if p["together"]:
        held, free = (_number(p["together"][k]) for k in ("held", "free"))
        out.append(
            f'<p class="soft">Gaussians of both states fitted once more: image loss {held} with joints held, '
            f"{free} with joints that learn, too; the lower one counts</p>"
        )
    if p["contents"]:
        out.append(
            f'<p class="soft">{p["contents"]:,} Gaussians became a drawer\'s: they are on or in its open tray</p>'
        )
    rows = [[k.replace("_", " "), _number(r["static"]), _share(r["bright_static"])] for k, r in d["residuals"].items()]
    out.append(
        table(["moved into the other state", "residual of the static part", "of the object wrong though static"], rows)
    )
    polish = {j["part"]: j for j in p["joints"]}
    rows = []
    for j in d["joints"]:
        q = polish[j["part"]]
        turned = j["type"] == "revolute"
        key = ("changed_degrees", "disagreement_degrees") if turned else ("changed", "disagreement")
        unit = "&deg;" if turned else ""
        values = [f"{q[k]:.3f}{unit}" if k in q else "" for k in key]
        values += [
            _share(j["coverage"]),
            _share(j["contradicted"]),
            _number(j["residual"]),
            _share(j["rise"]),
            _share(j["fall"]),
            "" if j.get("saved") is None else _share(j["saved"]),
        ]
        stages = j["confidence_by_stage"]
        values += [" &rarr; ".join(f"{c:.2f}" for c in stages.values())]
        rows.append([f"{chip(j['part'])}{j['part']}", j["type"], *values])
    head = [
        "part",
        "type",
        "changed by polish",
        "two directions apart",
        "lands on surface",
        "lands in free space",
        "residual / static",
    ]
    out.append(table([*head, "residual rises by", "could fall by", "saves in its pixels", "confidence by stage"], rows))
    return out


SECTIONS = {
    "single_state": _single,
    "discovery": _discovery,
    "canonical_fusion": _fusion,
    "articulation": _articulation,
    "finish": _finish,
}


def _amount(p: dict) -> str:
    return f"{p['degrees']:.1f}&deg;" if "degrees" in p else f"{p['length']:.3f}"


def _count(n) -> str:
    return "not recorded" if n is None else f"{n:,}"


def _share(x) -> str:
    return "" if x is None else f"{x:.1%}"


def _number(x) -> str:
    return "" if x is None else f"{x:.4g}"
