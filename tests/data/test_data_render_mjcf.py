"""MJCF for ``p2gs data render``: where bodies stand, with MuJoCo as the oracle; what is left out; mistakes."""

import numpy as np
import pytest

from p2gs.data.render.scene import read_asset
from p2gs.types import UserError

MODEL = """<mujoco><compiler angle="degree"/>
  <default><material rgba="0.2 0.3 0.4 1"/></default>
  <asset><material name="plain"/></asset>
  <worldbody><body name="base" pos="0.1 0.2 0.3" xyaxes="0 2 0 -1 0.5 0"><freejoint/>
    <geom name="seen" type="box" size="0.1 0.2 0.3" material="plain"/><geom type="box" size="9 9 9" rgba="1 0 0 0"/>
    <frame pos="0.5 0 0" euler="0 0 30">
      <geom type="capsule" size="0.05" fromto="0 0 0 0 0.2 0.4"/>
      <frame pos="0 0.1 0" axisangle="1 0 0 40">
        <body name="door" pos="0 0 0.2" euler="10 20 30"><joint name="hinge" axis="0 1 1" pos="0.1 0 0" ref="25"
          range="0 90"/><geom type="sphere" size="0.1"/>
          <body name="tray" pos="0 0.3 0"><frame pos="0 0 0.1" euler="0 90 0"><joint name="slide" type="slide"
            axis="1 0 0" ref="0.1" range="0 0.5"/></frame><geom type="ellipsoid" size="0.1 0.2 0.3"/></body></body>
      </frame></frame></body></worldbody></mujoco>"""


def read(tmp_path, text=MODEL):
    path = tmp_path / "model.xml"
    path.write_text(text)
    return read_asset(path)


@pytest.mark.parametrize("hinge, slide", [(25, 0.1), (0, 0.0), (80, 0.4)])
def test_bodies_stand_where_mujoco_has_them(tmp_path, hinge, slide):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    for name, value in (("hinge", np.radians(hinge)), ("slide", slide)):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    poses = read(tmp_path).poses({"hinge": np.radians(hinge), "slide": slide})
    for name in ("base", "door", "tray"):
        np.testing.assert_allclose(poses[name][:3, 3], data.body(name).xpos, atol=1e-9)
        np.testing.assert_allclose(poses[name][:3, :3], data.body(name).xmat.reshape(3, 3), atol=1e-9)


def test_a_model_that_is_not_told_stands_at_its_reference(tmp_path):
    asset = read(tmp_path)
    told = asset.poses({"hinge": np.radians(25), "slide": 0.1})
    for name, pose in asset.poses({}).items():
        np.testing.assert_allclose(pose, told[name], atol=1e-12)


def test_shapes_in_frames_are_there_and_unseen_ones_are_not(tmp_path):
    box, capsule = read(tmp_path).links["base"]
    np.testing.assert_allclose(np.abs(box.vertices).max(0), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(box.colour, [0.2, 0.3, 0.4])
    turned = np.array([0.5 - 0.1 * np.sin(np.radians(30)), 0.1 * np.cos(np.radians(30)), 0.2])
    np.testing.assert_allclose((capsule.vertices.min(0) + capsule.vertices.max(0)) / 2, turned, atol=1e-3)


@pytest.mark.parametrize(
    "old, new, told",
    [
        ('size="0.1 0.2 0.3"/></body>', 'size="0.1 wide 0.3"/></body>', "expected 3 numbers"),
        ('size="0.05" fromto', "fromto", "a capsule wants 2 positive sizes, got 'None'"),
        ('type="sphere" size="0.1"', 'type="sphere" size="-1"', "a sphere wants 1 positive sizes"),
        ('xyaxes="0 2 0 -1 0.5 0"', 'xyaxes="0 2 0 0 1 0"', "has no direction"),
        ('type="slide"', 'type="ball"', "a joint of type 'ball' is not known"),
    ],
)
def test_a_broken_model_is_one_sentence(tmp_path, old, new, told):
    assert old in MODEL
    with pytest.raises(UserError, match=told):
        read(tmp_path, MODEL.replace(old, new))
