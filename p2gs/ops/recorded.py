"""Losses of pictures as recorded CUDA graphs: the hundred small kernels of one take longer to launch than to run.

Only within ``recording`` and on CUDA tensors; anywhere else ``recorded`` calls the function as it is, which is its
readable twin.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager
from math import prod
from typing import Any, Callable, Iterator, Sequence

import torch
from torch import Tensor


class Recorder:
    """Graphs by function, constants and shapes. All share their memory: the inputs of a replay are copied in before it,
    and its results out after it."""

    def __init__(self) -> None:
        self.graphs: dict[object, _Graph] = {}
        self.pool: dict[str, Any] = {}
        self.memory: dict[object, Tensor] = {}

    def room(self, name: object, like: Tensor) -> Tensor:
        """Memory of this name with the shape, type and device of ``like``, shared with all smaller ones."""
        key, count = (name, like.dtype, like.device), prod(like.shape)
        if key not in self.memory or len(self.memory[key]) < count:
            self.memory[key] = torch.empty(count, dtype=like.dtype, device=like.device)
        return self.memory[key][:count].view(like.shape)


class _Open(threading.local):
    recorder: Recorder | None = None


_open = _Open()


@contextmanager
def recording(recorder: Recorder) -> Iterator[None]:
    """Within it, ``recorded`` functions that this thread calls on a GPU are recorded and replayed."""
    before, _open.recorder = _open.recorder, recorder
    try:
        yield
    finally:
        _open.recorder = before


def recorded(function: Callable[..., Any], *inputs: Tensor | float, constants: Sequence = ()) -> Tensor:
    """``function(*inputs, *constants)``, a scalar, once differentiable by inputs that require a gradient.

    inputs: tensors on one device, and numbers that change from call to call.  constants: hashable; other ones are
    another function. A function that is recorded must not wait for the GPU, nor read from main memory.
    """
    recorder = _open.recorder
    if recorder is None or not all(t.is_cuda for t in inputs if isinstance(t, Tensor)):
        return function(*inputs, *constants)
    shapes = (float if not isinstance(t, Tensor) else (t.shape, t.dtype, t.requires_grad) for t in inputs)
    key = (function, tuple(constants), *shapes)
    if key not in recorder.graphs:
        recorder.graphs[key] = _Graph(recorder, function, inputs, constants)
    return _Replay.apply(recorder.graphs[key], *inputs)


class _Graph:
    """The value of a function and its gradients, recorded for inputs of given shapes."""

    def __init__(self, recorder: Recorder, function: Callable, inputs: Sequence[Tensor | float], constants: Sequence):
        device = next(t.device for t in inputs if isinstance(t, Tensor))
        like = [t if isinstance(t, Tensor) else torch.empty((), device=device) for t in inputs]
        self.inputs = [recorder.room(i, t) for i, t in enumerate(like)]
        self.wanted = [t.requires_grad for t in like]
        self.value = recorder.room("value", torch.empty((), device=device))
        self.gradients = [recorder.room((i, "gradient"), t) for i, t in enumerate(like) if t.requires_grad]

        def run() -> None:
            leaves = [t.detach().requires_grad_(wanted) for t, wanted in zip(self.inputs, self.wanted, strict=True)]
            by = [t for t in leaves if t.requires_grad]
            with torch.enable_grad():
                value = function(*leaves, *constants)
                found = torch.autograd.grad(value, by) if by else ()
            with torch.no_grad():
                for out, got in zip((self.value, *self.gradients), (value, *found), strict=True):
                    out.copy_(got)

        self.take(inputs)
        self.graph = torch.cuda.CUDAGraph()
        side, here = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        side.wait_stream(here)
        with torch.cuda.stream(side):
            run()  # libraries choose their kernels, which they may not do in a recording
            # not by torch.cuda.graph, which waits for the GPU and drops all memory that is kept for the next step
            self.graph.capture_begin(**recorder.pool, capture_error_mode="thread_local")
            try:
                run()
            finally:
                self.graph.capture_end()
        here.wait_stream(side)
        recorder.pool = {"pool": self.graph.pool()}

    @torch.no_grad()
    def take(self, inputs: Sequence[Tensor | float]) -> None:
        for own, given in zip(self.inputs, inputs, strict=True):
            own.copy_(given) if isinstance(given, Tensor) else own.fill_(given)

    def replay(self, inputs: Sequence[Tensor | float]) -> tuple[Tensor, list[Tensor]]:
        self.take(inputs)
        self.graph.replay()
        return self.value.clone(), [g.clone() for g in self.gradients]


class _Replay(torch.autograd.Function):
    """The gradient comes with the value and waits for the factor of the backward pass."""

    @staticmethod
    def forward(ctx, graph: _Graph, *inputs):
        value, gradients = graph.replay(inputs)
        ctx.wanted, ctx.gradients = graph.wanted, gradients
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output):
        gradients = iter(ctx.gradients)
        return None, *(next(gradients) * grad_output if wanted else None for wanted in ctx.wanted)
