"""Every ablation takes two steps of fusion and articulation, on the default and the literal preset, and runs what it is
named for."""

import json
from pathlib import Path

import pytest
import torch

from p2gs.config.run import load_config
from p2gs.gaussians import handover
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.models.articulation import ArticulationPhase
from p2gs.models.canonical import CanonicalConfig, fuse
from p2gs.ops import se3
from p2gs.parts.slots import merge_to
from p2gs.runtime.pipeline import Pipeline
from p2gs.types import GaussianTensors, UserError

NAMES = sorted(p.stem for p in (Path(__file__).parents[2] / "configs" / "ablation").glob("*.yaml"))
PRESETS = ("cpu", "paper_literal")
TINY = [
    *(
        "--data.format",
        "synthetic",
        "--data.kind",
        "demo",
        "--data.size",
        "48",
        "--data.train_views",
        "6",
        "--data.test_views",
        "1",
    ),
    *("--device", "cpu", "--threads", "1", "--phases.canonical_fusion.canonical.match_size", "60"),
    *(w for name in ("single_state", "canonical_fusion", "articulation") for w in (f"--phases.{name}.levels", "[48]")),
    *(
        w
        for name in ("single_state", "canonical_fusion", "articulation")
        for w in (f"--phases.{name}.level_starts", "[0.0]")
    ),
    *(
        "--callbacks",
        "{checkpoint: null, scalars: null, images: null, previews: null, evaluation: null, families: null, progress: "
        "null}",
    ),
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> str:
    """The demo cabinet at 48 pixels, written once."""
    folder = str(tmp_path_factory.mktemp("ablations") / "scene")
    load_config(["preset/cpu.yaml"], ["--data.root", folder, *TINY]).data.scene()
    return folder


def states_and_motions(parts: int = 2) -> tuple[list[StateGaussians], PartMotions]:
    """Reconstructions that need no training: a box of solid Gaussians, of which ``parts`` slabs slide or turn."""
    r = torch.Generator().manual_seed(0)
    n = 240
    means = torch.rand(n, 3, generator=r) * 1.2 - 0.6
    labels = torch.arange(n) % (parts + 1)
    T = [
        se3.make(torch.eye(3).double(), torch.tensor([0.1 * (k + 1), 0.05 * k, 0.0]).double()) for k in range(parts - 1)
    ]
    T.append(se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([0.3, 0.3, 0]).double(), 0.4))
    T = torch.stack(T)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    sh = 0.3 * torch.randn(n, 4, 3, generator=r)
    end = means.clone()
    for k in range(parts):
        end[labels == k + 1] = se3.apply(T[k], means[labels == k + 1].double()).float()
    states = [
        StateGaussians(s, GaussianTensors(x, quats, torch.full((n, 3), -3.0), torch.full((n,), 3.0), sh))
        for s, x in ((0, means), (1, end))
    ]
    types = ["prismatic"] * (parts - 1) + ["revolute"]
    return states, PartMotions(types, T, torch.ones(parts), [labels, labels], [torch.ones(n), torch.ones(n)])


def run_two_steps(
    preset: str, name: str, scene: str, run: Path, *words: str
) -> tuple[Pipeline, ArticulationPhase, handover.Articulation]:
    """Pipeline, trained phase, and what it handed over.

    Fusion and articulation of a config, two steps each where it takes steps at all, from reconstructions and motions
    that are given.
    """
    words = ["--data.root", scene, "--run", str(run), *TINY, *words]
    plain = load_config([f"preset/{preset}.yaml", f"ablation/{name}.yaml"], words)
    words += ["--num_parts", "3"] if plain.num_parts == "auto" else []
    for phase in ("canonical_fusion", "articulation"):
        words += [f"--phases.{phase}.steps", str(min(plain.phases[phase].config.steps, 2))]
    pipe = Pipeline(load_config([f"preset/{preset}.yaml", f"ablation/{name}.yaml"], words))
    states, motions = states_and_motions()
    motions = motions if pipe.context.init == "discovery" else None
    if pipe.context.exact:
        motions, _ = merge_to(motions, states, pipe.cfg.num_parts)
    given = {"states": states, "motions": motions}
    given["canonical"] = pipe.make("canonical_fusion", given)
    made = []

    class Seen(ArticulationPhase):
        @classmethod
        def build(cls, *args, **options):
            made.append(ArticulationPhase.build(*args, **options))
            return made[0]

    pipe.order["articulation"] = Seen
    learned = pipe.make("articulation", given)
    return pipe, made[0], learned


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", NAMES)
def test_two_steps_of_every_ablation(name, preset, scene, tmp_path):
    pipe, phase, learned = run_two_steps(preset, name, scene, tmp_path)
    assert torch.isfinite(learned.probs).all() and torch.isfinite(learned.transforms).all()
    if phase.total_steps == 0:
        return
    wanted = {n for n, loss in phase.losses.items() if loss.active(1, 2) or loss.active(0, 2)}
    wanted -= {"depth", "surface_depth"}  # no depth maps at hand
    assert wanted <= {n.removeprefix("loss/") for n in phase.scalars}, "a loss that is switched on never applied"
    if name.startswith("k_"):
        assert learned.probs.shape[1] == pipe.cfg.num_parts
    elif preset == "cpu":
        assert learned.probs.shape[1] == 3


