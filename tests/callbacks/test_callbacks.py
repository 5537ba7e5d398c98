"""Built-in callbacks on a tiny phase that fits a vector: what they write, when, and that none of them changes the
result."""

import json
import time
import warnings
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from p2gs.callbacks.base import CALLBACKS, Callback, due, register_callback, silence_lightning
from p2gs.callbacks.checkpoint import Checkpoint, checkpoint_path, save_atomically
from p2gs.callbacks.evaluation import Evaluation
from p2gs.callbacks.previews import Previews
from p2gs.callbacks.progress import Progress, duration, status_line
from p2gs.callbacks.tensorboard import Images, Scalars
from p2gs.gaussians.sealed import check_seal


class TinyPhase(LightningModule):
    """A phase as callbacks see it: one manual optimiser step a batch."""

    phase_name = "tiny"

    def __init__(self, total_steps: int = 10, seconds: float = 0.0):
        super().__init__()
        self.automatic_optimization = False
        self.x = torch.nn.Parameter(torch.full((3,), 4.0))
        self.total_steps, self.seconds, self.scalars, self.num_gaussians = total_steps, seconds, {}, 1234

    @property
    def step(self):
        return self.global_step

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)

    def train_dataloader(self):
        return torch.utils.data.DataLoader(range(1000), batch_size=None)

    def training_step(self, batch, batch_idx):
        time.sleep(self.seconds)
        loss = (self.x**2).sum()
        optimizer = self.optimizers()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        self.scalars = {"loss/render": loss.detach(), "loss/total": loss.detach()}

    def preview(self, times):
        return {f"tiny_{t:g}": torch.full((4, 6, 3), int(100 * t), dtype=torch.uint8) for t in times}

    def summary(self):
        return {"part_mass/0": 0.25}


