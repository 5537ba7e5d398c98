"""Runs the stages in order, hands over, skips what is done, goes on where a run stopped.

Each stage leaves RUN/checkpoints/<stage>.pt with a key: a hash of all that decides its result (``runtime.keys``). A
stage whose file has the right key is not run again; a training stage that was interrupted goes on from <stage>.ckpt.
"""

from __future__ import annotations

import resource
import time
from functools import partial
from pathlib import Path
from typing import Any, Callable, Optional

import torch

from p2gs.config.run import RunConfig, save_config
from p2gs.context import RunContext
from p2gs.data.views import TrainingViews
from p2gs.gaussians import handover
from p2gs.gaussians.sealed import Damaged
from p2gs.models.health import check_result, section_of_stage
from p2gs.models.stage import Stage
from p2gs.native import keep_memory
from p2gs.run_lock import locked
from p2gs.runtime.keys import StageKeys, changes
from p2gs.runtime.order import stage_order
from p2gs.runtime.side_stage import SideStage, can_run_beside
from p2gs.runtime.training import train
from p2gs.stage_times import note_stage
from p2gs.types import ArticulatedObject, TwoStateScene, UserError


def run(cfg: RunConfig, only: Optional[str] = None, keep_stale: bool = False) -> Path:
    """All stages of a run, or the one named ``only`` (anew; those before it must be there). Returns the result folder.

    keep_stale: results that other options, code or photographs made are used as they are.
    """
    pipeline = Pipeline(cfg, keep_stale)
    with locked(cfg.run_dir):
        return pipeline.run(only)


