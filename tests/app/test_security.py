"""Files of strangers: nothing is unpickled or run, names are no markup, the viewer is for this machine alone.
SECURITY.md says the same."""

import ast
import inspect
import io
import json
import os
from pathlib import Path

import pytest
import torch

from p2gs.app import parser
from p2gs.callbacks.viewer import Viewer
from p2gs.config.run import load_config
from p2gs.gaussians import handover
from p2gs.gaussians.sealed import Damaged, check_seal, seal
from p2gs.types import GaussianTensors, UserError

PACKAGE = Path(__file__).parents[2] / "p2gs"


def calls():
    """(file, dotted name, call) of every call in the package."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                yield path.relative_to(PACKAGE), ast.unparse(node.func), node


def option(call: ast.Call, name: str):
    return next((ast.unparse(k.value) for k in call.keywords if k.arg == name), None)


def test_nothing_is_loaded_unrestricted():
    found, wrong = set(), []
    for path, name, call in calls():
        if name in ("torch.load", "trainer.fit"):
            found.add(name)
            wrong += [f"{path}: {name} without weights_only=True"] * (option(call, "weights_only") != "True")
        elif name == "np.load":
            wrong += [f"{path}: np.load with pickles"] * (option(call, "allow_pickle") not in (None, "False"))
        elif name == "yaml.load":
            loader = option(call, "Loader") or ""
            found.add(name)
            wrong += [f"{path}: yaml.load with {loader or 'no loader'}"] * (
                loader != "_StrictLoader" and "SafeLoader" not in loader
            )
        elif name in ("yaml.unsafe_load", "yaml.full_load", "eval", "exec", "os.system", "pickle.loads", "pickle.load"):
            wrong.append(f"{path}: {name}")
        elif name.startswith("subprocess."):
            wrong += [f"{path}: {name} through a shell"] * (option(call, "shell") is not None)
    assert not wrong and found == {"torch.load", "trainer.fit", "yaml.load"}, wrong


def test_no_module_that_unpickles_is_imported():
    names = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names |= {a.name for a in node.names} if isinstance(node, ast.Import) else {getattr(node, "module", None)}
    assert not {str(n).split(".")[0] for n in names} & {"pickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}


class Bomb:
    """Pickled, it makes a file when it is loaded without restriction."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_checkpoint_that_would_run_something_is_damaged(tmp_path):
    """Its checksum is right: whoever made it made that, too."""
    proof, path, data = tmp_path / "ran", tmp_path / "single_state_0.pt", io.BytesIO()
    torch.save({"header": {"key": "k"}, "value": Bomb(proof)}, data)
    (tmp_path / "part").write_bytes(data.getvalue())
    seal(tmp_path / "part", path)
    check_seal(path)
    with pytest.raises(Damaged, match="no result of a stage"):
        handover.load(path)
    assert not proof.exists()
    torch.load(path, weights_only=False)  # what the restriction is for
    assert proof.exists()


def test_a_config_that_would_run_something_is_refused(tmp_path):
    proof = tmp_path / "ran"
    (tmp_path / "bad.yaml").write_text(
        f"seed: !!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{proof}']]\n"
    )
    with pytest.raises(UserError, match="bad.yaml, line 1: could not determine a constructor"):
        load_config([str(tmp_path / "bad.yaml")])
    assert not proof.exists()


def test_an_option_that_holds_anything_makes_no_object(tmp_path):
    from p2gs.bench.options import BenchOptions
    from p2gs.config.schema import Given

    proof = tmp_path / "ran"
    told = {"class_path": "subprocess.Popen", "init_args": {"args": ["touch", str(proof)]}}
    options = Given(BenchOptions, {"set": {"phases.x": told}, "slurm": {"extra": told}}).make()
    assert options.set == {"phases.x": told} and options.slurm.extra == told
    (tmp_path / "t.yaml").write_text(json.dumps({"trainer": {"logger": told}}))
    assert load_config([str(tmp_path / "t.yaml")]).trainer == {"logger": told} and not proof.exists()


