"""The docs say what the program does: their commands parse against real configs, their YAML is read, their Python
runs."""

from __future__ import annotations

import importlib
import json
import re
import runpy
import sys

import pytest
import yaml
from docs_pages import PAGES, REPOSITORY, blocks, page_commands, write_files

from p2gs.app import parser
from p2gs.cli import main
from p2gs.config.run import load_config

README = REPOSITORY / "README.md"
EXTENDING = [p for p in PAGES if p.stem.startswith("add_")]
OWN_TESTS = ("benchmarks",)  # tests/bench/test_bench_docs.py runs its blocks


def written(pages):
    return pytest.mark.parametrize("page", pages, ids=lambda p: p.stem)


@written([*PAGES, README])
def test_commands_are_understood(page, desk):
    """Every p2gs command parses; a fit's config files are there and its overrides are options that exist."""
    from p2gs.commands.fit import config_from

    write_files(page, desk)
    commands = page_commands(page)
    if page is README:  # its example of a loss has no title: `mine.yaml` and my_losses are those blocks
        (desk / "my_losses.py").write_text(next(b.text for b in blocks(page) if b.kind == "python"))
        (desk / "mine.yaml").write_text(next(b.text for b in blocks(page) if b.kind == "yaml"))
        (desk / "path/to/scene").mkdir(parents=True)
        (desk / "path/to/scene/transforms_train_start.json").touch()  # a folder of the ArtGS layout, found as such
        assert len(commands) >= 8
    for words in commands:
        words = [w for word in words for w in (["-c", "preset/cpu.yaml"] if word == "..." else [word])]
        if words[:1] == ["bench"] and words[1] in ("scaling", "peers"):  # these have parsers of their own
            rest = importlib.import_module(f"p2gs.bench.{words[1]}").options().parse_known_args(words[2:])[1]
            assert not rest or rest[0].startswith("--phases."), words
            continue
        args, rest = parser().parse_known_args(words)
        if args.command == "fit":
            cfg = config_from(args, rest)
            assert len(cfg.phases) == len(cfg.stages) >= 7, words
        elif args.command == "bench":
            assert not rest or rest[0].startswith(("--phases.", "--data.")), words
        else:
            assert not rest, words


def within(given, whole) -> bool:
    """Whether a mapping holds what another one names, at every level."""
    return (
        all(k in whole and within(v, whole[k]) for k, v in given.items()) if isinstance(given, dict) else given == whole
    )


@written([p for p in PAGES if p.stem not in OWN_TESTS])
def test_yaml_is_read(page, desk):
    modules = write_files(page, desk)
    for b in blocks(page):
        if b.kind == "json":
            json.loads(b.text)
        if b.kind != "yaml":
            continue
        assert b.title, f"{page.name}: a yaml block without a file name is not tested"
        given = yaml.safe_load(b.text)
        cfg = load_config(["preset/cpu.yaml", b.title], plugins=[] if "plugins" in given else modules)
        values = cfg.to_dict()
        for name, phase in given.get("phases", {}).items():
            for kind in ("losses", "callbacks"):
                for key, options in phase.get(kind, {}).items():
                    section = values["phases"][name][kind][key]
                    assert section is None if options is None else within(options, section)


@written(EXTENDING)
def test_python_of_the_extending_pages_runs(page, desk, capture):
    if page.stem == "add_dataset":
        capture(desk / "capture")
    assert write_files(page, desk)
    scripts = [b.text for b in blocks(page) if b.kind == "python" and not b.title]
    assert scripts or page.stem in ("add_callback", "add_phase")
    for text in scripts:
        exec(compile(text, page.name, "exec"), {"__name__": "docs"})


def test_python_of_the_cpu_page_runs(capsys):
    (block,) = [b for b in blocks(REPOSITORY / "docs" / "cpu.md") if b.kind == "python"]
    exec(compile(block.text, "cpu.md", "exec"), {})
    assert capsys.readouterr().out