class Pipeline:
    """One run and its stages."""

    def __init__(self, cfg: RunConfig, keep_stale: bool = False):
        self.cfg, self.keep_stale = cfg, keep_stale
        self.run_dir = cfg.run_dir
        self.device = pick_device(cfg.device)
        keep_memory()
        if cfg.threads:
            torch.set_num_threads(cfg.threads)
        self.context = RunContext(cfg, self.device)
        self.order = stage_order(self.context)
        init = self.context.init
        if "articulation" in self.order and init != "discovery" and cfg.num_parts == "auto":
            needs = f"needs phases.articulation.init: discovery (it is '{init}')"
            raise UserError(f"num_parts: auto {needs}; give --num_parts N")
        self.keys = StageKeys(self.context, self.order)
        self._told: set[str] = set()

    @property
    def scene(self) -> TwoStateScene:
        return self.context.scene

    @property
    def views(self) -> dict[int, TrainingViews]:
        return self.context.views

    # -- results in files ---------------------------------------------------------------------------------------------
    def file(self, stage: str) -> Path:
        return self.run_dir / "checkpoints" / f"{stage}.pt"

    def done(self, stage: str) -> Any:
        """The stage's result, or None when it is not there or something that decides it has changed, which is told
        once."""
        if not self.file(stage).exists():
            return None
        name = self.phase_of(stage)
        try:
            value, header = handover.load(self.file(stage))
        except Damaged as err:
            print(f"{stage}: {self.file(stage)} is damaged ({err}) and put aside; this stage runs again", flush=True)
            self.file(stage).replace(self.file(stage).with_suffix(".damaged"))
            return None
        if not self.order[name].complete(self.context):
            return None
        if header.get("key") == self.keys.key(name):
            return value
        differ = "an earlier version made it"
        if "made_of" in header:
            differ = changes(header["made_of"], self.keys.parts(name))
        if stage not in self._told:
            print(f"{stage}: {'kept, though' if self.keep_stale else 'runs again:'} {differ}", flush=True)
            self._told.add(stage)
        return value if self.keep_stale else None

    def phase_of(self, stage: str) -> str:
        """``single_state`` of ``single_state_0``."""
        return stage if stage in self.order else section_of_stage(stage)

    def keep(self, stage: str, value: Any) -> None:
        """Save a stage's result; what it would have gone on from is not needed any more."""
        check_result(stage, value)
        name = self.phase_of(stage)
        handover.save(value, self.file(stage), key=self.keys.key(name), made_of=self.keys.parts(name))
        (self.run_dir / "checkpoints" / f"{stage}.ckpt").unlink(missing_ok=True)

    def note_time(self, stage: str, seconds: float, beside: Optional[str] = None) -> None:
        """Keep and tell a stage's seconds and peak memory. beside: the stage that ran at the same time, this one in
        another process."""
        peak = resource.getrusage(resource.RUSAGE_CHILDREN if beside else resource.RUSAGE_SELF).ru_maxrss // 1024
        note_stage(self.run_dir, stage, seconds, peak, beside)
        print(f"{stage}: {seconds:.1f} s, peak memory {peak} MiB", flush=True)

    # -- the order ----------------------------------------------------------------------------------------------------
    def run(self, only: Optional[str] = None) -> Path:
        self.run_dir.mkdir(parents=True, exist_ok=True)
        save_config(self.cfg, self.run_dir / "config.yaml")
        _ = self.scene  # a scene that is generated when it is first read has files from here on
        handed: dict[str, Any] = {}
        for name, phase in self.order.items():
            if not phase.wanted(self.context):
                handed.setdefault(phase.gives, None)
                continue
            given = {what: handed.get(what) for what in (*phase.needs, *phase.uses)}
            value = self.results(name, phase, given, only)
            handed |= phase.hand_on(self.context, value, **given)
            if only == name:
                break
        return self.run_dir

    def results(self, name: str, phase: type[Stage], given: dict, only: Optional[str]) -> Any:
        """The result of a phase; of one that runs once for each state the list of both."""
        if not phase.each_state:
            return self.stage(name, only, partial(self.make, name, given))
        if not given and phase.trained:
            return self.both_states(name, only)
        stages = {f"{name}_{s}": {**given, "state": s} for s in (0, 1)}
        return [self.stage(stage, only, partial(self.make, stage, what)) for stage, what in stages.items()]

    def stage(self, stage: str, only: Optional[str], make: Callable[[], Any]) -> Any:
        """The result of a stage: from its file, or made and saved now."""
        wanted = only is not None and self.phase_of(stage) == only
        value = None if wanted else self.done(stage)
        if value is not None:
            print(f"{stage}: done before{'' if stage in self._told else ', unchanged'}", flush=True)
            return value
        if only is not None and not wanted:
            why = "is not there, or what makes it has changed"
            raise UserError(f"--only {only}: the stage '{stage}' before it {why}; run without --only first")
        began = time.perf_counter()
        value = make()
        seconds = time.perf_counter() - began
        self.keep(stage, value)
        self.note_time(stage, seconds)
        return value

    def make(self, stage: str, given: dict) -> Any:
        """Train or compute a stage. given: what its phase's ``build`` or ``compute`` takes."""
        name = self.phase_of(stage)
        phase, section = self.order[name], self.cfg.phases[name]
        if phase.trained:
            return train(self.context, phase, stage, section, self.keys.key(name), given)
        return phase.compute(self.context, section, **given)

    def both_states(self, name: str, only: Optional[str]) -> list[Any]:
        """A phase that needs nothing, for both states, at once where there are threads for it. Each has half of the
        threads then, also when it is the only one left to do: a run that was interrupted ends as it would have.
        """
        stages, threads = [f"{name}_0", f"{name}_1"], torch.get_num_threads()
        made = [partial(self.make, stage, {"state": s}) for s, stage in enumerate(stages)]
        beside = can_run_beside(self.cfg, self.device, name)
        torch.set_num_threads(threads // 2 if beside else threads)
        try:
            anew = only == name or (only is None and all(self.done(stage) is None for stage in stages))
            if not (beside and anew):
                return [self.stage(stage, only, make) for stage, make in zip(stages, made, strict=True)]
            with SideStage(self.run_dir, stages[1], threads // 2) as other:
                first = self.stage(stages[0], only, made[0])
                seconds = other.wait()
            self.note_time(stages[1], seconds, beside=stages[0])
            return [first, self.done(stages[1])]
        finally:
            torch.set_num_threads(threads)

    def train_alone(self, stage: str) -> None:
        """A single state's stage and nothing else, for the process beside a run: the result is kept, the run itself
        notes its time."""
        _ = self.scene
        self.keep(stage, self.make(stage, {"state": int(stage[-1])}))


def pick_device(name: str) -> torch.device:
    """Raises UserError when CUDA is asked for and is not there."""
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device: cuda was asked for, but torch sees no CUDA device; use --device cpu or auto")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def load_twin(run_dir: Path | str) -> ArticulatedObject:
    """The twin of a result folder, in input coordinates."""
    from p2gs.gaussians.twin_json import load_twin as load

    return load(Path(run_dir))
