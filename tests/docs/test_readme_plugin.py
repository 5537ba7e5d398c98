"""The README's own loss, as a user has it: a file named by --plugins, and a module that an installed package
announces."""

import importlib.metadata

import pytest
import yaml
from docs_pages import REPOSITORY, blocks

from p2gs.cli import main

README = blocks(REPOSITORY / "README.md")


@pytest.fixture
def files(desk):
    (desk / "my_losses.py").write_text(next(b.text for b in README if b.kind == "python"))
    (desk / "mine.yaml").write_text(next(b.text for b in README if b.kind == "yaml"))
    return desk


def printed(capsys, *words) -> dict:
    assert main(["fit", "-c", "preset/cpu.yaml", "-c", "mine.yaml", *words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)


@pytest.mark.parametrize("name", ["my_losses", "my_losses.py"])
def test_by_plugins(files, capsys, name):
    config = printed(capsys, "--plugins", name)
    assert config["phases"]["single_state"]["losses"]["round"]["weight"] == 0.02
    assert config["phases"]["articulation"]["losses"]["round"] is None and config["plugins"] == [name]


def test_without_plugins_the_name_is_unknown(files, capsys):
    assert main(["fit", "-c", "preset/cpu.yaml", "-c", "mine.yaml", "--print_config"]) == 2
    assert "no option 'phases.single_state.losses.round'" in capsys.readouterr().err


def test_by_entry_point(files, capsys, monkeypatch):
    """The entry point is the one that docs/add_loss.md writes into pyproject.toml."""
    (toml,) = [b.text for b in blocks(REPOSITORY / "docs" / "add_loss.md") if b.kind == "toml"]
    head, line = toml.split("\n")[:2]
    assert head == '[project.entry-points."p2gs.plugins"]'
    name, value = (part.strip(' "') for part in line.split("="))
    point = importlib.metadata.EntryPoint(name, value, "p2gs.plugins")
    real = importlib.metadata.entry_points
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda **k: [point] if k.get("group") == "p2gs.plugins" else real(**k)
    )
    assert printed(capsys)["phases"]["single_state"]["losses"]["round"]["weight"] == 0.02


def test_it_computes_and_can_be_overridden(files, capsys):
    import torch

    from p2gs.config.run import load_config
    from p2gs.losses.base import LossInputs
    from p2gs.types import GaussianTensors

    config = printed(capsys, "--plugins", "my_losses", "--phases.single_state.losses.round.start", "0.5")
    assert config["phases"]["single_state"]["losses"]["round"]["start"] == 0.5
    loss = load_config(["preset/cpu.yaml", "mine.yaml"], plugins=["my_losses"]).phases["single_state"].losses["round"]
    scales = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 2.0]], requires_grad=True)
    g = GaussianTensors(torch.zeros(2, 3), torch.ones(2, 4), scales, torch.zeros(2), torch.zeros(2, 1, 3))
    loss(LossInputs(0, 10, g)).backward()
    assert loss(LossInputs(0, 10, g)).item() == pytest.approx(0.02 * 0.5) and scales.grad[1, 2] > 0
