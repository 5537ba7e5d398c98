"""Sharpen motion hypotheses: batched constrained point-to-plane steps, then a derivative-free search on the evidence
itself.

Point-to-plane is blind to sliding within a door's plane; free space is not, so the second step uses the full landing
cost.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.rigid import Motions
from p2gs.native import native, num_threads


def normal_equations(problem: Problem, motions: Motions, samples: list[Tensor], weights: list[Tensor], width: float):
    """J^T W J [B, 5, 5] and J^T W r [B, 5] of both states' point-to-plane residuals, Geman-McClure weights of
    ``width``."""
    if not all(landing.fused for landing in problem.landings):
        return normal_equations_reference(problem, motions, samples, weights, width)
    A = torch.zeros(len(motions), 5, 5)
    b = torch.zeros(len(motions), 5)
    basis, moving = motions.twist_basis().contiguous(), motions.packed()
    for s in (0, 1):
        landing, source = problem.landings[1 - s], problem.landings[s]
        index, w = samples[s].contiguous(), weights[s].float().contiguous()
        native.landing_fit(
            *landing.tables(),
            [m.data_ptr() for m in moving],
            len(motions),
            basis.data_ptr(),
            s == 1,
            source.rows.data_ptr(),
            len(source.rows),
            index.data_ptr(),
            w.data_ptr(),
            len(index),
            width,
            landing.hc + 2 * problem.scale.spacing,
            A.data_ptr(),
            b.data_ptr(),
            num_threads(),
        )
    return A, b


def normal_equations_reference(
    problem: Problem, motions: Motions, samples: list[Tensor], weights: list[Tensor], width: float
):
    """``normal_equations`` in torch, for machines without the kernels."""
    B = motions.twist_basis()
    A = torch.zeros(len(motions), 5, 5)
    b = torch.zeros(len(motions), 5)
    for s in (0, 1):
        surf, target, landing = problem.surfels[s], problem.surfels[1 - s], problem.landings[1 - s]
        p, n = surf.points[samples[s]], surf.normals[samples[s]]
        x = motions.apply(p, inverse=s == 1)
        nx = motions.rotate(n, inverse=s == 1)
        j = landing.match(x, nx)
        q, m = target.points[j], target.normals[j]
        r = ((x - q) * m).sum(2)
        off = (x - q).pow(2).sum(2) - r * r
        w = weights[s] / (1 + (r / width) ** 2) ** 2
        w = (
            w
            * (off < (landing.hc + 2 * problem.scale.spacing) ** 2)
            * ((nx * m).sum(2) > 0.5)
            * (1 - 0.7 * landing.static[j].float())
        )
        if s == 0:
            J = torch.cat([torch.linalg.cross(x, m), m], 2)
        else:  # the residual seen in the end state: plane carried along, point p at rest
            Rm = motions.rotate(m)
            J = -torch.cat([torch.linalg.cross(p.expand_as(x), Rm), Rm], 2)
        J = J @ B
        A += torch.einsum("bp,bpi,bpj->bij", w, J, J)
        b += torch.einsum("bp,bpi,bp->bi", w, J, r)
    return A, b


def gauss_newton(
    problem: Problem,
    motions: Motions,
    samples: list[Tensor],
    weights: list[Tensor],
    rounds: int = 8,
    width0=None,
    width1=None,
) -> Motions:
    """A few damped steps with a kernel shrinking from ``width0`` (1.5 coarse voxels) to ``width1`` (the surface
    tolerance)."""
    hc, tp = problem.landings[0].hc, problem.scale.tp
    width0, width1 = width0 or 1.5 * hc, width1 or tp
    unit = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.0])
    for k in range(rounds):
        width = width0 * (width1 / width0) ** (k / max(1, rounds - 1))
        A, b = normal_equations(problem, motions, samples, weights, width)
        trace = A.diagonal(dim1=1, dim2=2).sum(1).clamp_min(1e-12)
        A = A + torch.diag_embed(0.02 * trace[:, None] * unit)
        step = -torch.linalg.solve(A, b[..., None])[..., 0]
        limit = torch.cat([torch.full((1,), 2 * hc), torch.full((2,), 0.08), torch.full((2,), 2 * hc)])
        motions = motions.displaced(torch.maximum(torch.minimum(step, limit), -limit))
    return motions


def pattern_search(
    gain,
    motions: Motions,
    length: float,
    rounds: int = 10,
    turn_radius: float = 0.4,
    value: Tensor | None = None,
    tilt: bool = True,
) -> tuple[Motions, Tensor]:
    """Coordinate steps (both signs, 5 coordinates), step halved where nothing improves. Returns motions and their
    gains.

    length: first step in scene units; angles step by length / turn_radius. gain: Motions [B] -> [B].  tilt: may the
    axis turn.
    """
    B = len(motions)
    value = gain(motions) if value is None else value
    scale = torch.ones(B) * length
    r = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.0])
    turn = torch.tensor([1 / turn_radius, 1 / turn_radius, 1 / turn_radius, 1.0, 1.0])
    moves = torch.eye(5) if tilt else torch.eye(5)[[0, 3, 4]]
    moves = torch.cat([moves, -moves])
    for _ in range(rounds):
        unit = torch.where(motions.turn[:, None], turn, r)
        step = (moves[None] * unit[:, None] * scale[:, None, None]).reshape(-1, 5)
        many = motions[torch.arange(B).repeat_interleave(len(moves))]
        tried = many.displaced(step)
        v = gain(tried).reshape(B, len(moves))
        best, k = v.max(1)
        better = best > value + 1e-7
        pick = tried[torch.arange(B) * len(moves) + k]
        motions = Motions(
            motions.turn,
            torch.where(better[:, None], pick.axis, motions.axis),
            torch.where(better[:, None], pick.centre, motions.centre),
            torch.where(better, pick.amount, motions.amount),
            motions.thick,
        )
        value = torch.where(better, best, value)
        scale = torch.where(better, scale, scale * 0.5)
    return motions, value
