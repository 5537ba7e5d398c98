"""The diagnosis of a tiny run: its figures, its verdict by rules, its page; the same twice."""

import json
from dataclasses import replace

import pytest
import torch
from test_finish import two_states
from tiny import hinge

from p2gs.diagnosis.measures import StageResults, diagnose, plain, reconstruction
from p2gs.diagnosis.page import page, write_diagnosis
from p2gs.diagnosis.verdict import LIMITS, STAGES, lost_at, verdicts
from p2gs.gaussians.handover import Articulation, CanonicalGaussians, PartMotions
from p2gs.models.finish import FinishConfig, finish
from p2gs.models.tune import TuneConfig
from p2gs.motion.joint_confidence import JointEvidence
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.types import Similarity


def small_run(found=None, polish_steps=0):
    """A run of the two panels whose discovery says ``found`` (default: the truth); everything after it takes that
    over."""
    states, labels, views = two_states(hinge())
    T = hinge()[None] if found is None else found[None]
    n = len(labels)
    told = {
        "explanation": 0,
        "reconsidered": [
            {
                "change": "parted",
                "part": 0,
                "type": "revolute",
                "cost": 0.1,
                "after": 0.0987,
                "proposed": 0.1,
                "energy": 0.0213,
            }
        ],
        "explanations": [
            {
                "types": ["revolute"],
                "cost": 0.1,
                "rank": 0.1,
                "reductions": [
                    {"change": "drop", "type": "prismatic", "saved": 0.001, "energy": -0.029},
                    {"change": "drop", "type": "prismatic", "own_share": 0.07, "energy": -0.01},
                    {"change": "drop", "type": "revolute", "cost_with": 0.09, "cost_without": 0.1, "energy": -0.01},
                ],
            }
        ],
        "seamless": [
            {"parts": [0, 1], "without_edge": [1.0, 0.83], "surfaces": -0.03, "joined": True},
            {"parts": [0, 1], "without_edge": [1.0, 0.67], "surfaces": 0.09, "joined": False},
        ],
        "evidence": [labels.to(torch.int8)] * 2,
        "states": [{"moved": 300, "static": 300, "unknown": 0}] * 2,
        "min_opacity": 0.5,
    }
    motions = PartMotions(["revolute"], T, torch.ones(1), [labels, labels], [torch.ones(n)] * 2, told)
    g = states[0].gaussians
    zero = torch.zeros(n, 3)
    gave_way = [{"unconfirmed": 11, "patches": 2, "gave_way": 1, "removed": 7, "added": 40}] * 2
    counted = {"dropped": 3, "openings": gave_way}
    canonical = CanonicalGaussians(
        g, torch.ones(2).double(), labels, torch.ones(n), torch.ones(n).bool(), zero, zero, None, counted
    )
    learned = Articulation(g, torch.nn.functional.one_hot(labels, 2).float(), ["revolute"], T, torch.ones(1), 0.0)
    config = FinishConfig(
        polish=PolishConfig(steps=polish_steps, levels=[64], level_starts=[0.0], min_margin=0.1),
        clean_neighbours=0,
        together=TuneConfig(steps=20, levels=[64]),
    )
    twin, notes, record = finish(learned, states, views, config, Similarity(scale=2.0), seed=0, backend="auto")
    return StageResults(states, motions, states, canonical, learned, record, notes), twin, views


@pytest.fixture(scope="module")
def right():
    stages, twin, views = small_run(polish_steps=20)
    return diagnose(stages, twin, views, min_margin=0.1)


def texts(d):
    return [v["text"] for v in verdicts(d, 1.0) if v["level"] == "warning"]


def test_a_right_run_has_no_warning(right):
    assert texts(right) == [] and lost_at(verdicts(right, 1.0)) is None
    notes = [v["text"] for v in verdicts(right, 1.0)]
    assert any(t.startswith("A prismatic part was dropped: it saved 0.1 % of the image loss") for t in notes)
    assert any("saved 7 % of the image loss in its own pixels" in t for t in notes)
    assert any(t.startswith("A revolute part was dropped: it saved 10.0 % of the image loss") for t in notes)
    assert [t for t in notes if "became one" in t] == [
        "Two parts became one: 100 % of the start's photographs and 83 % of the end's show no edge between them, and "
        "surfaces do not tell them apart."
    ]
    (joint,) = right["joints"]
    assert joint["confidence"] > 0.7 and set(joint["confidence_by_stage"]) == {"discovery", "articulation", "finish"}
    assert right["single_state"]["start"]["psnr"] > 30 and right["single_state"]["start"]["alpha_iou"] > 0.95
    assert right["fusion"]["matched"] == [300, 300] and right["fusion"]["dropped"] == 3
    # the end's panel stands between the two, where few views of the start look: there is hardly evidence of it
    assert right["labels"]["start"]["moved"] > 50 and all(s["moved_static"] < 0.1 for s in right["labels"].values())
    assert right["polish"]["joints"][0]["disagreement_degrees"] < 2


