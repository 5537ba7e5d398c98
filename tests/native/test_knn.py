"""Nearest neighbours against all distances."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from p2gs.ops.knn import knn, knn_reference


def surface(n):
    """Points on three faces of a box and some astray, as Gaussians lie."""
    points = torch.rand(n, 3)
    points[torch.arange(n), torch.arange(n) % 3] = 0
    points[: n // 50] *= 20
    return points


def assert_right(points, queries, k, exclude_self, answer):
    """Distances as all pairs give them, and the indices belong to them (in any order where distances are equal)."""
    distance, index = answer
    expected, _ = knn_reference(points.double(), None if queries is None else queries.double(), k, exclude_self)
    at = points if queries is None else queries
    assert distance.dtype == torch.float32 and index.dtype == torch.int64
    torch.testing.assert_close(distance.double(), expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close((points[index] - at[:, None]).norm(dim=-1), distance, rtol=1e-4, atol=1e-5)
    assert (index.sort(dim=1).values.diff(dim=1) > 0).all(), "a point was found twice"


@pytest.mark.parametrize("n, k", [(1, 1), (2, 2), (16, 3), (17, 17), (257, 5), (1000, 9), (1500, 40)])
def test_against_all_distances(isa, threads, n, k):
    points, queries = surface(n), surface(300) + 0.1
    assert_right(points, queries, k, False, knn(points, queries, k))
    assert_right(points, None, k, False, knn(points, None, k))
    if k < n:
        answer = knn(points, None, k, exclude_self=True)
        assert_right(points, None, k, True, answer)
        assert (answer[1] != torch.arange(n)[:, None]).all()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**31),
    st.integers(2, 400),
    st.sampled_from([1e-6, 1.0, 1e4]),
    st.sampled_from(["grid", "line", "outlier", "one place"]),
)
def test_unkind_points(seed, n, scale, kind):
    g = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=g)
    if kind == "grid":
        points = (points * 2).round()
    elif kind == "line":
        points[:, 1:] = 0
    elif kind == "outlier":
        points[0] = 1e6
    else:
        points[:] = points[0]
    points = points * scale
    k = min(5, n - 1)
    distance, index = knn(points, None, k, exclude_self=True)
    expected, _ = knn_reference(points.double(), None, k, exclude_self=True)
    torch.testing.assert_close(distance.double(), expected, rtol=1e-5, atol=1e-6 * scale)
    assert (index != torch.arange(n)[:, None]).all()
    if kind == "one place":
        assert (index.diff(dim=1) > 0).all()


def test_twins_count_as_neighbours():
    points = surface(500)
    points[10:30] = points[10]
    distance, index = knn(points, None, 4, exclude_self=True)
    assert (distance[10:30] == 0).all()
    assert index[10].tolist() == [11, 12, 13, 14]
    assert index[12].tolist() == [10, 11, 13, 14]


def test_oneself_is_found_otherwise():
    points = surface(50)
    distance, index = knn(points, None, 1)
    assert torch.equal(index[:, 0], torch.arange(50)) and not distance.any()


def test_the_same_for_any_thread_count():
    points = surface(3000)
    points[5:50] = points[5]
    answers = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        answers.append(knn(points, None, 8, exclude_self=True))
    for distance, index in answers[1:]:
        assert torch.equal(distance, answers[0][0]) and torch.equal(index, answers[0][1])


def test_other_layouts_and_types():
    points = surface(200)
    expected = knn(points, points[:50] + 0.01, 3)
    strided = torch.zeros(200, 5)
    strided[:, 1:4] = points
    for p in (strided[:, 1:4], points.double()):
        distance, index = knn(p, (points[:50] + 0.01).double(), 3)
        assert distance.dtype == p.dtype
        torch.testing.assert_close(distance.float(), expected[0])
        assert torch.equal(index, expected[1])


def test_gives_no_gradient():
    points = torch.rand(10, 3, requires_grad=True)
    distance, _ = knn(points, None, 2)
    assert not distance.requires_grad


def test_no_queries():
    for dtype in (torch.float32, torch.float64):
        distance, index = knn(surface(5).to(dtype), torch.zeros(0, 3, dtype=dtype), 2)
        assert distance.shape == index.shape == (0, 2)


def test_wrong_questions():
    points = surface(5)
    with pytest.raises(ValueError, match="5 neighbours asked of 5 points, each without itself"):
        knn(points, None, 5, exclude_self=True)
    with pytest.raises(ValueError, match="0 neighbours asked"):
        knn(points, None, 0)
    with pytest.raises(ValueError, match="1 neighbours asked of 0 points"):
        knn(points[:0], points, 1)
    with pytest.raises(ValueError, match="queries as None"):
        knn(points, torch.rand(5, 3), 1, exclude_self=True)
    with pytest.raises(ValueError, match="points \\[N, 3\\]"):
        knn(points[:, :2], None, 1)
    bad = points.clone()
    bad[2, 1] = float("nan")
    with pytest.raises(ValueError, match="finite points"):
        knn(bad, None, 1)
    with pytest.raises(ValueError, match="finite queries"):
        knn(points, bad, 1)
