"""TensorBoard over many runs: what a run was given and what it scored (HPARAMS), and its losses by family (CUSTOM
SCALARS)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Optional

import yaml

from p2gs.callbacks.base import Callback, register_callback
from p2gs.stage_times import stages_file, wall_seconds

TOP = ("seed", "device", "rasterizer", "num_parts")
OF_LOSS = ("weight", "variant", "exponent", "k_r")
WHOLE = ("canonical", "repel")  # sections whose every value is shown


@register_callback("families")
class Families(Callback):
    """The losses of a phase as one chart a kind (image, prior, parts, motion, physics, own), and joints and their
    errors beside.

    Uses the tags that the callbacks ``scalars`` and ``evaluation`` write.
    """

    changes_result = False

    def on_train_start(self, trainer, phase) -> None:
        for logger in trainer.loggers:
            add = getattr(getattr(logger, "experiment", None), "add_custom_scalars", None)
            if add is not None:
                add(layout(phase.phase_name, phase.losses))


def layout(phase_name: str, losses: dict[str, Any]) -> dict:
    """The layout for ``SummaryWriter.add_custom_scalars``: category -> chart -> ["Multiline", [regular expressions of
    tags]]."""
    charts: dict[str, list] = {"total": ["Multiline", [f"^{phase_name}/loss/total$"]]}
    for name, loss in losses.items():
        charts.setdefault(loss.kind, ["Multiline", []])[1].append(f"^{phase_name}/loss/{name}$")
    out = {f"{phase_name}: losses": charts}
    if phase_name == "articulation":
        tags = {
            "turn [deg]": r"joint_\d+/degrees",
            "slide": r"joint_\d+/slide",
            "mass of the parts": r"part_mass/\d+",
            "joint errors": r"error/.*",
        }
        out[f"{phase_name}: joints"] = {chart: ["Multiline", [f"^{phase_name}/{tag}$"]] for chart, tag in tags.items()}
    return out


# -- after the run ----------------------------------------------------------------------------------------------------


def run_parameters(config: dict) -> dict[str, Any]:
    """What a sweep is likely to vary, flat: seed, scene, steps, starts, weights and variants of losses,
    canonicalisation, repel points.

    config: RUN/config.yaml as plain values. A loss that is off in the articulation phase has weight 0.
    """
    data = config.get("data") or {}
    out: dict[str, Any] = {"scene": Path(str(data["root"])).name if data.get("root") else data.get("format")}
    out |= {name: config.get(name) for name in TOP}
    for phase, values in (config.get("phases") or {}).items():
        for name, value in (values or {}).items():
            if name in WHOLE and isinstance(value, dict):
                out |= {f"{phase}.{name}.{k}": v for k, v in value.items()}
            elif name in ("steps", "init"):
                out[f"{phase}.{name}"] = value
            elif name == "losses":
                for loss, options in value.items():
                    if options is None:
                        # where ablations switch them; elsewhere it would be a column a loss
                        if phase == "articulation":
                            out[f"{phase}.{loss}.weight"] = 0.0
                    else:
                        out |= {f"{phase}.{loss}.{k}": options[k] for k in OF_LOSS if k in options}
    return {k: v if isinstance(v, (bool, int, float, str)) else str(v) for k, v in out.items()}


def run_scores(run: Path | str) -> dict[str, float]:
    """The numbers of RUN/metrics.json that a sweep is sorted by, and the minutes that the fit took. {} before ``p2gs
    test``."""
    run = Path(run)
    if not (run / "metrics.json").is_file():
        return {}
    metrics = json.loads((run / "metrics.json").read_text())
    out: dict[str, Optional[float]] = {"parts": metrics.get("num_parts"), "gaussians": metrics.get("gaussians")}
    joints = metrics.get("joints") or {}
    names = ("failures", "axis_angle_mean", "pos_mean_artgs", "pos_mean_revolute", "motion_mean")
    out |= {f"joints/{name}": joints.get(name) for name in names}
    out |= {
        f"chamfer/{name}": entry["value"]
        for name, entry in (metrics.get("chamfer") or {}).items()
        if isinstance(entry, dict)
    }
    out |= {f"views/{name}": value for name, value in ((metrics.get("views") or {}).get("mean") or {}).items()}
    out |= {f"penetration/{name}": value for name, value in (metrics.get("penetration") or {}).items()}
    if stages_file(run).is_file():
        out["minutes"] = wall_seconds(json.loads(stages_file(run).read_text())) / 60
    return {f"score/{k}": float(v) for k, v in out.items() if isinstance(v, (int, float))}


def write_hparams(run: Path | str) -> Optional[Path]:
    """RUN/logs/hparams: the run's parameters and scores for TensorBoard's HPARAMS page; the folder, or None for a run
    without scores."""
    from torch.utils.tensorboard import SummaryWriter
    from torch.utils.tensorboard.summary import hparams

    run = Path(run)
    scores = run_scores(run)
    if not scores or not (run / "config.yaml").is_file():
        return None
    folder = run / "logs" / "hparams"
    for old in folder.glob("events.out.tfevents.*"):  # of an earlier test: TensorBoard would show both
        old.unlink()
    with SummaryWriter(str(folder)) as writer:
        for summary in hparams(run_parameters(yaml.safe_load((run / "config.yaml").read_text())), scores):
            writer.file_writer.add_summary(summary)  # pyright: ignore[reportOptionalMemberAccess]
        for name, value in scores.items():
            writer.add_scalar(name, value)
    return folder