@pytest.mark.parametrize("how", ["flipped", "cut", "emptied", "unsealed"])
def test_the_checksum_tells(tmp_path, how):
    path, n = tmp_path / "a.pt", 20
    values = torch.arange(3.0 * n).reshape(n, 3)
    g = GaussianTensors(values, torch.ones(n, 4), values, values[:, 0], values[:, None])
    handover.save(handover.StateGaussians(0, g), path, key="k")
    loaded, header = handover.load(path)
    assert header == {"key": "k"} and torch.equal(loaded.gaussians.means, values)
    data = bytearray(path.read_bytes())
    if how == "flipped":
        data[data.index(values.numpy().tobytes()[40:60])] ^= 1  # in a tensor, where torch itself notices nothing
    changed = {"flipped": data, "cut": data[:-1], "emptied": b"", "unsealed": data[:-40]}[how]
    path.write_bytes(changed)
    with pytest.raises(Damaged):
        handover.load(path)


EVIL = "<script>alert(1)<x>"


@pytest.mark.timeout(20)
def test_a_pipe_in_place_of_a_checkpoint_is_damaged(tmp_path):
    """To open it would wait for ever (found by make fuzz, mutant 1646 of seed 1)."""
    os.mkfifo(tmp_path / "articulation.pt")
    with pytest.raises(Damaged, match="it is no file"):
        handover.load(tmp_path / "articulation.pt")


def test_names_are_text_in_the_report(tmp_path):
    from p2gs.export.pages.report import write_report
    from p2gs.gaussians.splat_ply import write_splat_ply
    from p2gs.gaussians.twin_json import write_twin_json

    run, obj = tmp_path / EVIL, one_part()
    write_splat_ply(run / "splats" / "canonical.ply", obj.gaussians, obj.part_ids)
    write_twin_json(obj, run / "twin.json")
    views = {EVIL: {"split": EVIL, "count": 2, "psnr_white": 31.0}}
    (run / "metrics.json").write_text(json.dumps({"views": views, "missing": [EVIL]}))
    (run / "logs").mkdir()
    (run / "logs" / "stages.json").write_text(json.dumps({EVIL: {"seconds": 1.0, "peak_memory_mib": 1}}))
    page = write_report(run).read_text()
    assert "<script>alert" not in page and page.count("&lt;script&gt;alert(1)&lt;x&gt;") >= 5


def test_a_part_is_no_markup(tmp_path):
    from p2gs.gaussians.twin_json import read_twin_json

    joint = {
        "type": EVIL,
        "axis": [0, 0, 1],
        "origin": [0, 0, 0],
        "motion": 1,
        "limits": [0, 1],
        "transform": torch.eye(4).tolist(),
    }
    parts = [{"id": 0, "kind": "static"}, {"id": 1, "kind": "movable", "joint": joint}]
    (tmp_path / "twin.json").write_text(json.dumps({"format": "p2gs-twin/1", "canonical_time": 0.5, "parts": parts}))
    with pytest.raises(UserError, match="twin.json: part 1 cannot be read"):
        read_twin_json(tmp_path / "twin.json")


def one_part():
    from p2gs.types import ArticulatedObject, Part

    g = GaussianTensors(
        torch.rand(20, 3), torch.ones(20, 4), torch.full((20, 3), -3.0), torch.ones(20), torch.zeros(20, 1, 3)
    )
    return ArticulatedObject(g, torch.zeros(20, dtype=torch.int64), [Part(0)], 0.0)


def test_the_viewer_is_for_this_machine_unless_told():
    from p2gs.export.pages.viewer import Stage, open_viewer

    hosts = {parser().parse_args(["view", "RUN"]).host, Viewer().host}
    hosts |= {inspect.signature(f).parameters["host"].default for f in (Stage.__init__, open_viewer)}
    assert hosts == {"127.0.0.1"}
