import json

import pytest
import torch

from p2gs.bench import kernels
from p2gs.bench.scene import bench_scene
from p2gs.native import native
from p2gs.types import UserError


def test_scene_is_what_the_figures_are_quoted_for():
    scene = bench_scene(3000, 100)
    assert all(t.dtype == torch.float32 and len(t) == 3000 for t in scene.tensors())
    assert 0.1 <= scene.opacities.min() and scene.opacities.max() <= 0.95
    assert scene.sh.shape == (3000, 16, 3)
    again = bench_scene(3000, 100)
    assert all(torch.equal(a, b) for a, b in zip(scene.tensors(), again.tensors(), strict=True))
    from p2gs.render import rasterize

    c = scene.camera
    alpha = rasterize(*scene.tensors(), c.viewmat, c.K, c.width, c.height).alpha
    assert 0.3 < (alpha > 0.5).float().mean() < 0.5


@pytest.mark.skipif(native is None, reason="p2gs was installed without its native kernels")
def test_rows_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(kernels, "COUNTS", (500,))
    monkeypatch.setattr(kernels, "SIZES", (40,))
    monkeypatch.setattr(kernels, "QUICK_COUNTS", (500,))
    monkeypatch.setattr(kernels, "QUICK_SIZES", (40,))
    torch.set_num_threads(2)
    isa = native.isa()
    assert kernels.main(["--quick", "--all-isas", "--json", str(tmp_path / "rows.json")]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    fast = [r for r in rows if r["backend"] == "cpu"]
    assert {(r["isa"], r["threads"]) for r in fast} == {(i, t) for i in native.available_isas() for t in (1, 2)}
    assert all(r["rel_grad_err"] < 1e-5 and r["speedup"] > 0 and r["step_ms"] > 0 for r in fast)
    assert len([r for r in rows if r["backend"] == "torch_ref"]) == 2
    assert torch.get_num_threads() == 2 and native.isa() == isa
    assert "torch_ref" in capsys.readouterr().out
    assert kernels.main(["--quick", "--json"]) == 0  # no file: the rows alone on standard output
    out, err = capsys.readouterr()
    assert {r["backend"] for r in json.loads(out)} == {"cpu", "torch_ref"} and "torch_ref" in err


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda_is_told():
    with pytest.raises(UserError, match="no CUDA device"):
        kernels.bench_kernels(device="cuda")