def test_a_wrong_motion_is_laid_at_the_stage_that_made_it():
    s = se3.screw_parameters(hinge())
    stages, twin, views = small_run(se3.from_screw(s.axis, s.origin, s.angle + 0.12))
    d = diagnose(stages, twin, views, min_margin=0.1)
    said = verdicts(d, 1.0)
    assert lost_at(said) == "discovery" and "Part 1 (revolute)" in texts(d)[0] and "not reliable" in texts(d)[0]
    # the same with discovery right: the articulation phase lost it
    d["joints"][0]["confidence_by_stage"]["discovery"] = 0.9
    assert lost_at(verdicts(d, 1.0)) == "articulation"


def test_a_part_that_the_twin_does_not_have_is_missed():
    """All labels static at the end: free space says what moved."""
    states, labels, views = two_states(hinge())
    stages, _, _ = small_run()
    nobody = replace(stages.learned, probs=torch.tensor([[1.0, 0.0]]).expand(len(labels), 2))
    twin, notes, record = finish(nobody, states, views, FinishConfig(), Similarity(), seed=0, backend="auto")
    d = diagnose(replace(stages, learned=nobody, record=record, notes=notes), twin, views, min_margin=0.1)
    assert d["labels"]["start"]["moved_static"] == 1.0
    assert any("called static in the twin" in v["text"] and v["stage"] == "articulation" for v in verdicts(d, 1.0))


@pytest.mark.parametrize(
    ("stage", "change", "word"),
    [
        ("single_state", lambda d: d["single_state"]["end"].update(psnr=20.0), "reconstructed poorly"),
        ("single_state", lambda d: d["single_state"]["end"].update(alpha_iou=0.5), "silhouette"),
        ("single_state", lambda d: d["single_state"]["start"].update(fog=0.9), "half-transparent"),
        ("discovery", lambda d: [s.update(moved=4) for s in d["motion_evidence"].values()], "Next to nothing moved"),
        ("discovery", lambda d: d["motion_evidence"]["end"].update(moved_without_part=0.6), "belongs to no part"),
        ("articulation", lambda d: d["labels"]["end"].update(moved=100, moved_static=0.5), "called static in the twin"),
        ("discovery", lambda d: d["discovery"].update(parts=[]), "no moving part"),
        ("discovery", lambda d: [r.update(bright_static=0.3) for r in d["residuals"].values()], "left with the base"),
        ("canonical_fusion", lambda d: d["fusion"].update(matched=[300, 2]), "have a partner"),
        ("canonical_fusion", lambda d: d["fusion"].update(dropped=400), "relabelled or dropped"),
        (
            "articulation",
            lambda d: d["articulation"].update(image_loss_start=0.01, image_loss_end=0.02),
            "made the images worse",
        ),
    ],
)
def test_each_rule_speaks_for_its_stage(right, stage, change, word):
    d = json.loads(json.dumps(right))
    change(d)
    warned = [v for v in verdicts(d, 1.0) if v["level"] == "warning"]
    assert [v["stage"] for v in warned] == [stage] and word in warned[0]["text"]


def test_directions_that_disagree_are_told_in_degrees(right):
    d = json.loads(json.dumps(right))
    d["polish"]["joints"][0] |= {"disagreement": 0.05, "disagreement_degrees": 3.1}
    d["joints"][0]["confidence"] = d["joints"][0]["confidence_by_stage"]["finish"] = 0.05
    (text,) = texts(d)
    assert "forward and backward polish disagree by 3.1 deg" in text and "its motion is not reliable" in text
    assert lost_at(verdicts(d, 1.0)) == "finish"
    d["joints"][0]["confidence"] = 0.6  # likely right all the same: no loss
    (said,) = [v for v in verdicts(d, 1.0) if "polish disagree" in v["text"]]
    assert said["level"] == "note" and lost_at(verdicts(d, 1.0)) is None


