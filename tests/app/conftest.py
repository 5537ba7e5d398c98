"""Fake phases, losses, callbacks and data in place of the real ones: the config system is tested on its own."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

import pytest


@dataclass
class Rates:
    means: float = 1e-3
    quats: float = 2e-3


@dataclass
class FirstConfig:
    steps: int = 100
    levels: list[int] = field(default_factory=lambda: [100, 200])
    init: Literal["auto", "random"] = "auto"
    rates: Rates = field(default_factory=Rates)
    extra: Optional[Rates] = None


@dataclass
class SecondConfig:
    steps: int = 200
    parts: bool = True


@pytest.fixture
def fakes(monkeypatch):
    """Registries filled with: losses render, part, contact; callbacks progress, count; phases first, second; data
    folder, made."""
    from p2gs.callbacks.base import CALLBACKS, Callback, register_callback
    from p2gs.config import run as config
    from p2gs.data.base import DATASETS
    from p2gs.losses.base import LOSSES, Loss, register_loss
    from p2gs.models.phase import PHASES

    for registry in (LOSSES, CALLBACKS, PHASES, DATASETS):
        monkeypatch.setattr(registry, "_items", {})
    monkeypatch.setattr(config, "import_builtins", lambda: None)
    monkeypatch.delenv("P2GS_PLUGINS", raising=False)

    @register_loss("render")
    class Render(Loss):
        ssim: float = 0.2

    @register_loss("part")
    class Part(Loss):
        temperature: float = 1.0
        variant: Literal["paper", "sane"] = "sane"

    @register_loss("contact")
    class Contact(Loss):
        pass

    @register_callback("progress")
    class Progress(Callback):
        changes_result = False
        every: int = 10
        style: str = "line"

    @register_callback("count")
    class Count(Callback):
        top: int = 5

    class First:
        Config = FirstConfig

    class Second:
        Config = SecondConfig

    class Untrained:
        Config = Rates
        trained = False

    PHASES.register("untrained")(Untrained)
    PHASES.register("first")(First)
    PHASES.register("second")(Second)

    class Folder:
        def __init__(self, root: str, downscale: float = 1.0, views: Optional[int] = None):
            self.root, self.downscale, self.views = root, downscale, views

    class Made:
        def __init__(self, kind: str = "cabinet", size: int = 100, views: Optional[int] = None):
            self.kind, self.size, self.views = kind, size, views

    DATASETS.register("folder")(Folder)
    DATASETS.register("made")(Made)


@pytest.fixture
def write(tmp_path):
    """``write("a.yaml", text)`` -> path as text."""

    def writer(name: str, text: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return str(path)

    return writer


@pytest.fixture
def repository() -> Path:
    return Path(__file__).parents[2]
