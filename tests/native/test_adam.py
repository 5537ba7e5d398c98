"""NamedAdam against torch.optim.Adam: values, state, checkpoints."""

import copy

import pytest
import torch

from p2gs.models.adam import NamedAdam

SHAPES = {"means": (1001, 3), "opacity": (1001,), "sh": (101, 15, 3), "one": (1,), "none": (0, 3)}


def twins(cls_a=NamedAdam, cls_b=torch.optim.Adam, dtype=torch.float32):
    out = []
    for cls in (cls_a, cls_b):
        torch.manual_seed(1)
        params = {name: torch.nn.Parameter(torch.randn(*shape, dtype=dtype)) for name, shape in SHAPES.items()}
        groups = [{"params": [p], "name": n, "lr": 10.0 ** -(1 + i)} for i, (n, p) in enumerate(params.items())]
        out.append((params, cls(groups, eps=1e-15)))
    return out


def give_gradients(*sets, step=0):
    for name in SHAPES:
        grad = torch.randn(SHAPES[name]) * 10.0 ** (-(step % 5))
        if name == "means":
            grad[::3] = 0  # Gaussians that a view does not see
        for params in sets:
            params[name].grad = grad.to(params[name].dtype).clone()


def assert_same(a, b, optimizer_a, optimizer_b):
    for name in SHAPES:
        torch.testing.assert_close(a[name], b[name], rtol=1e-5, atol=1e-6)
        for key in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(
                optimizer_a.state[a[name]][key], optimizer_b.state[b[name]][key], rtol=1e-5, atol=1e-7
            )


def test_follows_torch(isa, threads):
    (a, ours), (b, theirs) = twins()
    for step in range(12):
        give_gradients(a, b, step=step)
        if step == 6:  # schedules change the rate between steps
            for optimizer in (ours, theirs):
                optimizer.param_groups[0]["lr"] = 1e-3
        ours.step()
        theirs.step()
    assert_same(a, b, ours, theirs)


def test_checkpoints_go_both_ways():
    (a, ours), (b, theirs) = twins()
    for step in range(3):
        give_gradients(a, b, step=step)
        ours.step()
        theirs.step()
    states = copy.deepcopy((ours.state_dict(), theirs.state_dict()))  # loading does not copy
    (a2, ours2), (b2, theirs2) = twins()
    for new, old in ((a2, a), (b2, b)):
        for name in SHAPES:
            new[name].data.copy_(old[name].data)
    ours2.load_state_dict(states[1])
    theirs2.load_state_dict(states[0])
    give_gradients(a, a2, b2)
    for optimizer in (ours, ours2, theirs2):
        optimizer.step()
    assert_same(a, b2, ours, theirs2)
    assert_same(a2, b2, ours2, theirs2)


def test_same_bits_for_any_thread_count():
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        param = torch.nn.Parameter(torch.randn(100_003))
        optimizer = NamedAdam([{"params": [param], "name": "x"}])
        for _ in range(3):
            param.grad = torch.randn(100_003)
            optimizer.step()
        results.append(param.detach())
    assert torch.equal(*results)


def test_double_precision_takes_torch():
    (a, ours), (b, theirs) = twins(dtype=torch.float64)
    for step in range(3):
        give_gradients(a, b, step=step)
        ours.step()
        theirs.step()
    for name in SHAPES:
        assert torch.equal(a[name], b[name])


def test_parameters_without_gradient_stay():
    (a, ours), _ = twins()
    before = a["sh"].detach().clone()
    give_gradients(a)
    a["sh"].grad = None
    ours.step()
    assert torch.equal(a["sh"], before)
    assert not ours.state[a["sh"]]


def test_broadcast_gradient():
    """sum().backward() gives a gradient that is one number seen many times."""
    param = torch.nn.Parameter(torch.zeros(10))
    optimizer = NamedAdam([{"params": [param], "name": "x"}], lr=0.1)
    param.sum().backward()
    optimizer.step()
    torch.testing.assert_close(param.detach(), torch.full((10,), -0.1))


def test_autograd_sees_the_write():
    param = torch.nn.Parameter(torch.ones(4))
    optimizer = NamedAdam([{"params": [param], "name": "x"}])
    late = (param * param).sum()
    param.grad = torch.ones(4)
    optimizer.step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        late.backward()


def test_nan_is_not_hidden(isa):
    param = torch.nn.Parameter(torch.zeros(40))
    optimizer = NamedAdam([{"params": [param], "name": "x"}])
    param.grad = torch.ones(40)
    param.grad[17] = float("nan")
    optimizer.step()
    assert param[17].isnan() and param.isnan().sum() == 1


def test_closure_and_names():
    param = torch.nn.Parameter(torch.ones(3))
    optimizer = NamedAdam([{"params": [param], "name": "x"}], lr=0.1)

    def closure():
        optimizer.zero_grad()
        loss = (param**2).sum()
        loss.backward()
        return loss

    assert optimizer.step(closure).item() == 3.0
    torch.testing.assert_close(param.detach(), torch.full((3,), 0.9))
    assert optimizer.group("x")["params"] == [param]
    with pytest.raises(KeyError):
        optimizer.group("y")
    with pytest.raises(ValueError, match="name of its own"):
        NamedAdam([{"params": [param]}])
    with pytest.raises(ValueError, match="name of its own"):
        NamedAdam([{"params": [param], "name": "x"}, {"params": [torch.nn.Parameter(torch.ones(1))], "name": "x"}])


@pytest.mark.parametrize("to_none", [True, False])
def test_gradients_go(to_none):
    params, optimizer = twins()[0]
    give_gradients(params)
    optimizer.zero_grad(set_to_none=to_none)
    assert all(p.grad is None if to_none else not p.grad.any() for p in params.values())
