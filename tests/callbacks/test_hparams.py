"""TensorBoard: a run's parameters and scores, and the layout of its losses."""

import json

import yaml

from p2gs.callbacks.hparams import Families, layout, run_parameters, run_scores, write_hparams
from p2gs.config.run import load_config
from p2gs.losses.base import LOSSES, Loss

WORDS = ["--data.format", "artgs", "--data.root", "/somewhere/storage4", "--seed", "7"]
METRICS = {
    "num_parts": 4,
    "gaussians": 10,
    "joints": {"failures": 1, "axis_angle_mean": 0.25, "pos_mean_artgs": None, "joints": []},
    "chamfer": {
        "static": {"value": 1.5, "floor": 0.3},
        "movable": {"value": None, "floor": 0.1},
        "parts": [None],
        "failures": 1,
    },
    "views": {"start": {"psnr_white": 30.0}, "mean": {"psnr_white": 31.0}},
    "penetration": {"mean": 0.01, "max": 0.02},
}


def test_parameters_tell_ablations_apart():
    full = run_parameters(load_config(["preset/cpu.yaml"], WORDS).to_dict())
    none = run_parameters(load_config(["preset/cpu.yaml", "ablation/vanilla.yaml"], WORDS).to_dict())
    assert full["scene"] == "storage4" and full["seed"] == 7 and full["articulation.init"] == "discovery"
    changed = {k for k in full.keys() | none.keys() if full.get(k) != none.get(k)}
    weights = {f"articulation.{name}.weight" for name in ("part", "contact", "velocity", "vector")}
    assert weights | {"articulation.repel.count"} <= changed
    assert all(none[w] == 0.0 < full[w] for w in weights)
    assert all(isinstance(v, (bool, int, float, str)) for v in full.values())


def test_every_loss_is_in_one_chart_of_its_kind():
    losses = {name: cls() for name, cls in LOSSES.items() if cls.__module__.startswith("p2gs.losses.")}
    charts = layout("articulation", losses)["articulation: losses"]
    tags = [tag for _, group in charts.values() for tag in group]
    assert sorted(tags) == sorted(f"^articulation/loss/{name}$" for name in [*losses, "total"])
    assert charts["image"][1] == [
        f"^articulation/loss/{name}$" for name in losses if name in ("render", "alpha", "depth", "surface_depth")
    ]
    assert charts["physics"][1] == ["^articulation/loss/velocity$", "^articulation/loss/contact$"]
    assert "articulation: joints" not in layout("single_state_0", losses)

    class Mine(Loss):
        pass

    assert "^x/loss/mine$" in layout("x", {"mine": Mine()})["x: losses"]["own"][1]


def test_the_layout_reaches_the_logger_and_a_logger_without_one_is_left_alone():
    class Writer:
        def add_custom_scalars(self, tree):
            self.tree = tree

    class Named:
        def __init__(self, **values):
            self.__dict__.update(values)

    phase, writer = Named(phase_name="single_state_1", losses={"render": LOSSES["render"]()}), Writer()
    Families().on_train_start(Named(loggers=[Named(experiment=writer)]), phase)
    assert list(writer.tree) == ["single_state_1: losses"]
    Families().on_train_start(Named(loggers=[]), phase)
    Families().on_train_start(Named(loggers=[Named(experiment=object())]), phase)


def test_parameters_and_scores_are_read_back_from_the_event_file(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    (tmp_path / "logs").mkdir()
    assert run_scores(tmp_path) == {} and write_hparams(tmp_path) is None
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(load_config(["preset/cpu.yaml"], WORDS).to_dict()))
    (tmp_path / "logs" / "stages.json").write_text(json.dumps({"a": {"seconds": 30.0}, "b": {"seconds": 60.0}}))
    write_hparams(tmp_path)
    folder = write_hparams(tmp_path)  # again: the first one's file goes
    assert len(list(folder.glob("events*"))) == 1
    events = EventAccumulator(str(folder)).Reload()
    values = {tag: events.Scalars(tag)[0].value for tag in events.Tags()["scalars"]}
    assert (
        values["score/joints/axis_angle_mean"] == 0.25
        and values["score/minutes"] == 1.5
        and values["score/views/psnr_white"] == 31.0
    )
    assert "score/joints/pos_mean_artgs" not in values and "score/chamfer/movable" not in values
    data = HParamsPluginData.FromString(events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content)
    assert data.session_start_info.hparams["articulation.part.weight"].number_value == 0.1
    assert data.session_start_info.hparams["scene"].string_value == "storage4"
