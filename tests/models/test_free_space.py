"""What the other state sees through is relabelled or dropped."""

import torch
from tiny import look_at

from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.free_space import explain_by_free_space, hidden_share


def wall_stack(x: float) -> DepthStack:
    """Depth maps of an endless wall in the plane y = x, seen from the front by five cameras."""
    depths, alphas, cameras = [], [], []
    for shift in (-0.6, -0.3, 0.0, 0.3, 0.6):
        camera = look_at(torch.tensor([shift, 3.0, 0.4]), 64)
        ys, xs = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        rays = torch.stack([xs, ys, torch.ones_like(xs)], -1) @ torch.linalg.inv(camera.K).T
        world = rays @ camera.viewmat[:3, :3]
        depths.append((x - camera.position[1]) / world[..., 1])
        alphas.append(torch.ones(64, 64))
        cameras.append(camera)
    return DepthStack(depths, alphas, cameras)


def test_a_wall_that_slid_back():
    """The wall stands at y = 0.5 in the start and at y = 0 in the end: part 1 slides by -0.5."""
    stacks = [wall_stack(0.5), wall_stack(0.0)]
    T = torch.eye(4).double().repeat(2, 1, 1)
    T[1, 1, 3] = -0.5
    times = torch.zeros(2).double()  # canonical = start
    means = torch.tensor([[0.0, 0.5, 0.0], [0.1, 0.5, 0.1], [0.0, 0.9, 0.0], [0.0, -0.4, 0.0]])
    labels = torch.tensor([1, 0, 1, 1])
    found, keep = explain_by_free_space(means, labels, T, times, stacks, 0.05)
    # on the wall and moving with it; on it but called static; before it in both states; hidden behind it in both
    assert found.tolist()[:2] == [1, 1] and keep.tolist() == [True, True, False, True]
    assert found[3] == 1


def test_hidden_share_against_the_literal_count():
    """Points carried by their label's motion; for each camera: is the wall nearer than the point?"""
    stack = wall_stack(0.5)
    T = torch.eye(4).double()[None]
    T[0, 1, 3] = -0.4
    gen = torch.Generator().manual_seed(1)
    means = torch.rand(60, 3, generator=gen) - torch.tensor([0.5, 0.0, 0.5])
    labels = torch.randint(0, 2, (60,), generator=gen)
    found = hidden_share(means, labels, T, stack, 0.02)
    for i in range(60):
        at = means[i] + (torch.tensor([0.0, -0.4, 0.0]) if labels[i] else 0)
        votes = []
        for camera in stack.cameras:
            local = camera.viewmat[:3, :3] @ at + camera.viewmat[:3, 3]
            x, y = ((camera.K @ local)[:2] / local[2]).tolist()
            if local[2] > 0 and 1 <= x < 63 and 1 <= y < 63:
                way = at - camera.position
                wall = local[2] * (0.5 - camera.position[1]) / way[1]  # depth of the wall on this ray
                votes.append(bool(local[2] > wall + 0.02))
        if len(votes) == 5 and abs(float(at[1]) - 0.5) > 0.1:
            assert abs(float(found[i]) - sum(votes) / 5) < 1e-6
    assert 0 < float(found.mean()) < 1