def test_both_files_are_the_same_when_written_again(tmp_path):
    stages, twin, views = small_run()
    files = []
    for _ in range(2):
        write_diagnosis(tmp_path, stages, twin, views, min_margin=0.1)
        files.append([(tmp_path / f"diagnostics.{kind}").read_bytes() for kind in ("json", "html")])
    assert files[0] == files[1]
    d, page = json.loads(files[0][0]), files[0][1].decode()
    assert d["format"] == "p2gs-diagnostics/1" and set(d["limits"]) == set(LIMITS) and d["losses"] == {}
    assert page.count("data:image/png;base64,") == 4 and "http" not in page
    assert all(f'id="{stage}"' in page for stage in STAGES)
    assert "start: 11 that the other state says nothing of, 7 gave way to the walls behind" in page


def test_the_page_tells_what_was_tried(tmp_path):
    stages, twin, views = small_run()
    d = write_diagnosis(tmp_path, stages, twin, views, min_margin=0.1)
    html = (tmp_path / "diagnostics.html").read_text()
    assert d["discovery"]["reconsidered"][0]["change"] == "parted" and "0.0987" in html and "+0.0213" in html
    d["discovery"]["reconsidered"] = [{"change": "one part a body", "part": 0, "bodies": [[40, 40], [50, 50]]}]
    assert "tried on the chosen one" not in page(d, [], "run") and "sought in what" not in page(d, [], "run")
    d["discovery"]["reconsidered"] = [{"change": "sought", "type": "revolute", "proposed": 0.31, "own_share": 0.38}]
    told = page(d, [], "run")
    assert "sought in what no part explains" in told and "31.0%" in told and "38.0%" in told


def test_without_discovery_and_without_parts(tmp_path):
    stages, twin, views = small_run()
    d = write_diagnosis(tmp_path, replace(stages, motions=None), twin, views, min_margin=0.1)
    assert d["motion_evidence"] is None and "discovery" not in d["joints"][0]["confidence_by_stage"]
    states, labels, views = two_states(hinge())
    learned = replace(stages.learned, probs=torch.tensor([[1.0, 0.0]]).expand(len(labels), 2))
    twin, notes, record = finish(learned, states, views, FinishConfig(), Similarity(), seed=0, backend="auto")
    d = write_diagnosis(
        tmp_path, replace(stages, learned=learned, record=record, notes=notes), twin, views, min_margin=0.1
    )
    assert d["joints"] == [] and d["finish"]["parts"] == 1
    assert any("slot 1 of 1 vanished" in v["text"] for v in d["verdict"])


def test_a_spare_slot_that_became_a_part(tmp_path):
    stages, _, views = small_run()
    states, labels, _ = two_states(hinge())
    learned, labels, moving = stages.learned, labels.clone(), (labels == 1).nonzero()[:, 0]
    labels[moving[: len(moving) // 2]] = 2
    probs = torch.nn.functional.one_hot(labels, 3).float()
    both = torch.cat([learned.transforms, learned.transforms])
    learned = Articulation(learned.gaussians, probs, ["revolute", "free"], both, torch.ones(2), 0.0)
    config = FinishConfig(polish=PolishConfig(steps=0), clean_neighbours=0, islands=0.0)
    twin, notes, record = finish(learned, states, views, config, Similarity(), seed=0, backend="auto")
    stages = replace(stages, learned=learned, record=record, notes=notes)
    d = write_diagnosis(tmp_path, stages, twin, views, min_margin=0.1)
    found, spare = d["articulation"]["joints"]
    assert found["moved"] == 0 and spare == {"slot": 2, "type": "free", "moved_degrees": None, "moved": None}
    assert record.slots == [1, 2] and [row["slot"] for row in d["joints"]] == [1, 2]


def test_fog_is_counted():
    states, _, views = two_states(hinge())
    g = states[0].gaussians
    half = replace(g, opacity_logits=torch.where(torch.arange(len(g)) % 2 == 0, 0.0, 3.0))
    clear, foggy = (reconstruction(x, views[0], 64) for x in (g, half))
    assert clear["fog"] == 0 and foggy["fog"] == 0.5 and foggy["psnr"] < clear["psnr"]


def test_plain_rounds_and_drops_what_json_has_not():
    assert plain({"a": float("nan"), "b": [1 / 3], 2: torch.tensor([1, 2])}) == {
        "a": None,
        "b": [0.333333],
        "2": [1, 2],
    }
    nothing = JointEvidence(0.0, 0.0, float("nan"), 0.0, 0.0, 0.0, 0)
    assert plain(nothing.as_dict())["residual"] is None and nothing.confidence == 0
