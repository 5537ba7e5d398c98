"""The ``viewer`` callback: what it draws of each phase, when, and that it is off unless named."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from p2gs.callbacks.base import CALLBACKS
from p2gs.callbacks.viewer import Viewer, as_object
from p2gs.config.run import load_config
from p2gs.gaussians.handover import Articulation, CanonicalGaussians, StateGaussians
from p2gs.ops import se3
from p2gs.types import GaussianTensors, Similarity, UserError

N = 30


def gaussians():
    g = torch.Generator().manual_seed(0)
    quats = torch.randn(N, 4, generator=g)
    return GaussianTensors(
        torch.rand(N, 3, generator=g), quats, torch.full((N, 3), -4.0), torch.zeros(N), torch.zeros(N, 1, 3)
    )


def labels():
    return torch.arange(N) % 3


class Handle(SimpleNamespace):
    """Anything viser gives back: keeps what it was made with and the functions that listen to it."""

    def on_update(self, listener):
        self.listener = listener
        return listener

    def remove(self):
        self.removed = True


class Server:
    """The part of viser.ViserServer that the viewer uses."""

    def __init__(self, host, port, label, verbose):
        self.where, self.nodes, self.controls = (host, port), {}, {}
        self.scene = self.gui = self

    def set_up_direction(self, up): ...

    def get_port(self):
        return self.where[1]

    def add_checkbox(self, label, initial_value):
        return self.controls.setdefault(label, Handle(value=initial_value))

    def add_slider(self, label, **options):
        return self.controls.setdefault(label, Handle(value=options["initial_value"]))

    def _node(self, name, *args, **options):
        self.nodes[name] = Handle(**{**options, "args": args})
        return self.nodes[name]

    add_frame = add_gaussian_splats = add_line_segments = add_camera_frustum = _node


@pytest.fixture
def viser(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=Server))
    monkeypatch.setattr(Viewer, "_stages", {})


SIM = Similarity(2.0, (0.1, 0.2, 0.3))
SCENE = SimpleNamespace(name="toy", similarity=SIM, views=())


def phase(made, step, **more):
    return SimpleNamespace(hand_over=lambda: made, step=step, total_steps=100, **more)


def articulation():
    axis, origin = torch.tensor([0.0, 0, 1]).double(), torch.tensor([0.3, 0.4, 0.0]).double()
    slide = torch.eye(4, dtype=torch.float64)
    slide[0, 3] = 0.4
    T = torch.stack([se3.from_screw(axis, origin, torch.tensor(1.0).double()), slide])
    probs = torch.nn.functional.one_hot(labels(), 3).float()
    return Articulation(gaussians(), probs, ["revolute", "prismatic"], T, torch.ones(2), 0.0)


def test_off_unless_named():
    assert "viewer" in CALLBACKS
    assert not Viewer.changes_result
    plain = load_config(["configs/preset/cpu.yaml"])
    assert all("viewer" not in p.callbacks for p in plain.phases.values())
    named = load_config(["configs/preset/cpu.yaml"], ["--callbacks.viewer.every", "7"])
    assert named.phases["articulation"].callbacks["viewer"].every == 7


def test_one_page_follows_all_phases(viser):
    first, second = Viewer(every=10), Viewer(every=10)
    first.prepare(None, SCENE)
    second.prepare(None, SCENE)
    assert len(Viewer._stages) == 1
    stage = Viewer._stages["127.0.0.1", 8080]
    first.on_step(None, phase(StateGaussians(0, gaussians()), 9))
    assert stage.obj is None  # not due
    first.on_step(None, phase(StateGaussians(0, gaussians()), 10))
    assert np.allclose(stage.server.nodes["/part_0/splats"].centers, SIM.to_input(gaussians().means), atol=1e-6)
    assert list(stage.frames) == [0] and not stage.sliders
    none = torch.zeros(N)
    fused = CanonicalGaussians(
        gaussians(), torch.ones(1), labels(), none, none > 0, gaussians().means, gaussians().means
    )
    second.on_step(None, phase(fused, 20))
    assert list(stage.frames) == [0, 1, 2] and not stage.sliders
    second.on_step(None, phase(articulation(), 30, screws=None))
    assert sorted(stage.sliders) == [1, 2]
    stage.sliders[2].listener(SimpleNamespace(target=SimpleNamespace(value=1.0)))
    assert np.allclose(stage.frames[2].position, [0.2, 0, 0], atol=1e-6)  # 0.4 internal units are 0.2 of the input
    second.on_step(None, phase(articulation(), 40, screws=None))
    assert np.allclose(stage.frames[2].position, [0.2, 0, 0], atol=1e-6)  # a refresh leaves the slider's state
    box = stage.by_part
    box.value = True
    box.listener(None)
    assert np.ptp(stage.splats[1][0].rgbs, axis=0).max() == 0
    first.on_step(None, phase(StateGaussians(1, gaussians()), 100))
    assert list(stage.frames) == [0] and not stage.sliders and not stage.lines


def test_joints_in_input_coordinates():
    made = articulation()
    obj = as_object(phase(made, 1, screws=None), SIM)
    hinge = obj.parts[1].joint
    assert torch.allclose(hinge.origin[:2], SIM.to_input(torch.tensor([[0.3, 0.4, 0.0]]))[0, :2].double(), atol=1e-6)
    assert hinge.motion == pytest.approx(57.29578) and obj.parts[2].joint.motion == pytest.approx(0.2)
    assert as_object(phase(object(), 1), SIM) is None


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(Viewer, "_stages", {})
    with pytest.raises(UserError, match=r"pip install 'p2gs\[viewer\]'"):
        Viewer().prepare(None, SCENE)
