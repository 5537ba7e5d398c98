"""A twin in physics engines: does every joint reach both of its limits under a small force, and does it lie still under
gravity?

MuJoCo, PyBullet and SAPIEN, whichever are installed (``pip install p2gs[validate]``). Parts collide with the base and
with each other, also with the part they hang on, which engines leave out unless asked.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Protocol
from xml.etree import ElementTree as ET

import numpy as np

STEP = 1 / 500  # s, of all engines
SWEEP = 4.0  # s that a joint gets for its range each way; the force takes it there in about one
NEAR = 0.02  # share of the range within which a limit counts as reached
REST = 2.0  # s under gravity, after which joints are to lie still
STILL = 0.01  # rad/s or m/s


class Engine(Protocol):
    """A twin loaded in an engine. All arrays [J] in the order of ``names``: radians, metres, N m, N."""

    names: list[str]

    def put(self, positions: np.ndarray) -> None:
        """Set the joints' positions, at rest."""

    def hold(self, positions: np.ndarray, free: int) -> None:
        """Put all joints but ``free`` back, at rest."""

    def step(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One time step under these joint forces; positions and velocities after it."""

    def gravity(self, on: bool) -> None:
        """Switch gravity."""


@dataclass(frozen=True)
class JointFacts:
    """lower, upper: limits.  end: of the recorded motion.  damping: as the URDF has it."""

    name: str
    lower: float
    upper: float
    end: float
    damping: float


@dataclass(frozen=True)
class EngineResult:
    """reached: of each joint, the lowest and highest share of its range it got to (0 and 1 are its limits).  speed: the
    fastest joint's after two seconds under gravity, from each recorded state [rad/s or m/s].  missing: joints of
    twin.urdf that the engine lacks."""

    engine: str
    reached: dict[str, tuple[float, float]]
    speed: tuple[float, float]
    missing: tuple[str, ...] = ()

    @property
    def problems(self) -> list[str]:
        """One sentence each; empty where all is well."""
        out = [f"{name} of twin.urdf is not there" for name in self.missing]
        out += [
            f"{name} moves from {100 * lo:.0f} to {100 * hi:.0f} % of its range, not from 0 to 100"
            for name, (lo, hi) in self.reached.items()
            if lo > NEAR or hi < 1 - NEAR
        ]
        for state, speed in zip(("start", "end"), self.speed, strict=True):
            if speed > STILL:
                out.append(
                    f"from the {state} state a joint still moves at {speed:.3f} per s after {REST:g} s under gravity"
                )
        return out

    @property
    def remark(self) -> str:
        """How far the joint that went least went, and the fastest motion at rest."""
        least = min((hi - lo for lo, hi in self.reached.values()), default=0.0)
        return (
            f"{len(self.reached)} joints, each through {100 * least:.0f} % of its range or more; at rest "
            f"{max(self.speed):.1g} per s"
        )


def joint_facts(urdf: Path) -> list[JointFacts]:
    """The moving joints of a URDF; the recorded end is the limit that is not zero (the farther one, where the range was
    extended)."""
    out = []
    for joint in ET.parse(urdf).getroot().findall("joint"):
        if joint.get("type") not in ("revolute", "prismatic"):
            continue
        limit, dynamics = joint.find("limit"), joint.find("dynamics")
        lower, upper = float(limit.get("lower")), float(limit.get("upper"))
        end = upper if abs(upper) >= abs(lower) else lower
        out.append(JointFacts(joint.get("name"), lower, upper, end, float(dynamics.get("damping"))))
    return out


def run_engine(name: str, engine: Engine, facts: list[JointFacts]) -> EngineResult:
    """Sweep every joint, the others held in the recorded state that lets it go further, then let all lie from both
    recorded states."""
    order = [next(f for f in facts if f.name == n) for n in engine.names]
    missing = tuple(f.name for f in facts if f.name not in engine.names)
    end = np.array([f.end for f in order])
    engine.gravity(False)
    reached = {f.name: _best_sweep(engine, order, i, end) for i, f in enumerate(order)}
    engine.gravity(True)
    speeds = []
    for share in (0.0, 1.0):
        engine.put(share * end)
        velocity = np.zeros(len(order))
        for _ in range(round(REST / STEP)):
            _, velocity = engine.step(np.zeros(len(order)))
        speeds.append(float(np.abs(velocity).max(initial=0.0)))
    return EngineResult(name, reached, (speeds[0], speeds[1]), missing)


def _best_sweep(engine: Engine, facts: list[JointFacts], i: int, end: np.ndarray) -> tuple[float, float]:
    """Of joint ``i`` with the others all at the start, all at the end, or one of them at the end, whichever lets it go
    farthest."""
    single = [row for k, row in enumerate(np.eye(len(facts))) if k != i]
    best = (1.0, 0.0)
    for share in (np.zeros(len(facts)), np.ones(len(facts)), *single):
        found = _sweep(engine, facts[i], i, share * end)
        if found[1] - found[0] > best[1] - best[0]:
            best = found
        if best[0] <= NEAR and best[1] >= 1 - NEAR:
            break
    return best


def _sweep(engine: Engine, joint: JointFacts, i: int, held: np.ndarray) -> tuple[float, float]:
    """Lowest and highest share of the range that joint ``i`` gets to from ``held``, pushed to one end and then to the
    other."""
    span = max(joint.upper - joint.lower, 1e-9)
    place, low, high = held.copy(), 1.0, 0.0
    engine.put(place)
    for sign in (1.0, -1.0):
        forces = np.zeros(len(held))
        forces[i] = sign * 2.0 * joint.damping * span
        for _ in range(round(SWEEP / STEP)):
            at, _ = engine.step(forces)
            place = held.copy()
            place[i] = at[i]
            share = (at[i] - joint.lower) / span
            low, high = min(low, float(share)), max(high, float(share))
            if np.abs(np.delete(at - held, i)).max(initial=0.0) > 1e-6:  # the others stay where they are
                engine.hold(place, i)
            if (share > 1 - NEAR / 2) if sign > 0 else (share < NEAR / 2):
                break
    return low, high


class MuJoCo:
    """twin.xml in MuJoCo."""

    def __init__(self, folder: Path):
        import mujoco

        self.lib = mujoco
        self.model = mujoco.MjModel.from_xml_path(str(folder / "twin.xml"))
        self.model.opt.timestep = STEP
        self.data, self.down = mujoco.MjData(self.model), self.model.opt.gravity.copy()
        self.names = [self.model.joint(i).name for i in range(self.model.njnt) if self.model.jnt_type[i] != 0]
        self.q = [int(self.model.joint(n).qposadr[0]) for n in self.names]
        self.v = [int(self.model.joint(n).dofadr[0]) for n in self.names]

    def gravity(self, on: bool) -> None:
        self.model.opt.gravity[:] = self.down if on else 0

    def put(self, positions: np.ndarray) -> None:
        self.lib.mj_resetData(self.model, self.data)
        self.data.qpos[self.q] = positions
        self.lib.mj_forward(self.model, self.data)

    def hold(self, positions: np.ndarray, free: int) -> None:
        speed = self.data.qvel[self.v[free]]
        self.data.qvel[:] = 0
        self.data.qpos[self.q], self.data.qvel[self.v[free]] = positions, speed

    def step(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.data.qfrc_applied[self.v] = forces
        self.lib.mj_step(self.model, self.data)
        return self.data.qpos[self.q].copy(), self.data.qvel[self.v].copy()


class PyBullet:
    """twin.urdf in PyBullet, its base fixed, parts colliding with what they hang on."""

    def __init__(self, folder: Path):
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        self.p = BulletClient(pybullet.DIRECT)
        flags = (
            pybullet.URDF_USE_SELF_COLLISION
            | pybullet.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
            | pybullet.URDF_USE_INERTIA_FROM_FILE
        )
        self.body = self.p.loadURDF(str(folder / "twin.urdf"), useFixedBase=True, flags=flags)
        self.p.setTimeStep(STEP)
        infos = [self.p.getJointInfo(self.body, i) for i in range(self.p.getNumJoints(self.body))]
        moving = [info for info in infos if info[2] in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)]
        self.names, self.index = [info[1].decode() for info in moving], [info[0] for info in moving]
        # it reads a joint's friction and leaves it to its users; the motor of its own would brake every joint
        for info in moving:
            self.p.setJointMotorControl2(self.body, info[0], pybullet.VELOCITY_CONTROL, targetVelocity=0, force=info[7])

    def gravity(self, on: bool) -> None:
        self.p.setGravity(0, 0, -9.81 if on else 0)

    def put(self, positions: np.ndarray) -> None:
        for i, q in zip(self.index, positions, strict=True):
            self.p.resetJointState(self.body, i, float(q), 0.0)

    def hold(self, positions: np.ndarray, free: int) -> None:
        for k, (i, q) in enumerate(zip(self.index, positions, strict=True)):
            if k != free:
                self.p.resetJointState(self.body, i, float(q), 0.0)

    def step(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for i, f in zip(self.index, forces, strict=True):
            self.p.setJointMotorControl2(self.body, i, self.p.TORQUE_CONTROL, force=float(f))
        self.p.stepSimulation()
        states = self.p.getJointStates(self.body, self.index)
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])


def load_in_sapien(path: Path):
    """SAPIEN's scene, its PhysX on the CPU and the articulation of a URDF, its root fixed, without what it shows:
    drawing needs a Vulkan device."""
    import tempfile
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no Vulkan
        import sapien

    system = sapien.physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.set_timestep(STEP)
    tree = ET.parse(path)
    for link in tree.getroot().findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", dir=path.parent) as file:
        file.write(ET.tostring(tree.getroot(), encoding="unicode"))
        file.flush()
        loader = scene.create_urdf_loader()
        loader.fix_root_link = True
        return scene, system, loader.load(file.name)


class Sapien:
    """twin.urdf in SAPIEN."""

    def __init__(self, folder: Path):
        self.scene, self.system, self.twin = load_in_sapien(folder / "twin.urdf")
        self.names = [j.name for j in self.twin.active_joints]

    def gravity(self, on: bool) -> None:
        for link in self.twin.links:
            link.disable_gravity = not on

    def put(self, positions: np.ndarray) -> None:
        self.twin.set_qpos(np.asarray(positions, np.float32))
        self.twin.set_qvel(np.zeros(len(self.names), np.float32))

    def hold(self, positions: np.ndarray, free: int) -> None:
        speed = np.zeros(len(self.names), np.float32)
        speed[free] = self.twin.get_qvel()[free]
        self.twin.set_qpos(np.asarray(positions, np.float32))
        self.twin.set_qvel(speed)

    def step(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.twin.set_qf(np.asarray(forces, np.float32))
        self.scene.step()
        return self.twin.get_qpos().astype(float), self.twin.get_qvel().astype(float)


ENGINES: dict[str, Callable[[Path], Engine]] = {"mujoco": MuJoCo, "pybullet": PyBullet, "sapien": Sapien}


def installed(name: str) -> bool:
    """Whether the Python package of that name is there."""
    return importlib.util.find_spec(name) is not None


def check_engine(name: str, folder: Path) -> EngineResult:
    """The twin in FOLDER (twin.urdf, twin.xml, z up) in one of ``ENGINES``."""
    return run_engine(name, ENGINES[name](Path(folder)), joint_facts(Path(folder) / "twin.urdf"))
