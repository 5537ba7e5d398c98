"""Baked textures: where they lie in their picture, what they show, and that independent readers see the same."""

import numpy as np
import pytest
import torch
import trimesh
from toy import ring, toy_scene, toy_twin
from traced import boards, seen

from p2gs.export.formats import export_run
from p2gs.export.run_folder import write_twin
from p2gs.ops.mesh import Mesh
from p2gs.surface.mesh import write_meshes
from p2gs.surface.sightings import Sightings
from p2gs.surface.texture import TILE, Texture, bake, layout, texels
from p2gs.surface.tsdf import fuse
from p2gs.types import UserError

VOXEL = 0.04


def read(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """Colours [n, 3] in 0..1 at uv [n, 2], between texels as renderers read them."""
    from scipy.ndimage import map_coordinates

    height, width = texture.image.shape[:2]
    at = np.stack([(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5])
    return np.stack([map_coordinates(texture.image[..., c] / 255, at, order=1, mode="nearest") for c in range(3)], 1)


def within(count: int, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """n random triangles of ``count`` and barycentric coordinates [n, 3] in them, edges and corners too."""
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet((0.5, 0.5, 0.5), n)
    weights[::5] = np.eye(3)[rng.integers(3, size=len(weights[::5]))]
    return rng.integers(count, size=n), weights


@pytest.mark.parametrize("count", [1, 2, 3, 50, 1001])
def test_no_triangle_shows_its_neighbours_colours(count):
    """Every triangle painted in one colour of its own, read anywhere in it, is of that colour."""
    (width, height), uv = layout(count)
    triangle, weights, place = texels(count)
    # no texel twice
    assert place.min() >= 0 and (place < [width, height]).all() and len(np.unique(place, axis=0)) == len(place)
    # at least half is used
    assert all(n & (n - 1) == 0 for n in (width, height)) and count * TILE**2 / 2 > width * height / 2 - TILE**2
    colours = np.random.default_rng(1).integers(0, 256, (count, 3)).astype(np.uint8)
    image = np.zeros((height, width, 3), np.uint8)
    image[place[:, 1], place[:, 0]] = colours[triangle]
    which, w = within(count, 4000)
    assert np.allclose(read(Texture(uv, image), (uv[which] * w[..., None]).sum(1)), colours[which] / 255, atol=1e-6)
    assert np.allclose(weights.sum(1), 1) and weights.min() >= -1e-9


@pytest.mark.parametrize("count", [2, 37])
def test_texels_lie_where_their_triangle_says(count):
    """A picture of the barycentric coordinates themselves, read anywhere, gives them back."""
    (width, height), uv = layout(count)
    triangle, weights, place = texels(count)
    image = np.zeros((height, width, 3))
    image[place[:, 1], place[:, 0]] = weights * 255
    which, w = within(count, 2000)
    off = np.abs(read(Texture(uv, image), (uv[which] * w[..., None]).sum(1)) - w)
    # along the long edge: the nearest place in the triangle
    assert np.median(off) < 1e-6 and off.max() < 0.5 / (TILE - 3)


def striped(x: torch.Tensor) -> torch.Tensor:
    """Stripes finer than the mesh's triangles, [..., 3]."""
    s = 0.5 + 0.4 * torch.sin(2 * torch.pi * x[..., 0] / (1.2 * VOXEL))
    return torch.stack([s, 1 - s, torch.full_like(s, 0.3)], -1)


def test_a_texture_is_finer_than_vertices():
    views, size = [], 600
    for c in ring(8, size, elevations=(60.0, 40.0)):
        view = seen(boards(((-0.5, -0.4, -0.1), (0.5, 0.4, 0.1))), 1, c, 2 * VOXEL)
        v, u = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
        rays = (
            torch.stack([u, v, torch.ones_like(u)], -1).double()
            @ torch.linalg.inv(c.K.double()).T
            * view.depth[..., None].double()
        )
        shown = striped((rays - c.viewmat[:3, 3].double()) @ c.viewmat[:3, :3].double())
        view.colour = (255 * shown).round().byte()
        views.append(view)
    poses = [torch.eye(4, dtype=torch.float64)] * len(views)
    mesh = fuse(views, poses, 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    texture = bake(mesh, Sightings(VOXEL, views, [], [poses]), 0)
    which, w = within(len(mesh.faces), 20000)
    points = (mesh.vertices[mesh.faces[which]] * w[..., None]).sum(1)
    top = (np.abs(points[:, 2] - 0.1) < 0.2 * VOXEL) & (np.abs(points[:, :2]) < [0.4, 0.3]).all(1)
    want = striped(torch.from_numpy(points[top])).numpy()
    baked = read(texture, (texture.uv[which] * w[..., None]).sum(1))[top]
    vertices = (mesh.colours[mesh.faces[which]] * w[..., None]).sum(1)[top] / 255
    error = [np.abs(x - want).mean() for x in (baked, vertices)]
    assert top.sum() > 1000 and error[0] < 0.05 and error[0] < 0.3 * error[1]


def test_what_nobody_saw_has_its_vertices_colours():
    t = trimesh.creation.box()
    mesh = Mesh(t.vertices, t.faces, np.random.default_rng(0).integers(0, 256, (8, 3)).astype(np.uint8))
    which, w = within(len(t.faces), 500)
    texture = bake(mesh, Sightings(1.0, [], [], [[]]), 0)
    want = (mesh.colours[mesh.faces[which]] * w[..., None]).sum(1) / 255
    off = np.abs(read(texture, (texture.uv[which] * w[..., None]).sum(1)) - want)
    assert np.median(off) < 0.003 and off.max() < 0.5 / (TILE - 3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cabinet")
    write_twin(toy_twin(), folder, toy_scene(n=8, size=100), media=False)
    write_meshes(folder, resolution=40)
    export_run(folder, ["urdf", "mjcf", "glb", "usd", "obj"], texture=True)
    return folder


def test_readers_see_the_same_texture_on_the_same_places(run):
    """URDF's meshes, the OBJ parts and the GLB, as trimesh reads them: the same colour everywhere."""
    glb = trimesh.load(run / "twin.glb")
    for name in ("base", "part_1", "part_2"):
        files = [trimesh.load(run / folder / f"{name}.obj", process=False) for folder in ("assets", "parts")] + [
            glb.geometry[name]
        ]
        which, w = within(len(files[0].faces), 500)
        colours = []
        for mesh in files:
            assert len(mesh.faces) == len(files[0].faces)
            material = mesh.visual.material
            image = np.asarray(getattr(material, "image", None) or material.baseColorTexture)[..., :3]
            uv = (mesh.visual.uv[mesh.faces[which]] * w[..., None]).sum(1)
            colours.append(read(Texture(uv, image), uv))
        assert np.allclose(colours[0], colours[1]) and np.allclose(colours[0], colours[2], atol=2 / 255)
        assert colours[0].std() > 0.01
    blue = glb.geometry["part_1"].visual
    door = read(Texture(blue.uv, np.asarray(blue.material.baseColorTexture)[..., :3]), blue.uv)
    assert np.allclose(np.median(door, 0), (0.3, 0.45, 0.7), atol=0.1)  # the door's blue, as its Gaussians have it


def test_simulators_and_usd_find_the_pictures(run, tmp_path):
    import mujoco
    import yourdfpy

    model = mujoco.MjModel.from_xml_path(str(run / "twin.xml"))
    assert model.ntex == model.nmat == 3 and model.nmeshtexcoord > 0
    assert (model.geom_matid[model.geom_group == 2] >= 0).all()
    robot = yourdfpy.URDF.load(str(run / "twin.urdf"))
    assert all(g.visual.kind == "texture" for g in robot.scene.geometry.values())
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(run / "twin.usda"))
    for name in ("base", "part_1", "part_2"):
        mesh = stage.GetPrimAtPath(f"/twin/{name}/visual")
        st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        assert st.GetInterpolation() == "faceVarying" and len(st.Get()) == len(
            UsdGeom.Mesh(mesh).GetFaceVertexIndicesAttr().Get()
        )
        material = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
        shader = material.ComputeSurfaceSource()[0]
        picture = UsdShade.Shader(shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
        assert (run / picture.GetInput("file").Get().path).is_file()


def test_pictures_of_an_earlier_export_go(run, tmp_path):
    export_run(run, ["urdf"], tmp_path, texture=True)
    mine = tmp_path / "assets" / "mine.png"
    assert {f.suffix for f in (tmp_path / "assets").iterdir()} == {".obj", ".mtl", ".png"}
    mine.write_bytes(b"")
    export_run(run, ["urdf"], tmp_path)
    assert (
        {f.suffix for f in (tmp_path / "assets").iterdir() if f != mine} == {".obj"}
        and mine.is_file()
        and "<color" in (tmp_path / "twin.urdf").read_text()
    )


def test_a_format_without_textures_says_so(run, tmp_path):
    with pytest.raises(UserError, match="--texture: ply"):
        export_run(run, ["ply"], tmp_path, texture=True)
