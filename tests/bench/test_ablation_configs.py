"""configs/ablation: each file changes exactly the keys that it names, to the values it names, and nothing else."""

import copy
from pathlib import Path

import pytest
import yaml

from p2gs.config.run import load_config
from p2gs.config.schema import keys_of
from p2gs.types import UserError

FOLDER = Path(__file__).parents[2] / "configs" / "ablation"
NAMES = sorted(p.stem for p in FOLDER.glob("*.yaml"))
# rows that say the preset's own value aloud, so that a table's matrix can name it
REFERENCE = {"full", "repel_count_2000", "repel_noise_00", "repel_fixed_clean", "repel_exponent_3"}
ROWS = {
    "tab:main_ablation_v2": ["vanilla", "plus_part", "plus_repel", "full"],
    "tab:main_ablation": ["no_part", "no_repel", "no_phys", "no_canonical", "full"],
    "tab:pc_ablation": ["no_phys", "phys_contact", "phys_contact_velocity", "full"],
    "ours, beside the paper's": ["frozen_labels", "no_art", "no_part_loss", "no_articulation", "real_scan"],
    "tab:beta_ablation": ["beta_uniform", "beta_per_part", "beta_global"],
    "tab:repel_num_ablation": ["repel_count_500", "repel_count_2000", "repel_count_4000"],
    "tab:repel_noise_robustness": ["repel_noise_00", "repel_noise_01", "repel_noise_03", "repel_noise_05"],
    "tab:fixed_dynamic_repel_per_object": [
        "repel_fixed_clean",
        "repel_dynamic_clean",
        "repel_fixed_noisy",
        "repel_dynamic_noisy",
    ],
    "tab:repel_exponent_ablation": ["repel_exponent_2", "repel_exponent_3", "repel_exponent_4"],
    "tab:k_ablation": ["k_2", "k_3", "k_4", "k_5", "k_6"],
    "tab:k_sensitivity": ["k_2", "k_4", "k_6", "k_5", "k_7", "k_9", "k_8", "k_11"],
}


def named(tree, prefix=()):
    """Every key that a file names, as (path, value); null is a value."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from named(value, (*prefix, key))
        else:
            yield (*prefix, key), value


def read(name: str) -> dict:
    return yaml.safe_load((FOLDER / f"{name}.yaml").read_text())


@pytest.fixture(scope="module")
def preset():
    return load_config(["preset/cpu.yaml"]).to_dict()


@pytest.mark.parametrize("name", NAMES)
def test_a_file_changes_what_it_names_and_nothing_else(name, preset):
    after = load_config(["preset/cpu.yaml", f"ablation/{name}.yaml"]).to_dict()
    expected = copy.deepcopy(preset)
    for path, value in named(read(name)):
        section = expected
        for key in path[:-1]:
            section = section.setdefault(key, {})
        section[path[-1]] = value
    for tree in (after, expected):  # a callback named null in a phase that never had it
        for phase in tree["phases"].values():
            if "callbacks" in phase:
                phase["callbacks"] = {k: v for k, v in phase["callbacks"].items() if v is not None}
    assert after == expected
    assert (after == preset) == (name in REFERENCE)


def test_every_row_of_every_ablation_has_its_file_and_every_file_is_short():
    assert {row for rows in ROWS.values() for row in rows} <= set(NAMES)
    for name in NAMES:
        assert len((FOLDER / f"{name}.yaml").read_text().splitlines()) <= 9, name


@pytest.mark.parametrize("base", ["smoke", "paper", "paper_depth", "paper_literal", "gpu"])
def test_they_lie_on_the_other_presets_too(base):
    for name in {"vanilla", "no_canonical", "repel_dynamic_noisy", "beta_per_part", "phys_contact"}:
        cfg = load_config([f"preset/{base}.yaml", f"ablation/{name}.yaml"])
        for path, value in named(read(name)):
            found = cfg.to_dict()
            for key in path:
                found = (found or {}).get(key)  # a loss that the preset has switched off is None already
            assert found == value


def test_a_wrong_switch_is_told():
    with pytest.raises(UserError, match="global, uniform, per_part"):
        load_config(["preset/cpu.yaml"], ["--phases.canonical_fusion.canonical.beta", "per_slot"])


def test_no_canonical_hands_over_the_start_state_as_it_is():
    import torch

    from p2gs.gaussians.handover import PartMotions
    from p2gs.models.canonical import CanonicalConfig, fuse
    from p2gs.types import GaussianTensors

    def cloud(n, seed):
        r = torch.Generator().manual_seed(seed)
        means = torch.rand(n, 3, generator=r)
        return GaussianTensors(
            means, torch.eye(4)[:1].repeat(n, 1), torch.zeros(n, 3), torch.full((n,), 3.0), torch.zeros(n, 1, 3)
        )

    start, end = cloud(40, 0), cloud(30, 1)
    labels = [torch.arange(40) % 2, torch.arange(30) % 2]
    motions = PartMotions(
        ["free"], torch.eye(4).double()[None], torch.ones(1), labels, [torch.ones(40), torch.ones(30)]
    )
    fused = fuse(start, end, motions, CanonicalConfig(fusion="none"))
    assert torch.equal(fused.gaussians.means, start.means) and torch.equal(fused.labels, labels[0])
    # canonical time 1 - beta = 0: the start
    assert not fused.paired.any() and torch.equal(fused.betas, torch.ones(2).double())


def test_the_dynamic_repel_points_follow_the_length_of_the_phase():
    from p2gs.callbacks.repel import RepelRefresh

    class Phase:
        total_steps, placed = 40, []

        def place_repel_points(self, step):
            self.placed.append(step)

    assert keys_of(RepelRefresh).keys() >= {"every", "fraction"}
    phase, callback = Phase(), RepelRefresh(fraction=0.25)
    for phase.step in range(1, 41):
        callback.on_step(None, phase)
    assert phase.placed == [10, 20, 30]  # not after the last step
