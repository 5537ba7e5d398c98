"""``trainer:``: what goes through to Lightning's Trainer, and the sentence for what cannot."""

from pathlib import Path

import pytest
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.profilers import SimpleProfiler

from p2gs.config.run import load_config
from p2gs.config.trainer import callback_modules, check_trainer_options, decides_result, trainer_arguments
from p2gs.types import UserError


def test_nothing_given_is_tensorboard_alone(tmp_path):
    made = trainer_arguments({}, tmp_path, "sharpen_0")
    assert type(made["logger"]) is TensorBoardLogger and Path(made["logger"].log_dir) == tmp_path / "logs" / "sharpen_0"
    assert made["callbacks"] == [] and made["profiler"] is None and made["enable_checkpointing"] is False


def test_loggers_callbacks_and_profiler_by_class(tmp_path):
    options = {
        "logger": [
            {"class_path": "CSVLogger"},
            {"class_path": "lightning.pytorch.loggers.TensorBoardLogger", "init_args": {"name": "mine"}},
        ],
        "callbacks": [{"class_path": "lightning.pytorch.callbacks.Timer", "init_args": {"interval": "epoch"}}],
        "profiler": "simple",
        "detect_anomaly": True,
        "precision": 32,
    }
    made = trainer_arguments(options, tmp_path, "sharpen_0")
    csv, board = made["logger"]
    assert type(csv) is CSVLogger and Path(csv.log_dir) == tmp_path / "logs" / "sharpen_0"
    assert board.name == "mine" and Path(board.root_dir) == tmp_path / "logs" / "mine"
    assert type(made["callbacks"][0]).__name__ == "Timer" and made["detect_anomaly"] is True and "precision" not in made
    assert type(made["profiler"]) is SimpleProfiler and Path(made["profiler"].dirpath) == tmp_path / "logs"
    assert made["callbacks"][0] is not trainer_arguments(options, tmp_path, "x")["callbacks"][0]  # fresh for each stage
    assert trainer_arguments({"logger": False}, tmp_path, "x")["logger"] is False


@pytest.mark.parametrize(
    "options, message",
    [
        ({"max_steps": 5}, "trainer.max_steps: cannot be set: a phase's steps are phases.NAME.steps"),
        ({"precision": "16-mixed"}, "trained in float32"),
        ({"devices": 2}, "one process on one device"),
        ({"gradient_clip_val": 1.0}, "optimiser of their own"),
        ({"loger": True}, "no 'loger' (did you mean 'logger'?)"),
        ({"logger": 3}, "trainer.logger: expected {class_path, init_args}"),
    ],
)
def test_what_cannot_work_is_told_before_anything_runs(options, message):
    with pytest.raises(UserError) as told:
        check_trainer_options(options)
    assert message in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"logger": {"class_path": "CSVLoger"}}, "CSVLoger"),
        ({"logger": {"class_path": "CSVLogger", "init_args": {"save_dirr": "x"}}}, "save_dirr"),
        ({"logger": [{"class_path": "lightning.pytorch.callbacks.Timer"}]}, "trainer.logger.0: "),
        ({"callbacks": [{"class_path": "nothere.Mine"}]}, "No module named 'nothere'"),
        ({"callbacks": [{"init_args": {}}]}, "trainer.callbacks.0: expected class_path"),
        ({"profiler": "quick"}, "trainer.profiler: "),
    ],
)
def test_wrong_classes_are_one_sentence(options, message, tmp_path):
    with pytest.raises(UserError) as told:
        trainer_arguments(options, tmp_path, "x")
    assert message in str(told.value) and "\n" not in str(told.value)


def test_in_a_config(tmp_path):
    (tmp_path / "t.yaml").write_text("trainer: {logger: {class_path: CSVLogger}, profiler: simple}")
    cfg = load_config(["preset/smoke.yaml", str(tmp_path / "t.yaml")], ["--trainer.profiler", "null"])
    assert cfg.trainer == {"logger": {"class_path": "CSVLogger"}, "profiler": None}
    with pytest.raises(UserError, match="phases.NAME.steps"):
        load_config(["preset/smoke.yaml"], ["--trainer.max_epochs", "3"])


def test_only_what_may_change_the_result_decides_it():
    watching = {
        "logger": {"class_path": "CSVLogger"},
        "profiler": "simple",
        "enable_progress_bar": True,
        "precision": 32,
    }
    assert decides_result(watching) == {}
    assert decides_result({"deterministic": True}) == {"deterministic": True}
    own = {"callbacks": [{"class_path": "mine.Swa"}, {"class_path": "lightning.pytorch.callbacks.Timer"}]}
    assert callback_modules(own) == {"mine"}