def test_part_rows_use_nothing_of_discovered_labels(scene, tmp_path):
    _, phase, learned = run_two_steps("cpu", "no_part", scene, tmp_path / "a")
    labels = states_and_motions()[1].labels[0]
    n = min(len(labels), len(learned.probs))
    assert (learned.part_ids[:n] == labels[:n]).float().mean() < 0.6  # three slots at random agree on a third
    _, frozen, kept = run_two_steps("cpu", "frozen_labels", scene, tmp_path / "b")
    before, after = frozen.head(frozen.splats.psi), kept.probs
    assert torch.equal(before.argmax(1), after.argmax(1)) and (kept.part_ids[:n] == labels[:n]).float().mean() > 0.9


def test_spare_slots_have_an_equal_share_and_parts_too_many_are_merged(scene, tmp_path):
    pipe, phase, learned = run_two_steps("cpu", "k_6", scene, tmp_path / "over")
    share = torch.bincount(phase.head(phase.splats.psi).argmax(1), minlength=6)[3:] / len(phase.splats)
    assert phase.types == ["prismatic", "revolute", "free", "free", "free"]
    torch.testing.assert_close(share, torch.full((3,), 1 / 6), atol=0.02, rtol=0)
    _, phase, _ = run_two_steps("cpu", "k_2", scene, tmp_path / "under")
    assert len(phase.types) == 1


@pytest.mark.parametrize("name, slots", [("k_6", 6), ("k_2", 2)])
def test_a_wrong_number_of_slots_comes_to_a_twin_that_tells_of_each(name, slots, scene, tmp_path):
    words = ["--phases.finish.exports", "[]", "--phases.finish.polish.steps", "1", "--phases.finish.tune.steps", "1"]
    pipe, phase, learned = run_two_steps("cpu", name, scene, tmp_path, *words)
    states, motions = states_and_motions()
    motions, _ = merge_to(motions, states, slots)
    given = {"states": states, "motions": motions}
    given["canonical"] = pipe.make("canonical_fusion", given)
    pipe.make("finish", {**given, "learned": learned})
    told = json.loads((tmp_path / "slots.json").read_text())
    assert [s["slot"] for s in told] == list(range(slots)) and sum(s["share"] for s in told) == pytest.approx(1)
    assert [s["slot"] for s in told if s["spare"]] == list(range(len(motions) + 1, slots))
    joints = json.loads((tmp_path / "diagnostics.json").read_text())["articulation"]["joints"]
    assert [j["moved"] is None for j in joints] == [s["spare"] for s in told[1:]]


def test_the_parts_that_are_merged_are_those_of_the_cheapest_joint():
    states, motions = states_and_motions(3)  # slides of 0.1 and 0.2, and a turn
    merged, notes = merge_to(motions, states, 3)
    assert merged.types == ["prismatic", "revolute"] and len(notes) == 1 and "parts 1 and 2" in notes[0]
    assert merged.transforms[0, 0, 3].item() == pytest.approx(0.15, abs=0.01)
    assert set(merged.labels[0][motions.labels[0] == 2].tolist()) == {1}
    assert set(merged.labels[0][motions.labels[0] == 3].tolist()) == {2}


def test_losses_that_would_vanish_are_named(scene, tmp_path):
    with pytest.raises(UserError, match="art, vector, velocity need observed pairs"):
        run_two_steps("cpu", "no_canonical", scene, tmp_path, "--phases.articulation.pair_target", "matched")


def test_beta_per_part_without_parts_takes_motion_clusters():
    states, motions = states_and_motions()
    options = {"correspondence": "hungarian", "fusion": "paper", "match_size": 500, "min_opacity": 0.0}
    fused = {
        b: fuse(*(s.gaussians for s in states), None, CanonicalConfig(beta=b, **options), num_parts=3)
        for b in ("global", "per_part")
    }
    a, b = (f.gaussians.means for f in fused.values())
    assert a.shape == b.shape and not torch.allclose(a, b)
    with pytest.raises(UserError, match="their number"):
        fuse(*(s.gaussians for s in states), None, CanonicalConfig(beta="per_part", **options))


def test_the_force_is_drawn_in_training_only(scene, tmp_path):
    _, phase, _ = run_two_steps("paper_literal", "full", scene, tmp_path / "a")
    assert (
        phase.config.repel.render
        and len(phase.repel_points)
        and phase.repel_force(phase.splats.means, 0).abs().max() > 0
    )
    with pytest.raises(UserError, match="render: false"):
        run_two_steps("paper_literal", "full", scene, tmp_path / "b", "--phases.articulation.losses.art", "null")
