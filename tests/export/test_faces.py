"""Triangles of a mesh, and quantiles by weight."""

import numpy as np
import pytest
import trimesh

from p2gs.ops.mesh import Mesh
from p2gs.surface.faces import Faces, quantile


def test_faces_are_where_and_as_large_as_trimesh_says_in_any_frame():
    t = trimesh.creation.icosphere(2)
    mesh = Mesh(np.asarray(t.vertices), np.asarray(t.faces), np.zeros((len(t.vertices), 3), np.uint8))
    axes = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9]))[:3, :3]
    for faces, R in ((Faces(mesh), np.eye(3)), (Faces(mesh, axes), axes)):
        assert np.allclose(faces.middle, t.triangles_center @ R.T) and np.allclose(faces.area, t.area_faces)
        assert np.allclose(faces.normal, t.face_normals @ R.T)


@pytest.mark.parametrize("share", [0.02, 0.25, 0.5, 0.97])
def test_a_quantile_by_weight_is_that_of_repeated_values(share):
    rng = np.random.default_rng(0)
    values, weights = rng.normal(size=50), rng.integers(1, 9, 50)
    assert quantile(values, weights.astype(float), share) == np.quantile(
        np.repeat(values, weights), share, method="inverted_cdf"
    )