def train(tmp_path, *callbacks, steps=10, phase=None, logger=False, ckpt_path=None):
    silence_lightning()
    phase = phase or TinyPhase(steps)
    trainer = Trainer(
        max_steps=steps,
        callbacks=list(callbacks),
        logger=TensorBoardLogger(tmp_path, name="logs", version="") if logger else False,
        default_root_dir=tmp_path,
        accelerator="cpu",
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(phase, ckpt_path=ckpt_path)
    return phase


def events(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    accumulator = EventAccumulator(str(tmp_path / "logs"))
    accumulator.Reload()
    return accumulator


def test_due():
    assert [s for s in range(11) if due(s, 4, 10)] == [4, 8, 10]
    assert [s for s in range(11) if due(s, 0, 10)] == [10]


def test_register_makes_a_dataclass_that_lightning_takes(tmp_path, monkeypatch):
    monkeypatch.setattr(CALLBACKS, "_items", {})

    @register_callback("count")
    class Count(Callback):
        every: int = 3

        def __post_init__(self):
            self.seen = []

        def on_step(self, trainer, phase):
            if phase.step % self.every == 0:
                self.seen.append(phase.step)

    count = CALLBACKS["count"](every=4)
    train(tmp_path, count, CALLBACKS["count"]())  # two of one kind are allowed
    assert count.seen == [4, 8] and Count().every == 3 and hash(count)


def test_no_builtin_that_watches_changes_the_result(tmp_path):
    plain = train(tmp_path / "a")
    watched = train(
        tmp_path / "b",
        Progress(),
        Scalars(every=2),
        Images(every=5),
        Previews(every=5),
        Checkpoint(every=3),
        Evaluation(),
        logger=True,
    )
    assert torch.equal(plain.x, watched.x)
    for name in ("progress", "scalars", "images", "previews", "checkpoint", "evaluation"):
        assert CALLBACKS[name].changes_result is False
    assert Callback.changes_result is True


def test_scalars_and_images_reach_tensorboard(tmp_path):
    train(tmp_path, Scalars(every=4), Images(every=5, times=[0.0, 1.0]), logger=True)
    log = events(tmp_path)
    entries = log.Scalars("tiny/loss/render")
    assert [e.step for e in entries] == [4, 8, 10]
    assert entries[0].value > entries[-1].value > 0
    assert log.Scalars("tiny/gaussians")[0].value == 1234 and log.Scalars("tiny/part_mass/0")[0].value == 0.25
    assert [e.step for e in log.Images("tiny_1")] == [5, 10]
    assert (log.Images("tiny_0")[0].width, log.Images("tiny_0")[0].height) == (6, 4)


def test_without_a_logger_nothing_is_written_and_nothing_breaks(tmp_path):
    train(tmp_path, Scalars(every=1), Images(every=1), Evaluation(every=1))
    assert not (tmp_path / "logs").exists()


def test_previews_are_png_files_in_rgb(tmp_path):
    import cv2

    phase = TinyPhase()
    phase.preview = lambda times: {"a/b": torch.tensor([255, 10, 0], dtype=torch.uint8).expand(4, 6, 3)}
    train(tmp_path, Previews(), phase=phase)
    (path,) = (tmp_path / "media" / "previews").iterdir()
    assert path.name == "a_b.png" and cv2.imread(str(path))[0, 0].tolist() == [0, 10, 255]  # OpenCV reads BGR
    train(tmp_path / "kept", Previews(every=5, keep=True))
    assert len(list((tmp_path / "kept" / "media" / "previews").iterdir())) == 6


def test_resuming_from_a_checkpoint_gives_the_same_result(tmp_path):
    whole = train(tmp_path / "whole", steps=10)

    class Stop(Callback):
        def on_step(self, trainer, phase):
            if phase.step == 7:
                raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        train(tmp_path / "cut", Checkpoint(every=3), Stop())
    path = checkpoint_path(tmp_path / "cut", "tiny")
    assert torch.load(path, weights_only=True)["global_step"] == 6
    resumed = train(tmp_path / "cut", Checkpoint(every=3), ckpt_path=path)
    assert torch.equal(whole.x, resumed.x) and resumed.step == 10
    assert torch.load(path, weights_only=True)["global_step"] == 10
    assert [p.name for p in path.parent.iterdir()] == ["tiny.ckpt"]


def test_a_kill_while_saving_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "checkpoints" / "x.ckpt"
    save_atomically(SimpleNamespace(save_checkpoint=lambda p: p.write_text("old")), path)

    def half(part):
        part.write_text("ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_atomically(SimpleNamespace(save_checkpoint=half), path)
    assert path.read_bytes().startswith(b"old")
    check_seal(path)


def test_status_line_and_duration():
    phase = SimpleNamespace(
        phase_name="articulation",
        step=250,
        total_steps=1000,
        num_gaussians=20345,
        scalars={"loss/total": torch.tensor(0.5), "loss/render": 0.125, "loss/part": torch.tensor(0.375)},
    )
    assert (
        status_line(phase, 50.0)
        == "articulation 250/1000  loss 0.5000  part 0.3750  render 0.1250  20,345 Gaussians  50/s  0:15 left"
    )
    assert "part" not in status_line(phase, 50.0, losses=0)
    assert duration(7.4) == "0:07" and duration(3723) == "1:02:03"


def test_progress_prints_plain_lines_where_there_is_no_terminal(tmp_path, capsys):
    train(tmp_path, Progress(plain_seconds=0.03), phase=TinyPhase(10, seconds=0.01))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 3 and all(line.startswith("tiny ") for line in lines)
    assert "left" in lines[0] and lines[-1].endswith("done") and lines[-1].startswith("tiny 10/10  loss ")
    assert "\x1b" not in "".join(lines)


def test_progress_draws_one_live_line_on_a_terminal(tmp_path, capsys, monkeypatch):
    import rich
    from rich.console import Console

    class Terminal:
        def __init__(self):
            self.text = ""

        def write(self, text):
            self.text += text

        def flush(self):
            pass

        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(rich, "_console", Console(file=terminal, force_terminal=True, width=120))
    monkeypatch.setattr("sys.stdout", terminal)
    progress = Progress(every_seconds=0.0)
    train(tmp_path, progress)
    assert "tiny 5/10" in terminal.text and "1,234 Gaussians" in terminal.text and progress._live is None
    assert terminal.text.rstrip().endswith("done")


def test_progress_restores_the_terminal_after_an_error(tmp_path, monkeypatch):
    class Break(Callback):
        def on_step(self, trainer, phase):
            raise RuntimeError("broken")

    progress = Progress()
    with pytest.raises(RuntimeError):
        train(tmp_path, progress, Break())
    assert progress._live is None


def test_lightning_is_silent(tmp_path, capfd):
    with warnings.catch_warnings():
        train(tmp_path, Checkpoint(), logger=True)
    out, err = capfd.readouterr()
    assert out == "" and err == ""


def test_evaluation_finds_ground_truth_and_logs_joint_errors(tmp_path):
    """A door that the phase has learned 1 degree short, in internal units of another scale and place than the
    input's."""
    import math

    from p2gs.gaussians.handover import Articulation
    from p2gs.types import GaussianTensors, Similarity

    truth = {"axis": {"o": [1.0, 0, 0], "d": [0, 0, 1]}, "type": "rotate", "rotate": {"l": 0, "r": 60}}
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "trans.json").write_text(json.dumps({"input": None, "trans_info": truth}))
    (tmp_path / "transforms_train_start.json").write_text("{}")
    similarity = Similarity(2.0, (0.5, 0.0, 0.0))
    a, hinge = math.radians(59), torch.tensor([1.0, 0, 0], dtype=torch.float64)  # internal: 2 * ((1, 0, 0) - centre)
    T = torch.eye(4, dtype=torch.float64)[None]
    T[0, :2, :2] = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    T[0, :3, 3] = hinge - T[0, :3, :3] @ hinge
    means = torch.rand(20, 3)
    g = GaussianTensors(means, torch.rand(20, 4), torch.zeros(20, 3), torch.ones(20), torch.zeros(20, 1, 3))
    learned = Articulation(g, torch.tensor([[0.2, 0.8]]).repeat(20, 1), ["free"], T, torch.ones(1), 0.5)
    phase = TinyPhase()
    phase.screws, phase.hand_over = None, lambda: learned
    evaluation = Evaluation(every=5)
    cfg = SimpleNamespace(
        data=SimpleNamespace(root=str(tmp_path)), data_options={"format": "artgs", "root": str(tmp_path)}
    )
    evaluation.prepare(cfg, SimpleNamespace(similarity=similarity))
    before = learned.transforms.clone()
    train(tmp_path / "run", evaluation, phase=phase, logger=True)
    log = events(tmp_path / "run")
    motion, angle = log.Scalars("tiny/error/1/motion"), log.Scalars("tiny/error/1/axis_angle")
    assert [e.step for e in motion] == [5, 10] and motion[0].value == pytest.approx(1.0, abs=1e-4)
    position = log.Scalars("tiny/error/1/axis_position")
    assert angle[0].value == pytest.approx(0.0, abs=1e-4) and position[0].value == pytest.approx(0, abs=1e-4)
    assert log.Scalars("tiny/error/failures")[0].value == 0
    assert torch.equal(before, learned.transforms)
    wrong = SimpleNamespace(data=SimpleNamespace(root=str(tmp_path / "empty")), data_options={"format": "artgs"})
    evaluation = Evaluation()
    evaluation.prepare(wrong, SimpleNamespace(similarity=similarity))
    assert evaluation._truth is None
