"""The pictures of docs/simulators: a twin that each simulator loads, opens and draws.

    python docs/simulators/pictures.py NAME FOLDER OUT.jpg

NAME: mujoco, pybullet, sapien, genesis or newton.  FOLDER: has twin.urdf and twin.xml. Without a display MuJoCo wants
MUJOCO_GL=egl or osmesa, Newton PYGLET_HEADLESS=true, SAPIEN a Vulkan device (a software one does: SwiftShader, Mesa's
lavapipe from 24.3 on).
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 480, 360
# of the demo's cabinet; radians from top to bottom
TARGET, EYE, FIELD = np.array([-0.3, -0.05, 0.0]), np.array([1.45, -1.75, 1.15]), 0.6
OPEN = 0.7  # share of the recorded motion


def opened(folder: Path) -> dict[str, float]:
    """Joint positions, OPEN of the way from start to end."""
    limits = {j.get("name"): j.find("limit") for j in ET.parse(folder / "twin.urdf").findall("joint") if j.get("type") != "fixed"}
    return {name: OPEN * max((float(x.get("lower")), float(x.get("upper"))), key=abs) for name, x in limits.items()}


def mujoco(folder: Path) -> np.ndarray:
    import mujoco

    spec = mujoco.MjSpec.from_file(str(folder / "twin.xml"))
    spec.worldbody.add_light(pos=EYE * 2, dir=TARGET - EYE, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT, "width": 8, "height": 8}
    spec.add_texture(name="sky", rgb1=[0.9] * 3, rgb2=[0.9] * 3, **sky)
    model = spec.compile()
    model.vis.global_.fovy = np.degrees(FIELD)
    data = mujoco.MjData(model)
    for name, value in opened(folder).items():
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    back = TARGET - EYE
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = TARGET, np.linalg.norm(back)
    camera.azimuth, camera.elevation = np.degrees(np.arctan2(back[1], back[0])), np.degrees(np.arcsin(back[2] / camera.distance))
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def pybullet(folder: Path) -> np.ndarray:
    import pybullet as p

    p.connect(p.DIRECT)
    twin = p.loadURDF(str(folder / "twin.urdf"), useFixedBase=True)
    for j in range(p.getNumJoints(twin)):
        p.resetJointState(twin, j, opened(folder)[p.getJointInfo(twin, j)[1].decode()])
    view = p.computeViewMatrix(EYE.tolist(), TARGET.tolist(), [0, 0, 1])
    lens = p.computeProjectionMatrixFOV(np.degrees(FIELD), WIDTH / HEIGHT, 0.1, 20)
    image = p.getCameraImage(WIDTH, HEIGHT, view, lens, lightDirection=(EYE * [0.5, 1, 2]).tolist(), renderer=p.ER_TINY_RENDERER)[2]
    return np.reshape(image, (HEIGHT, WIDTH, 4))[..., :3].astype(np.uint8)


def sapien(folder: Path) -> np.ndarray:
    import sapien

    scene = sapien.Scene()
    scene.set_ambient_light([0.5] * 3)
    scene.add_directional_light((TARGET - EYE).tolist(), [2] * 3)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    twin = loader.load(str(folder / "twin.urdf"))
    twin.set_qpos([opened(folder)[j.name] for j in twin.active_joints])
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    left = np.cross([0, 0, 1], forward)
    left /= np.linalg.norm(left)
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = np.stack([forward, left, np.cross(forward, left)], 1), EYE
    camera = scene.add_camera("camera", WIDTH, HEIGHT, FIELD, 0.05, 50)
    camera.entity.set_pose(sapien.Pose(place))
    scene.step()
    scene.update_render()
    camera.take_picture()
    return (camera.get_picture("Color")[..., :3].clip(0, 1) * 255).astype(np.uint8)


def genesis(folder: Path) -> np.ndarray:
    import genesis as gs

    gs.init(backend=gs.cpu)
    scene = gs.Scene(show_viewer=False)
    twin = scene.add_entity(gs.morphs.URDF(file=str(folder / "twin.urdf"), fixed=True))
    camera = scene.add_camera(res=(WIDTH, HEIGHT), pos=EYE, lookat=TARGET, fov=np.degrees(FIELD))
    scene.build()
    twin.set_dofs_position([opened(folder)[j.name] for j in twin.joints if j.n_dofs])
    scene.visualizer.update()
    return np.asarray(camera.render()[0])[..., :3]


def newton(folder: Path) -> np.ndarray:
    import newton
    import warp as wp
    from newton.viewer import ViewerGL

    builder = newton.ModelBuilder()
    builder.add_urdf(str(folder / "twin.urdf"), floating=False)
    model = builder.finalize(device="cpu")
    state, values = model.state(), opened(folder)
    names = [label.split("/")[-1] for label in model.joint_label]
    state.joint_q.assign([values[n] for n in names if n in values])
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    viewer = ViewerGL(width=WIDTH, height=HEIGHT, headless=True)
    viewer.set_model(model)
    forward = TARGET - EYE
    pitch = np.degrees(np.arcsin(forward[2] / np.linalg.norm(forward)))
    viewer.set_camera(wp.vec3(*EYE), float(pitch), float(np.degrees(np.arctan2(forward[1], forward[0]))))
    for _ in range(2):
        viewer.begin_frame(0.0)
        viewer.log_state(state)
        viewer.end_frame()
    return viewer.get_frame().numpy()[..., :3]


if __name__ == "__main__":
    simulator, folder, out = sys.argv[1:]
    draw = {"mujoco": mujoco, "pybullet": pybullet, "sapien": sapien, "genesis": genesis, "newton": newton}[simulator]
    Image.fromarray(draw(Path(folder))).save(out, quality=85)