def test_the_callback_writes_its_file_in_a_training_phase(desk):
    from lightning.pytorch import Trainer
    from tiny import TinyData, hinge, tiny_scene

    from p2gs.data.views import TrainingViews
    from p2gs.losses.base import LOSSES
    from p2gs.models.single_state import SingleStateConfig, SingleStatePhase

    write_files(REPOSITORY / "docs" / "add_callback.md", desk)
    cfg = load_config(["preset/cpu.yaml", "joint_log.yaml"], plugins=["my_callbacks"])
    callback = cfg.phases["articulation"].callbacks["joint_log"]
    assert callback.every == 50 and "joint_log" not in cfg.phases["single_state"].callbacks
    callback.every = 2
    scene = tiny_scene(hinge(), 24)
    config = SingleStateConfig(steps=5, initial_gaussians=50, levels=[24], level_starts=[0.0])
    views = TrainingViews(scene.select(state=0), [24])
    phase = SingleStatePhase(config, {"render": LOSSES["render"]()}, scene, 0, views)
    quiet = {
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
    }
    trainer = Trainer(
        max_steps=5, max_epochs=-1, accelerator="cpu", callbacks=[callback], default_root_dir=desk, **quiet
    )
    trainer.fit(phase, datamodule=TinyData())
    lines = [json.loads(line) for line in (desk / "joints.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 5] and lines[0]["gaussians"] == 50


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_a_capture_becomes_a_scene(bend, desk, capture, photographs, monkeypatch, capsys):
    """The page's script on what a user has; without distortion pixels, masks and cameras come through unchanged."""
    import torch

    write_files(REPOSITORY / "docs" / "data.md", desk)
    capture(desk / "capture", k1=bend)
    monkeypatch.setattr(sys, "argv", ["to_artgs.py", "capture", "my_scene"])
    runpy.run_path("to_artgs.py", run_name="__main__")
    assert main(["data", "check", "my_scene"]) == 0
    assert "can be trained on" in capsys.readouterr().out
    scene = load_config(["preset/cpu.yaml", "data/artgs.yaml"], ["--data.root", "my_scene"]).data.raw_scene()
    assert len(scene.views) == 16 and len(scene.select(split="test")) == 2
    first, true = scene.select(0, "test")[0], photographs.select(0)[0]
    assert torch.allclose(first.camera.viewmat, true.camera.viewmat, atol=1e-5) and torch.allclose(
        first.camera.K, true.camera.K
    )
    off = (first.alpha.float() - true.alpha.float()).abs().mean()
    assert off == 0 if bend == 0 else 0 < off < 10


def test_the_generated_scene_of_the_data_page(desk, capsys):
    words = [
        w for w in page_commands(REPOSITORY / "docs" / "data.md") if w[:2] in (["data", "synth"], ["data", "check"])
    ][:2]
    assert [main(w) for w in words] == [0, 0]
    assert "example: can be trained on" in capsys.readouterr().out


def test_links_lead_somewhere():
    for page in [*PAGES, README]:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            target, _, anchor = link.partition("#")
            if target.startswith("http") or target.endswith(".png"):
                continue
            file = page if not target else page.parent / target
            assert file.exists(), f"{page.name}: {link}"
            if anchor:
                heads = [
                    re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-")
                    for h in re.findall(r"^#+ (.*)$", file.read_text(), re.M)
                ]
                assert anchor in heads, f"{page.name}: {link}"


def test_every_page_is_in_the_site():
    nav = (REPOSITORY / "mkdocs.yml").read_text().split("nav:")[1]
    assert set(re.findall(r"(\w+\.md)", nav)) == {p.name for p in PAGES}


def test_files_named_in_the_pages_exist():
    for page in [*PAGES, README]:
        for name in re.findall(
            r"`((?:p2gs/|tests/|models/|losses/|ops/|preset/|data/|ablation/|bench/)[\w/]+\.?(?:py|yaml|md)?/?)`",
            page.read_text(),
        ):
            places = (REPOSITORY, REPOSITORY / "p2gs", REPOSITORY / "configs")
            assert any((place / name).exists() for place in places), f"{page.name}: {name}"
