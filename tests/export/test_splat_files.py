"""splats.glb and the splats in USD: by other readers, the Gaussians of the twin in both states, in the parts' own
frames."""

import gzip
import json
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_clearance import cabinet
from test_engines import with_looks
from toy import toy_twin

from p2gs.export.asset import Asset, placement
from p2gs.export.files.splats_gltf import write_splats
from p2gs.export.files.splats_spz import write_spz
from p2gs.export.files.usd import write_usd
from p2gs.gaussians.pose import pose
from p2gs.ops.sh import evaluate
from p2gs.types import ArticulatedObject

PREFIX = "KHR_gaussian_splatting:"
UPS = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}


def with_splats(up: str, scale: float = 0.5, degree: int = 2) -> tuple[Asset, ArticulatedObject]:
    """The toy's joints and Gaussians (all of one shape and turn, so they get others) under links of the cabinet's
    names."""
    twin, g = toy_twin(sh_degree=degree), torch.Generator().manual_seed(0)
    n = len(twin.gaussians)
    twin.gaussians.quats = torch.randn(n, 4, generator=g)
    twin.gaussians.log_scales = torch.randn(n, 3, generator=g) - 4
    twin.gaussians.opacity_logits = torch.randn(n, generator=g)
    place = placement(np.zeros((1, 3)), scale, up, "keep")
    links = []
    for link, part in zip(with_looks(cabinet()), twin.parts, strict=True):
        joint = None
        if part.joint is not None:
            j, unit = part.joint, np.pi / 180 if part.joint.type == "revolute" else scale
            axis, at, motion = place.vector(j.axis.numpy()), place.points(j.origin.numpy()), j.motion * unit
            joint = replace(
                link.joint, type=j.type, axis=axis, origin=at, motion=motion, lower=min(motion, 0), upper=max(motion, 0)
            )
        origin = np.zeros(3) if joint is None else joint.origin
        links.append(
            replace(link, joint=joint, splats=place.gaussians(twin.gaussians[twin.part_ids == part.id], origin))
        )
    return Asset("cabinet", links, up), twin


