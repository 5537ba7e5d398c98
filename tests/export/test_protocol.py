"""The surfaces that ArtGS's protocol scores: nothing completed, the whole by itself, moving parts cleaned of stray
Gaussians."""

import numpy as np
import pytest
import trimesh
from toy import toy_scene, toy_twin

from p2gs.export.run_folder import write_twin
from p2gs.gaussians.views import bounds, scene_cameras
from p2gs.ops.mesh import Mesh
from p2gs.scores.evaluate import read_surfaces, surface_scores
from p2gs.surface.mesh import part_meshes, read_mesh, write_meshes
from p2gs.surface.protocol import SurfaceOptions, largest_clusters, surface_options
from p2gs.surface.sightings import sight
from p2gs.types import UserError


def test_options_are_read_from_the_runs_config(tmp_path):
    assert surface_options(tmp_path) == SurfaceOptions()
    (tmp_path / "config.yaml").write_text(
        "phases: {finish: {complete: false, closed: false, max_faces: 500, whole: separate, cluster: 0.05, trays: 0}}"
    )
    assert surface_options(tmp_path) == SurfaceOptions(False, False, 500, "separate", 0.05)
    (tmp_path / "config.yaml").write_text("phases: [1]")
    with pytest.raises(UserError, match="expected a mapping"):
        surface_options(tmp_path)


def test_a_moving_part_keeps_its_largest_cluster():
    twin = toy_twin()
    part = next(p for p in twin.parts if p.joint is not None)
    mine = (twin.part_ids == part.id).nonzero()[:, 0]
    stray, base = mine[:2], (twin.part_ids == 0).nonzero()[:2, 0]
    for rows in (stray, base):
        twin.gaussians.means[rows] += 50.0
    kept = largest_clusters(twin, 0.5)
    # a pair far off is a cluster too, but not the largest; the base keeps all
    assert len(kept.gaussians) == len(twin.gaussians) - 2
    assert (
        int((kept.part_ids == part.id).sum()) == len(mine) - 2 and kept.gaussians.means[kept.part_ids == 0].max() > 40
    )


def test_large_photographs_are_looked_at_no_finer_than_voxels_ask():
    """Four times the edge: views have two pixels a voxel for most cameras, and the same surfaces."""
    twin = toy_twin()
    cameras = [(c.state, c.camera.scaled(4 * c.camera.width, 4 * c.camera.height)) for c in scene_cameras(toy_scene())]
    seen, fine = sight(twin, cameras, 40), sight(twin, cameras, 40, fine=True)
    assert [v.camera for v in fine.views] == [c for _, c in cameras]
    assert all(v.depth.shape == (v.camera.height, v.camera.width) for v in seen.views)
    lo, hi = bounds(twin, (0.0,))
    finest = [float(v.camera.K[0, 0] * seen.voxel / (v.camera.position - (lo + hi) / 2).norm()) for v in seen.views]
    assert np.median(finest) == pytest.approx(2, rel=0.02)
    for k in range(len(twin.parts)):
        ours, theirs = (trimesh.Trimesh(s.surface(k).vertices, s.surface(k).faces) for s in (seen, fine))
        assert 0.75 * theirs.area < ours.area < 1.05 * theirs.area  # borders, a pixel wide, are no sightings
        assert np.quantile(trimesh.proximity.closest_point(theirs, ours.vertices)[1], 0.95) < seen.voxel


def test_nothing_is_completed_where_it_is_not_wanted():
    twin, scene = toy_twin(), toy_scene()
    cameras = [(c.state, c.camera) for c in scene_cameras(scene)]
    seen = sight(twin, cameras, 40)
    bare = part_meshes(twin, cameras, 40, complete=False)
    for k, mesh in enumerate(bare):
        assert (mesh.faces == seen.surface(k).faces).all()
    full = part_meshes(twin, cameras, 40, closed=False)
    assert sum(len(m.faces) for m in full) != sum(len(m.faces) for m in bare)
    assert not any(m.guessed.any() for m in bare)
    for part, all_of_it in zip(bare, full, strict=True):
        assert int((~all_of_it.guessed).sum()) <= len(part.faces)  # what is not guessed was seen
    assert any(m.guessed.any() for m in full)


def test_closed_meshes_are_watertight_and_say_what_is_guessed():
    twin = toy_twin()
    cameras = [(c.state, c.camera) for c in scene_cameras(toy_scene())]
    for mesh in part_meshes(twin, cameras, 40):
        assert trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces).is_watertight
        assert mesh.guessed.any() and not mesh.guessed.all()


def test_the_whole_of_its_own_is_written_and_scored(tmp_path):
    twin, scene = toy_twin(), toy_scene()
    write_twin(twin, tmp_path, scene, media=False)
    (tmp_path / "config.yaml").write_text("phases: {finish: {whole: separate, complete: false}}")
    write_meshes(tmp_path, 40)
    whole, parts = read_mesh(tmp_path / "meshes" / "end" / "whole.ply"), []
    for p in twin.parts:
        parts.append(read_mesh(tmp_path / "meshes" / "end" / f"part_{p.id}.ply"))
    joined = Mesh.join(parts)
    assert len(whole.faces) and len(whole.faces) != len(joined.faces)

    class Truth:
        """The parts themselves: static and movable score nothing, the whole what its own surface differs by."""

        @staticmethod
        def meshes(state):
            from types import SimpleNamespace

            folder = tmp_path / "meshes" / ("start", "end")[state]
            dynamic = [folder / f"part_{p.id}.ply" for p in twin.parts if p.joint is not None]
            return SimpleNamespace(static=folder / "part_0.ply", dynamic=dynamic, whole=None)

    assignment = {k: k for k in range(len(twin.parts) - 1)}
    apart, _ = surface_scores(read_surfaces(tmp_path, Truth, []), assignment, [])
    (tmp_path / "config.yaml").write_text("phases: {finish: {complete: false}}")
    together, _ = surface_scores(read_surfaces(tmp_path, Truth, []), assignment, [])
    assert (
        apart["static"]["value"] == together["static"]["value"]
        and apart["whole"]["value"] > 1.2 * together["whole"]["value"]
    )
