"""Runs the stages in order, hands over, skips what is done, goes on where a run stopped.

Each stage leaves RUN/checkpoints/<stage>.pt with a key: a hash of all that decides its result, the key of the stages before it
included. A stage whose file has the right key is not run again; a training stage that was interrupted goes on from <stage>.ckpt.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import resource
import time
from functools import partial
from pathlib import Path
from typing import Any, Callable, Optional

import torch

from p2gs.config import RunConfig, save_config
from p2gs.data.views import TrainingViews
from p2gs.models import handover
from p2gs.models.articulation import ArticulationPhase
from p2gs.models.canonical_fusion import CanonicalFusionPhase
from p2gs.models.diagnosis import StageResults
from p2gs.models.discovery.evidence import DepthStack, StateEvidence
from p2gs.models.evidence import gather_evidence
from p2gs.models.finish import finish
from p2gs.models.health import check_result
from p2gs.models.openings import open_up
from p2gs.models.owners import hidden_to_owners
from p2gs.models.part_motions import find_part_motions
from p2gs.models.phase import Phase
from p2gs.models.registered import REGISTRATION, correct_scene, register_state, register_views, write_registration
from p2gs.models.registration import align_states
from p2gs.models.sealed import Damaged, check_seal
from p2gs.models.sharpen import SharpenPhase
from p2gs.models.single_state import SingleStatePhase
from p2gs.models.slots import merge_to, slot_report
from p2gs.native import keep_memory
from p2gs.run_lock import locked
from p2gs.side_stage import SideStage, can_run_beside
from p2gs.stage_times import note_stage
from p2gs.stopping import at_step_ends
from p2gs.types import ArticulatedObject, TwoStateScene, UserError

STAGES = ("single_state", "registration", "discovery", "sharpen", "canonical_fusion", "articulation", "finish")


def run(cfg: RunConfig, only: Optional[str] = None) -> Path:
    """All stages of a run, or the one named ``only`` (anew; those before it must be there). Returns the result folder."""
    pipeline = Pipeline(cfg)
    with locked(cfg.run_dir):
        return pipeline.run(only)


class Pipeline:
    """One run: its scene, its views, its stages."""

    def __init__(self, cfg: RunConfig):
        self.cfg = cfg
        self.run_dir = cfg.run_dir
        self.device = pick_device(cfg.device)
        keep_memory()
        if cfg.threads:
            torch.set_num_threads(cfg.threads)
        missing = [name for name in STAGES if name not in cfg.phases]
        if missing:
            raise UserError(
                f"phases.{missing[0]} is not in the config; expected all of {', '.join(STAGES)} (start from -c configs/preset/cpu.yaml)"
            )
        self.init = cfg.phases["articulation"].config.init
        if self.init != "discovery" and cfg.num_parts == "auto":
            raise UserError(f"num_parts: auto needs phases.articulation.init: discovery (it is '{self.init}'); give --num_parts N")
        self._views: dict[int, TrainingViews] = {}
        self._registered: Optional[TwoStateScene] = None
        self.times: dict[str, dict] = {}

    # -- what stages share ----------------------------------------------------------------------------------------------------
    @property
    def scene(self) -> TwoStateScene:
        """As read, until the end state is registered to the start; from then on with the end's views in the start's frame."""
        return self._registered or self.cfg.data.scene()

    @property
    def views(self) -> dict[int, TrainingViews]:
        """Training views of both states."""
        return {state: self.views_of(state) for state in (0, 1)}

    def views_of(self, state: int) -> TrainingViews:
        """Training views of a state, at every size a stage asks for; made once."""
        if state not in self._views:
            views = self.scene.select(state=state, split="train")
            if not views:
                raise UserError(f"{self.scene.name}: there are no training views of state {state}; expected photographs of both states")
            self._views[state] = TrainingViews(views, sorted(set().union(*(_levels(self.cfg.phases[name].config) for name in STAGES))))
        return self._views[state]

    def key(self, stage: str) -> str:
        """Hash of all that decides a stage's result."""
        cfg = self.cfg
        common = {n: cfg.section(n) for n in ("seed", "num_parts", "rasterizer")} | {
            "data": cfg.section("data"),
            "device": self.device.type,
        }
        if stage.startswith("single_state") or stage == "registration":
            del common["num_parts"]
        elif self.exact:  # discovery finds what there is; later stages take it to the number that was asked for
            early = stage == "discovery" or stage.startswith("sharpen")
            common |= {"num_parts": "auto"} if early else {"exact_parts": True}
        chain = [common]
        for name in STAGES:
            if name == "discovery" and self.init != "discovery":
                continue
            chain.append({name: cfg.section(name)})
            if stage.startswith(name):
                break
        return hashlib.sha256(json.dumps([stage, chain], sort_keys=True, default=str).encode()).hexdigest()[:16]

    @property
    def exact(self) -> bool:
        """Whether ``num_parts`` is the number of slots beside discovery, not a limit for it."""
        return self.cfg.exact_parts and self.init == "discovery"

    def file(self, stage: str) -> Path:
        return self.run_dir / "checkpoints" / f"{stage}.pt"

    def done(self, stage: str) -> Any:
        """The stage's result, or None when it is not there or of another config."""
        if not self.file(stage).exists():
            return None
        try:
            value, header = handover.load(self.file(stage))
        except Damaged as err:
            print(f"{stage}: {self.file(stage)} is damaged ({err}) and put aside; this stage runs again", flush=True)
            self.file(stage).replace(self.file(stage).with_suffix(".damaged"))
            return None
        if stage == "finish" and not (self.run_dir / "twin.json").exists():
            return None
        return value if header.get("key") == self.key(stage) else None

    # -- the order ------------------------------------------------------------------------------------------------------------
    def run(self, only: Optional[str] = None) -> Path:
        self.run_dir.mkdir(parents=True, exist_ok=True)
        save_config(self.cfg, self.run_dir / "config.yaml")
        states = self.single_states(only)
        if only == "single_state":
            return self.run_dir
        self.correct(states)
        found = self.stage("registration", only, lambda: self.align(states))
        if only == "registration":
            return self.run_dir
        states = self.register(states, found)
        motions = self.stage("discovery", only, lambda: self.discover(states)) if self.init == "discovery" else None
        if only == "discovery":
            return self.run_dir
        found_in = states
        states = [self.stage(name := f"sharpen_{s.state}", only, partial(self.train, name, partial(self.sharpen, s))) for s in states]
        if only == "sharpen":
            return self.run_dir
        if self.exact:
            motions, notes = merge_to(motions, found_in, self.cfg.num_parts)
            for note in notes:
                print(note, flush=True)
        fuse = partial(self.fusion, found_in, states, motions)
        canonical = self.stage("canonical_fusion", only, partial(self.train, "canonical_fusion", fuse))
        if only == "canonical_fusion":
            return self.run_dir
        learned = self.stage(
            "articulation", only, partial(self.train, "articulation", partial(self.articulate, canonical, states, motions))
        )
        if only == "articulation":
            return self.run_dir
        self.stage("finish", only, lambda: self.write(learned, found_in, states, canonical, motions))
        return self.run_dir

    def stage(self, name: str, only: Optional[str], make: Callable[[], Any]) -> Any:
        """The result of a stage: from its file, or made and saved now."""
        wanted = only is not None and name.startswith(only)
        value = self.done(name)
        if value is not None and not wanted:
            print(f"{name}: done before, unchanged", flush=True)
            return value
        if only is not None and not wanted:
            raise UserError(f"--only {only}: the stage '{name}' before it is not there or its config has changed; run without --only first")
        began = time.perf_counter()
        value = make()
        seconds = time.perf_counter() - began
        self.keep(name, value)
        self.note_time(name, seconds)
        return value

    def keep(self, name: str, value: Any) -> None:
        """Save a stage's result; what it would have gone on from is not needed any more."""
        check_result(name, value)
        handover.save(value, self.file(name), key=self.key(name))
        (self.run_dir / "checkpoints" / f"{name}.ckpt").unlink(missing_ok=True)

    def note_time(self, name: str, seconds: float, beside: Optional[str] = None) -> None:
        """Keep and tell a stage's seconds and peak memory. beside: the stage that ran at the same time, this one in another process."""
        peak = resource.getrusage(resource.RUSAGE_CHILDREN if beside else resource.RUSAGE_SELF).ru_maxrss // 1024
        note_stage(self.run_dir, name, seconds, peak, beside)
        print(f"{name}: {seconds:.1f} s, peak memory {peak} MiB", flush=True)

    # -- stages ---------------------------------------------------------------------------------------------------------------
    @property
    def backend(self) -> str:
        """What draws from sharpening to the last polish."""
        return self.cfg.phases["sharpen"].config.backend(self.cfg.rasterizer)

    def common(self) -> dict:
        return {"seed": self.cfg.seed, "rasterizer": self.backend}

    def single_states(self, only: Optional[str]) -> list[handover.StateGaussians]:
        """Both states, at once where there are threads for it. Each has half of the threads then, also when it is the only one left to
        do: a run that was interrupted ends as it would have.
        """
        names, threads = ["single_state_0", "single_state_1"], torch.get_num_threads()
        beside = can_run_beside(self.cfg, self.device)
        torch.set_num_threads(threads // 2 if beside else threads)
        try:
            anew = only == "single_state" or (only is None and all(self.done(name) is None for name in names))
            if not (beside and anew):
                return [self.stage(name, only, partial(self.train_state, name)) for name in names]
            self.views_of(0)  # a scene that is generated when it is first read is written once
            with SideStage(self.run_dir, names[1], threads // 2) as other:
                first = self.stage(names[0], only, partial(self.train_state, names[0]))
                seconds = other.wait()
            self.note_time(names[1], seconds, beside=names[0])
            return [first, self.done(names[1])]
        finally:
            torch.set_num_threads(threads)

    def train_state(self, name: str) -> handover.StateGaussians:
        return self.train(name, partial(self.single_state, int(name[-1])))

    def train_alone(self, name: str) -> None:
        """A single state's stage and nothing else, for the process beside a run: the result is kept, the run itself notes its time."""
        self.keep(name, self.train_state(name))

    def single_state(self, state: int, section) -> Phase:
        options = {"seed": self.cfg.seed, "rasterizer": self.cfg.rasterizer}
        return SingleStatePhase(section.config, section.losses, self.scene, state, self.views_of(state), **options)

    def correct(self, states) -> None:
        """Scene and views from here on: cameras and exposures of training photographs as the single states found them."""
        self.take(correct_scene(self.cfg.data.scene(), states))

    def take(self, scene: TwoStateScene) -> None:
        """The scene from here on, where it is another one."""
        if scene is not self.scene:
            self._registered = scene
            self._views.clear()

    def align(self, states) -> handover.Registration:
        config = self.cfg.phases["registration"].config
        say = partial(print, "registration:", flush=True)
        return align_states(states, self.evidence(states), self.views, self.scene.box, config, self.cfg.rasterizer, say)

    def register(self, states, found: handover.Registration) -> list[handover.StateGaussians]:
        """The states in the start's frame; so are scene and views from here on."""
        write_registration(self.run_dir / REGISTRATION, found, states, self.cfg.data.scene())
        self.take(register_views(self.scene, found))
        return [register_state(s, found) for s in states]

    def discover(self, states) -> handover.PartMotions:
        return find_part_motions(
            states,
            self.scene,
            self.views,
            "auto" if self.exact else self.cfg.num_parts,
            self.cfg.phases["discovery"].config,
            seed=self.cfg.seed,
            backend=self.cfg.rasterizer,
            device=self.device,
            report=lambda *text: print("discovery:", *text, flush=True),
        )

    def sharpen(self, state, section) -> Phase:
        return SharpenPhase(section.config, section.losses, state, self.views_of(state.state), **self.common())

    def fusion(self, found_in, states, motions, section) -> Phase:
        """found_in: the states before they were sharpened: an overfitted lid explains noise that no wall behind it does."""
        stacks, counted = None, {}
        if motions is not None and len(motions) and section.config.canonical.free_space > 0:
            backend = {"backend": self.cfg.rasterizer, "device": self.device}
            stacks = [DepthStack(e.depths, e.alphas, e.cameras) for e in self.evidence(found_in)]
            if section.config.owners:
                motions, counted["owners"] = hidden_to_owners(found_in, motions, stacks, **backend)
            train = self.scene.select(split="train")
            told = any(v.depth is not None for v in train)  # where depth is given nothing is open
            if section.config.openings.may_lose > 0 and not told:
                openings, motions, stacks, lids = open_up(found_in, motions, self.views, stacks, section.config.openings, **backend)
                states = [opening.of(s) for opening, s in zip(openings, states, strict=True)]
                counted["openings"] = lids
                gone, come = (sum(c[k] for c in lids) for k in ("removed", "added"))
                print(f"canonical_fusion: {gone} Gaussians before openings gave way to {come} on the walls behind them", flush=True)
        known = None if self.cfg.num_parts == "auto" else self.cfg.num_parts
        options = {"stacks": stacks, "counted": counted, "num_parts": known, **self.common()}
        return CanonicalFusionPhase(section.config, section.losses, states, motions, self.views, **options)

    def evidence(self, states) -> list[StateEvidence]:
        """What discovery looks at of each state."""
        found, options = self.cfg.phases["discovery"].config, {"backend": self.cfg.rasterizer, "device": self.device}
        train = [self.scene.select(state=s.state, split="train") for s in states]
        size = (found.evidence_size, found.min_opacity)
        return [gather_evidence(s.gaussians, v, *size, **options) for s, v in zip(states, train, strict=True)]

    def articulate(self, canonical, states, motions, section) -> Phase:
        extent = float((self.scene.box[1] - self.scene.box[0]).norm())
        parts = len(motions) + 1 if motions is not None and not self.exact else self.cfg.num_parts
        return ArticulationPhase(section.config, section.losses, canonical, states, motions, parts, extent, self.views, **self.common())

    def train(self, stage: str, build: Callable[[Any], Phase]) -> Any:
        """One training phase with a Trainer of its own."""
        from lightning.pytorch import Trainer, seed_everything
        from lightning.pytorch.loggers import TensorBoardLogger
        from lightning.pytorch.plugins.environments import LightningEnvironment

        section = self.cfg.phases[next(n for n in STAGES if stage.startswith(n))]
        seed_everything(self.cfg.seed, verbose=False)
        phase = build(section)
        phase.phase_name = stage
        key = self.key(stage)
        phase.save_hyperparameters({"stage": stage, "key": key})
        callbacks = section.new_callbacks()
        for callback in callbacks.values():
            callback.prepare(self.cfg, self.scene)
        order = sorted(callbacks, key=lambda n: (not callbacks[n].changes_result, n == "checkpoint"))
        if phase.total_steps <= 0:
            return phase.hand_over()
        trainer = Trainer(
            max_steps=phase.total_steps,
            max_epochs=-1,
            accelerator="gpu" if self.device.type == "cuda" else "cpu",
            devices=1,
            logger=TensorBoardLogger(self.run_dir / "logs", name=stage, version="", default_hp_metric=False),
            callbacks=[callbacks[n] for n in order],
            default_root_dir=self.run_dir,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
            num_sanity_val_steps=0,
            plugins=[LightningEnvironment()],  # on SLURM, too: a run is one process, and resumes from its own checkpoints alone
        )
        with at_step_ends():
            trainer.fit(phase, ckpt_path=self.resumable(stage, key), weights_only=True)
        if trainer.global_step < phase.total_steps:
            raise KeyboardInterrupt
        return phase.cpu().hand_over()

    def resumable(self, stage: str, key: str) -> Optional[str]:
        """The training state an interrupted stage goes on from, when it is of this very config."""
        path = self.run_dir / "checkpoints" / f"{stage}.ckpt"
        if not path.exists():
            return None
        try:
            check_seal(path)
            stored = torch.load(path, weights_only=True)["hyper_parameters"]
        except OSError:
            raise
        except Exception as err:
            print(f"{stage}: {path} is damaged ({err}); starting this stage anew", flush=True)
            return None
        if stored.get("key") != key:
            return None
        print(f"{stage}: going on from {path}", flush=True)
        return str(path)

    def write(self, learned: handover.Articulation, found_in, states, canonical, motions) -> dict:
        """The twin and the result folder; returns what a later run needs to know of it. found_in: the states before they were sharpened."""
        from p2gs.export.contents import in_trays
        from p2gs.export.diagnostics_page import write_diagnosis
        from p2gs.export.run_folder import complete_run, write_twin

        config, device = self.cfg.phases["finish"].config, self.device
        obj, notes, record = finish(
            learned,
            states,
            self.views,
            config,
            self.scene.similarity,
            self.cfg.phases["articulation"].losses,
            seed=self.cfg.seed,
            backend=self.backend,
            twin_backend=self.cfg.rasterizer,
            contents=in_trays,
            device=device,
        )
        for note in notes:
            print(note, flush=True)
        stages = StageResults(found_in, motions, states, canonical, learned, record, notes)
        options = {"min_margin": config.unclear, "backend": self.backend, "twin_backend": self.cfg.rasterizer, "device": device}
        write_diagnosis(self.run_dir, stages, obj, self.views, **options)
        write_twin(obj, self.run_dir, self.scene)
        if self.exact:
            report = slot_report(learned, obj, record.slots, len(motions))
            (self.run_dir / "slots.json").write_text(json.dumps(report, indent=1) + "\n")
        if config.exports:
            complete_run(self.run_dir, config.exports, log=partial(print, flush=True))
        joints = [e.as_dict() for e in record.evidence]
        return {"parts": len(obj.parts), "notes": notes, "joints": joints}


def pick_device(name: str) -> torch.device:
    """Raises UserError when CUDA is asked for and is not there."""
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device: cuda was asked for, but torch sees no CUDA device; use --device cpu or auto")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def _levels(config: Any) -> set[int]:
    """Every image size named in a config or in the configs inside it."""
    sizes = set(getattr(config, "levels", ()))
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            sizes |= _levels(value)
    return sizes


def load_twin(run_dir: Path | str) -> ArticulatedObject:
    """The twin of a result folder, in input coordinates."""
    from p2gs.export.twin_json import load_twin as load

    return load(Path(run_dir))
