"""Nearest neighbours against all distances."""

import pytest
import torch

from p2gs.ops.knn import knn, knn_reference


def surface(n):
    """Points on three faces of a box and a few far away, as Gaussians lie."""
    points = torch.rand(n, 3)
    points[torch.arange(n), torch.arange(n) % 3] = 0
    points[: n // 50] *= 20
    return points


@pytest.mark.parametrize("n, k", [(1, 1), (2, 2), (17, 5), (1000, 1), (1000, 9), (3000, 17)])
def test_against_all_distances(n, k, threads):
    points, queries = surface(n), surface(257) + 0.1
    distance, index = knn(points, queries, k)
    expected, _ = knn_reference(points.double(), queries.double(), k)
    assert distance.dtype == torch.float32 and index.dtype == torch.int64
    torch.testing.assert_close(distance.double(), expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close((points[index] - queries[:, None]).norm(dim=-1), distance, rtol=1e-4, atol=1e-5)


def test_without_oneself():
    points = surface(500)
    points[10:30] = points[10]  # more twins than neighbours asked for
    distance, index = knn(points, None, 4, exclude_self=True)
    assert (index != torch.arange(500)[:, None]).all()
    expected, _ = knn_reference(points, points, 5)
    torch.testing.assert_close(distance, expected[:, 1:], rtol=1e-5, atol=1e-6)
    assert (distance[10:30] == 0).all()


def test_oneself_is_found_otherwise():
    points = surface(50)
    distance, index = knn(points, None, 1)
    assert torch.equal(index[:, 0], torch.arange(50)) and not distance.any()


def test_the_same_for_any_thread_count():
    points = surface(2000)
    points[5:50] = points[5]
    answers = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        answers.append(knn(points, None, 8, exclude_self=True))
    assert torch.equal(answers[0][0], answers[1][0]) and torch.equal(answers[0][1], answers[1][1])


def test_gives_no_gradient():
    points = torch.rand(10, 3, requires_grad=True)
    distance, _ = knn(points, None, 2)
    assert not distance.requires_grad


def test_wrong_questions():
    points = surface(5)
    with pytest.raises(ValueError, match="5 neighbours asked of 5 points"):
        knn(points, None, 5, exclude_self=True)
    with pytest.raises(ValueError, match="neighbours asked"):
        knn(points, None, 0)
    with pytest.raises(ValueError, match="one query a point"):
        knn(points, torch.rand(4, 3), 1, exclude_self=True)
    points[2, 1] = float("nan")
    with pytest.raises(ValueError):
        knn(points, None, 1)