def read_glb(path):
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    doc, block = json.loads(data[20 : 20 + size]), data[28 + size :]

    def array(i):
        a = doc["accessors"][i]
        view = doc["bufferViews"][a["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a["type"]]
        kind = {5126: np.float32, 5121: np.uint8}[a["componentType"]]
        return np.frombuffer(block, kind, a["count"] * width, view["byteOffset"]).reshape(-1, width).astype(float)

    return doc, array


def matrix(q):
    """Of quaternions xyzw [N, 4], by scipy."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q).as_matrix()


def covariance(R, s):
    return np.einsum("nij,nj,nkj->nik", R, s**2, R)


@pytest.mark.parametrize("state", [0, 1])
def test_the_animation_shows_the_twins_gaussians_in_both_states(state, tmp_path):
    """Centres, covariances, opacities and colours from all around of each node's splats, moved as the animation
    says."""
    asset, twin = with_splats("y")
    doc, array = read_glb(write_splats(asset, tmp_path))
    assert doc["extensionsUsed"] == ["KHR_gaussian_splatting"]
    want = pose(twin, float(state))
    channels = {c["target"]["node"]: c for c in doc["animations"][0]["channels"]}
    directions = torch.nn.functional.normalize(
        torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=-1
    ).double()
    for number, node in enumerate(doc["nodes"]):
        if "mesh" not in node:
            continue
        (primitive,) = doc["meshes"][node["mesh"]]["primitives"]
        how = primitive["extensions"]["KHR_gaussian_splatting"]
        assert primitive["mode"] == 0 and how["kernel"] == "ellipse" and how["colorSpace"] == "srgb_rec709_display"
        got = {k.removeprefix(PREFIX): array(i) for k, i in primitive["attributes"].items()}
        T, R = np.array(node["translation"]), np.eye(3)
        if state and number in channels:
            sampler = doc["animations"][0]["samplers"][channels[number]["sampler"]]
            key = array(sampler["output"])[len(array(sampler["input"])) // 2]  # the middle of the film is the end state
            T, R = (key, R) if channels[number]["target"]["path"] == "translation" else (T, matrix(key[None])[0])
        mine = twin.part_ids == asset.links[node["mesh"]].part
        g = want[mine]
        up = UPS["y"]
        assert np.allclose(got["POSITION"] @ R.T + T, 0.5 * g.means.numpy() @ up.T, atol=1e-5)
        turned = R @ matrix(got["ROTATION"])
        assert np.allclose(np.linalg.norm(got["ROTATION"], axis=1), 1, atol=1e-6)
        w, x, y, z = torch.nn.functional.normalize(g.quats, dim=-1).numpy().T
        own = covariance(up @ matrix(np.stack([x, y, z, w], 1)), 0.5 * g.log_scales.exp().numpy())
        assert np.allclose(covariance(turned, got["SCALE"]), own, atol=1e-8) and (got["SCALE"] > 0).all()
        assert np.allclose(got["OPACITY"][:, 0], torch.sigmoid(g.opacity_logits), atol=1e-6)
        names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(3) for n in range(2 * d + 1)]
        sh = torch.from_numpy(np.stack([got[n] for n in names], 1))
        seen = evaluate(sh[:, None], directions @ torch.from_numpy(R))  # readers turn the coefficients with the node
        told = evaluate(g.sh.double()[:, None], directions @ torch.from_numpy(up))
        assert torch.allclose(seen, told, atol=1e-4)


def test_readers_that_do_not_know_splats_show_coloured_points(tmp_path):
    asset, _ = with_splats("y", degree=0)
    doc, array = read_glb(write_splats(asset, tmp_path))
    colours = array(doc["meshes"][1]["primitives"][0]["attributes"]["COLOR_0"])
    srgb = np.array([0.3, 0.45, 0.7])  # the door's
    assert np.allclose(colours[:, :3] / 255, ((srgb + 0.055) / 1.055) ** 2.4, atol=0.003)


def test_usd_has_the_gaussians_under_their_rigid_body(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom, UsdValidation, UsdVol

    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        pytest.skip("this usd-core knows no splats (26.3 does)")
    asset, twin = with_splats("z")
    stage = Usd.Stage.Open(str(write_usd(asset, tmp_path)))
    for link in asset.links:
        prim = stage.GetPrimAtPath(f"/twin/{link.name}/splats")
        assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
        value = {n: prim.GetAttribute(n).Get() for n in ("positions", "orientations", "scales", "opacities")}
        place = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T
        g = twin.gaussians[twin.part_ids == link.part]
        assert np.allclose(
            np.array(value["positions"]) @ place[:3, :3].T + place[:3, 3], 0.5 * g.means.numpy(), atol=1e-5
        )
        turn = np.array([[*q.GetImaginary(), q.GetReal()] for q in value["orientations"]])
        assert np.allclose(np.linalg.norm(turn, axis=1), 1, atol=1e-5)
        w, x, y, z = torch.nn.functional.normalize(g.quats, dim=-1).numpy().T
        own = covariance(matrix(np.stack([x, y, z, w], 1)), 0.5 * g.log_scales.exp().numpy())
        assert np.allclose(covariance(matrix(turn), np.array(value["scales"])), own, atol=1e-7)
        assert np.allclose(value["opacities"], torch.sigmoid(g.opacity_logits), atol=1e-5)
        sh = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
        assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
        assert UsdGeom.Primvar(sh).GetElementSize() == 9 and UsdGeom.Primvar(sh).GetInterpolation() == "vertex"
        assert np.allclose(np.array(sh.Get()).reshape(-1, 9, 3), g.sh, atol=1e-5)
        low, high = np.array(prim.GetAttribute("extent").Get())
        points = np.array(value["positions"])
        assert (points > low).all() and (points < high).all()
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [e.GetMessage() for e in context.Validate(stage)] == []


def read_spz(path):
    """Splat by splat after the description in github.com/nianticlabs/spz: centres, opacities, colours, scales, turns
    xyzw, coefficients."""
    data = gzip.decompress(path.read_bytes())
    magic, version, n, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (data[:4], version, flags, reserved) == (b"NGSP", 3, 0, 0) and magic == 0x5053474E
    higher = [0, 3, 8, 15][degree]
    starts = np.cumsum([16, 9 * n, n, 3 * n, 3 * n, 4 * n, 3 * higher * n])
    assert len(data) == starts[-1]
    out = []
    for i in range(n):
        at = starts[0] + 9 * i
        center = [
            int.from_bytes(data[at + 3 * k : at + 3 * k + 3], "little", signed=True) / (1 << bits) for k in range(3)
        ]
        alpha = data[starts[1] + i] / 255
        colour = [(data[starts[2] + 3 * i + k] / 255 - 0.5) / 0.15 for k in range(3)]
        scale = [math.exp(data[starts[3] + 3 * i + k] / 16 - 10) for k in range(3)]
        word = int.from_bytes(data[starts[4] + 4 * i : starts[4] + 4 * i + 4], "little")
        turn, largest = [0.0] * 4, word >> 30
        for k in (k for k in (3, 2, 1, 0) if k != largest):
            turn[k] = (-1 if word >> 9 & 1 else 1) * (word & 511) / 511 / math.sqrt(2)
            word >>= 10
        turn[largest] = math.sqrt(max(0.0, 1 - sum(x * x for x in turn)))
        at = starts[5] + 3 * higher * i
        out.append((center, alpha, colour, scale, turn, [(b - 128) / 128 for b in data[at : at + 3 * higher]]))
    return [np.array(column) for column in zip(*out, strict=True)]


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_holds_the_gaussians_at_the_start_state(degree, tmp_path):
    asset, twin = with_splats("y", degree=degree)
    center, alpha, colour, scale, turn, rest = read_spz(write_spz(asset, tmp_path))
    want = pose(twin, 0.0)
    order = torch.cat([torch.nonzero(twin.part_ids == link.part)[:, 0] for link in asset.links])
    g, up = want[order], UPS["y"]
    size = np.abs(0.5 * g.means.numpy()).max()
    assert np.allclose(center, 0.5 * g.means.numpy() @ up.T, atol=size / 60_000)
    assert np.allclose(alpha, torch.sigmoid(g.opacity_logits), atol=0.5 / 255 + 1e-6)
    assert np.allclose(colour, g.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-6)
    log_scales = g.log_scales.numpy() + math.log(0.5)
    assert np.allclose(np.log(scale), np.clip(log_scales, -10, 5.9), atol=0.5 / 16 + 1e-6)
    w, x, y, z = torch.nn.functional.normalize(g.quats, dim=-1).numpy().T
    far = np.linalg.norm(matrix(turn) - up @ matrix(np.stack([x, y, z, w], 1)), axis=(1, 2))
    assert far.max() < 0.006  # half a step of 1 / 722 in three components
    if degree:
        ways = torch.nn.functional.normalize(
            torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=-1
        ).double()
        sh = torch.from_numpy(np.concatenate([colour[:, None], rest.reshape(len(rest), -1, 3)], 1))
        exact = evaluate(g.sh.double()[:, None], ways @ torch.from_numpy(up))
        assert torch.allclose(evaluate(sh[:, None], ways), exact, atol=0.03)


def test_another_reader_of_spz_agrees(tmp_path):
    gsply = pytest.importorskip("gsply.spz", reason="gsply is not installed (pip install gsply)")
    asset, _ = with_splats("y")
    path = write_spz(asset, tmp_path)
    center, alpha, colour, scale, turn, rest = read_spz(path)
    got = gsply.read_spz(path)
    assert np.allclose(got.means, center, atol=1e-6) and np.allclose(got.scales, np.log(scale), atol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-got.opacities)), alpha, atol=1e-5) and np.allclose(got.sh0, colour, atol=1e-5)
    assert np.allclose(matrix(got.quats[:, [1, 2, 3, 0]]), matrix(turn), atol=1e-5)
    assert np.allclose(got.shN.reshape(len(rest), -1), rest, atol=1e-6)
