"""Options of a bench, as its YAML file has them (``plan``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional, Union

from p2gs.types import UserError


@dataclass
class Setting:
    """One row of a matrix. config: files laid on the bench's.  set: single options, ``{phases.articulation.steps:
    500}``.
    num_parts: a number, auto, or gt, gt+2, gt-1 (relative to the true number, static base counted); null: as the config
    says.
    """

    config: list[str] = field(default_factory=list)
    set: dict = field(default_factory=dict)  # no types inside: of Any jsonargparse would import a class that is named
    num_parts: Optional[Union[int, str]] = None


@dataclass
class SlurmOptions:
    """For executor: slurm. cluster: slurm, or submitit's local and debug executors.  jobs: at most so many at once (job
    array).
    extra: further options of submitit, such as {slurm_partition: gpu, slurm_account: me}.
    """

    cluster: Literal["slurm", "local", "debug"] = "slurm"
    minutes: int = 120
    cpus: int = 8
    memory_gb: float = 16
    gpus: int = 0
    jobs: int = 16
    extra: dict = field(default_factory=dict)


@dataclass
class RayOptions:
    """For executor: ray. address: of a running cluster, or null to start one on this machine.  cpus, gpus: of one
    run."""

    address: Optional[str] = None
    cpus: float = 2
    gpus: float = 0


@dataclass
class BenchOptions:
    """Options of a bench beside its settings; see ``plan``. export: formats written between fit and test (meshes are
    scored).

    format: of a data format of the user's own; every folder right below root is then a scene, named by its folder.
    preset: taken instead of the presets among ``config``, a name in configs/preset or a file; results go to a folder of
    their own.
    num_parts: of the settings that say nothing of it (the literal preset finds no number: gt).
    reuse: a run takes over finished stages of the same object and seed from the settings before it; stages whose config
    differs are run again, so the results are those of independent runs.  processes: runs at once (local).  threads: of
    one run, default the cores divided by the processes.  timeout_minutes: a longer run is stopped and counts as failed.
    """

    name: str = "bench"
    tables: list[str] = field(default_factory=list)
    out: Optional[str] = None
    root: str = "."
    objects: Optional[list[str]] = None
    format: Optional[str] = None
    config: list[str] = field(default_factory=lambda: ["preset/cpu.yaml"])
    preset: Optional[str] = None
    num_parts: Optional[Union[int, str]] = None
    set: dict = field(default_factory=dict)
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    export: list[str] = field(default_factory=lambda: ["ply"])
    reuse: bool = True
    executor: Literal["local", "slurm", "ray"] = "local"
    processes: int = 1
    threads: Optional[int] = None
    timeout_minutes: Optional[float] = None
    slurm: SlurmOptions = field(default_factory=SlurmOptions)
    ray: RayOptions = field(default_factory=RayOptions)

    def __post_init__(self):
        for name in ("processes", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UserError(f"{name}: expected at least 1, got {value}")
        if not self.seeds:
            raise UserError("seeds: expected at least one")

    @property
    def folder(self) -> Path:
        name = self.name if self.preset is None else f"{self.name}_{Path(self.preset).stem}"
        return Path(self.out) if self.out else Path("runs") / "bench" / name

    @property
    def base(self) -> list[str]:
        """The config files below every setting."""
        if self.preset is None:
            return self.config
        chosen = self.preset if "/" in self.preset or self.preset.endswith(".yaml") else f"preset/{self.preset}.yaml"
        return [chosen, *(name for name in self.config if not is_preset(name))]

    @property
    def presets(self) -> list[str]:
        """Names of the presets in use: what a table was made with."""
        return [Path(name).stem for name in self.base if is_preset(name) or name == self.preset]


def is_preset(name: str) -> bool:
    """Whether a config file is one of configs/preset."""
    return Path(name).parent.name == "preset"
