"""The configs that come with p2gs, against what is really registered; the README's example of a loss."""

import re
from pathlib import Path

import pytest

from p2gs.config.run import load_config

REPOSITORY = Path(__file__).parents[2]
CONFIGS = REPOSITORY / "configs"


def files(folder: str) -> list[str]:
    return sorted(str(p.relative_to(CONFIGS)) for p in (CONFIGS / folder).glob("*.yaml"))


def test_the_folders_are_not_empty():
    assert {f"preset/{name}.yaml" for name in ("cpu", "gpu", "paper", "paper_depth", "paper_literal", "smoke")} <= set(
        files("preset")
    )
    assert {"data/paris.yaml", "data/dta.yaml", "data/artgs.yaml"} <= set(files("data")) and len(files("ablation")) >= 5


@pytest.mark.parametrize("name", ["demo.yaml", *files("preset")])
def test_presets_name_every_stage(name):
    cfg = load_config([name])
    assert list(cfg.phases) == [
        "single_state",
        "registration",
        "sharpen",
        "discovery",
        "canonical_fusion",
        "articulation",
        "finish",
    ]
    for phase in ("single_state", "canonical_fusion", "articulation"):
        assert "render" in cfg.phases[phase].losses
        assert {"progress", "scalars", "checkpoint", "evaluation"} <= set(cfg.phases[phase].callbacks)


@pytest.mark.parametrize("name", files("data"))
def test_data_configs_name_a_format(name):
    cfg = load_config(["preset/cpu.yaml", name])
    assert cfg.data_options["format"] == Path(name).stem


def test_every_loss_and_callback_of_the_default_can_be_null():
    plain = load_config(["preset/cpu.yaml"])
    words = [f"--phases.{p}.losses.{name}" for p, section in plain.phases.items() for name in section.losses]
    words += [f"--phases.{p}.callbacks.{name}" for p, section in plain.phases.items() for name in section.callbacks]
    assert len(words) > 20
    cfg = load_config(["preset/cpu.yaml"], [part for word in words for part in (word, "null")])
    assert all(not section.losses and not section.callbacks for section in cfg.phases.values())


def test_the_paper_says_these_numbers():
    literal = load_config(["preset/paper_literal.yaml"])
    assert (
        literal.phases["single_state"].config.steps == 30000 and literal.phases["canonical_fusion"].config.steps == 5000
    )
    articulation = literal.phases["articulation"]
    weights = {name: loss.weight for name, loss in articulation.losses.items()}
    assert weights == {"render": 1.0, "part": 0.1, "art": 1.0, "contact": 0.5, "velocity": 0.5, "vector": 0.5}
    assert articulation.config.rate_screws == 1e-3 and articulation.config.repel.count == 2000


def test_the_literal_preset_has_nothing_of_the_default_that_the_paper_has_not():
    literal = load_config(["preset/paper_literal.yaml"])
    articulation = literal.phases["articulation"]
    assert all(loss.every == 1 and loss.start == 0 and loss.end == 1 for loss in articulation.losses.values())
    assert {name: loss.reduce for name, loss in articulation.losses.items() if hasattr(loss, "reduce")} == {
        "part": "mean", "art": "sum", "contact": "sum", "velocity": "sum", "vector": "sum"
    }  # fmt: skip
    assert all(articulation.losses[n].sample == 0 for n in ("art", "contact", "velocity", "vector"))
    art = articulation.losses["art"]
    assert articulation.config.repel.render and art.variant == "paper" and art.lambda_rot == 0.1
    for name in ("single_state", "canonical_fusion", "articulation"):
        phase = literal.phases[name]
        assert len(phase.config.levels) == 1 and not {
            "alpha",
            "depth",
            "surface_depth",
            "depth_variance",
            "flat",
            "planar",
        } & set(phase.losses)
    densify = literal.phases["single_state"].callbacks["densify"]
    assert densify.budget is None and densify.threshold > 0 and densify.reset_every == 3000
    canonical = literal.phases["canonical_fusion"].config.canonical
    assert canonical.min_opacity == 0 and canonical.trim == 0 and canonical.match_smaller == "whole"
    finish = literal.phases["finish"].config
    assert not finish.complete and finish.whole == "separate" and finish.polish.steps == finish.tune.steps == 0
    assert literal.data_options["normalize"] == "none"
    with_data = load_config(["preset/paper_literal.yaml", "data/artgs.yaml"], ["--data.root", "x"])
    assert with_data.data_options["normalize"] == "none" and with_data.data_options["depth"] == "never"


def test_depth_is_in_the_depth_preset_alone():
    paper, depth = load_config(["preset/paper.yaml"]), load_config(["preset/paper_depth.yaml"])
    trained = ("single_state", "sharpen", "canonical_fusion", "articulation")
    assert not any({"depth", "surface_depth"} & set(paper.phases[n].losses) for n in trained)
    assert not any("surface_depth" in depth.phases[n].losses for n in trained)
    assert paper.data_options["depth"] == "never"
    assert (
        all(depth.phases[n].losses["depth"].weight == 1.0 for n in trained) and depth.data_options["depth"] == "always"
    )


def test_exact_parts_need_a_number():
    from p2gs.types import UserError

    with pytest.raises(UserError, match="exact_parts: true needs a number"):
        load_config(["preset/cpu.yaml"], ["--exact_parts", "true"])


def test_the_loss_of_the_readme_is_found_and_switched_on(tmp_path, monkeypatch):
    from p2gs.losses.base import LOSSES

    text = (REPOSITORY / "README.md").read_text()
    python, yaml = re.search(r"```python\n(.*?)```.*?```yaml\n(.*?)```", text, re.S).groups()
    (tmp_path / "my_losses_of_readme.py").write_text(python)
    (tmp_path / "mine.yaml").write_text(yaml)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LOSSES, "_items", dict(LOSSES.items()))
    cfg = load_config(["preset/cpu.yaml", "mine.yaml"], plugins=["my_losses_of_readme"])
    assert cfg.phases["single_state"].losses["round"].weight == 0.02
    assert "render" in cfg.phases["single_state"].losses and "round" not in cfg.phases["articulation"].losses
