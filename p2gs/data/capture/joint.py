"""Both states in one model: points of the static scene that both show become one point, and everything is adjusted
together.

Points are matched between the two reconstructions, not between photographs: with the static hypothesis known, two
points are one where each projects to where the other was seen and their descriptors agree. That costs a second where 60
x 60 pairs of photographs cost minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from p2gs.data.capture.certainty import without_unsure
from p2gs.data.capture.child import run_job
from p2gs.data.capture.colmap_io import read_model, write_model
from p2gs.data.capture.hypotheses import State, Votes
from p2gs.data.capture.model import Model, similarity
from p2gs.ops.knn import search_tree
from p2gs.ops.robust import CAUCHY_95

# reprojection error over the long edge for points found with the hypothesis known: half of what a vote may have
GUIDED = 0.004
NEAR = 0.03  # two reconstructions of one point differ by less than this share of the cameras' distance
ALIKE = 0.8  # cosine of the mean descriptors of one point seen in both states
MAX_ERROR = 3.0  # pixels: an observation worse than this is a wrong match; good ones are at 0.5 to 0.8
END_OFFSET = 100_000  # image ids of the end state start here, so that they cannot meet the start's
RAYLEIGH_MEDIAN = 1.1774  # of the length of a vector of two normal deviates
LEAST_SCALE = 0.05  # pixels: no corner is known better than to a twentieth
REFINED = 2  # times that observations are put where the pixels say; with the better poses once more
ROUNDS = 2  # match, adjust; with the better poses once more


@dataclass(frozen=True)
class Bias:
    """How far the states are apart after adjustment, by static points triangulated from each state alone.

    shift: at the object's centre, in the model's units.  turn: degrees.  shift_sd, turn_sd: standard deviations of
    where these points can tell the states to lie.  points: how many say so.  share: of all points.
    """

    shift: float
    turn: float
    shift_sd: float
    turn_sd: float
    points: int
    share: float


def is_end(name: str) -> bool:
    return name.startswith("end/")


def guided_pairs(start: State, end: State, T: np.ndarray) -> np.ndarray:
    """[n, 2] rows of points that are one under the similarity T [4, 4] start -> end."""
    _, distance = end.model.centre()
    tree = search_tree(end.model.xyz)
    moved = start.model.xyz @ T[:3, :3].T + T[:3, 3]
    reach, near = tree.query(moved, k=8, distance_upper_bound=NEAR * distance)
    rows, column = np.nonzero(np.isfinite(reach))
    pairs = np.stack([rows, near[rows, column]], 1)
    if len(pairs) == 0:
        return pairs
    alike = (start.descriptors[pairs[:, 0]] * end.descriptors[pairs[:, 1]]).sum(1)
    fits = (Votes(start, end, pairs).errors(T, np.arange(len(pairs))) < GUIDED) & (alike > ALIKE)
    pairs, alike = pairs[fits], alike[fits]
    best_a, best_b = np.zeros(len(start.model.ids)), np.zeros(len(end.model.ids))
    np.maximum.at(best_a, pairs[:, 0], alike)
    np.maximum.at(best_b, pairs[:, 1], alike)
    return pairs[(alike == best_a[pairs[:, 0]]) & (alike == best_b[pairs[:, 1]])]


def _shared_lenses(start: Model, end: Model, lens_of: Mapping[str, Hashable] | None) -> dict[int, int]:
    """{end's lens: start's lens} for those that are one, see ``merged``."""

    def kind(model: Model, key: int) -> tuple:
        lens = model.lenses[key]
        names = [photo.name for photo in model.photos.values() if photo.lens == key]
        taken_with = None if lens_of is None else frozenset(lens_of[name] for name in names)
        return lens.width, lens.height, lens.model, taken_with

    known = {kind(start, key): key for key in reversed(start.lenses)}  # of several alike the first
    return {key: known[kind(end, key)] for key in end.lenses if kind(end, key) in known}


def merged(
    start: Model, end: Model, T: np.ndarray, pairs: np.ndarray, lens_of: Mapping[str, Hashable] | None = None
) -> Model:
    """One model in the start's frame. T: [4, 4] start -> end.  pairs: [M, 2] rows of start's and end's points that are
    one.

    Photographs of the end state that were taken with the start's lens share it from here on. lens_of: what each
    photograph was taken with, by name; None: lenses of one size and model are one.
    """
    end = end.moved(np.linalg.inv(T))
    offset = int(start.ids.max(initial=0)) + 1
    new_id = end.ids + offset
    new_id[pairs[:, 1]] = start.ids[pairs[:, 0]]
    lenses, shared = dict(start.lenses), _shared_lenses(start, end, lens_of)
    for key in end.lenses:
        if key not in shared:
            shared[key] = max(lenses) + 1
            lenses[shared[key]] = end.lenses[key]
    photos = dict(start.photos)
    for key, photo in end.photos.items():
        point = np.where(
            photo.point >= 0, new_id[np.searchsorted(end.ids, np.maximum(photo.point, end.ids.min(initial=0)))], -1
        )
        photos[key + END_OFFSET] = replace(photo, lens=shared[photo.lens], point=point)
    own = np.setdiff1d(np.arange(len(end.ids)), pairs[:, 1])
    xyz = start.xyz.copy()
    xyz[pairs[:, 0]] = (start.xyz[pairs[:, 0]] + end.xyz[pairs[:, 1]]) / 2
    return Model(
        lenses, photos, np.concatenate([start.ids, new_id[own]]), np.concatenate([xyz, end.xyz[own]]),
        np.concatenate([start.rgb, end.rgb[own]]),
    )  # fmt: skip


def filtered(model: Model, max_error: float = MAX_ERROR) -> Model:
    """The model without observations worse than ``max_error`` pixels and points that fewer than two photographs are
    left for."""
    rows, _, error = model.errors()
    good = error <= max_error
    counts = np.bincount(rows[good], minlength=len(model.ids))
    keep = counts >= 2
    photos, at = {}, 0
    for key, photo in model.photos.items():
        point = photo.point.copy()
        has = np.flatnonzero(point >= 0)
        fine = good[at : at + len(has)] & keep[rows[at : at + len(has)]]
        point[has[~fine]] = -1
        photos[key] = replace(photo, point=point)
        at += len(has)
    return Model(model.lenses, photos, model.ids[keep], model.xyz[keep], model.rgb[keep])


def states_of(model: Model) -> np.ndarray:
    """[P, 2] bool: whether each point was seen in the start and in the end state."""
    rows, images, _ = model.observations()
    ends = np.array([k for k, photo in model.photos.items() if is_end(photo.name)])
    seen = np.zeros((len(model.ids), 2), bool)
    seen[rows, np.isin(images, ends).astype(int)] = True
    return seen


def adjusted(
    model: Model, folder: Path, principal_point: bool, progress: Callable[[str], None], known: Sequence[int] = ()
) -> Model:
    """The model after bundle adjustment in a child process. known: ids of points that stay where they are.

    An observation counts by Cauchy's loss, at the scale that the model's errors have by their median (a Gaussian's
    errors are estimated with 95 % of least squares' efficiency): a wrong match is wrong by much more than good ones,
    whether these are good to a tenth of a pixel or to one.
    """
    write_model(model, folder / "model")
    deviation = float(np.median(model.errors()[2])) / RAYLEIGH_MEDIAN
    job = {
        "model": str(folder / "model"), "principal_point": principal_point, "iterations": 60, "known": list(known),
        "scale": max(CAUCHY_95 * deviation, LEAST_SCALE),
    }  # fmt: skip
    run_job("adjust", job, folder, progress)
    return read_model(folder / "model")


def join(
    start: State,
    end: State,
    T: np.ndarray,
    folder: Path,
    extra: Callable[[Model], Model],
    measured: Callable[[Model], tuple[Model, list[int]]],
    by_pixels: Callable[[Model], Model],
    progress: Callable[[str], None] = lambda text: None,
    by_board: bool = False,
    lens_of: Mapping[str, Hashable] | None = None,
) -> Model:
    """One adjusted model of both states, of the photographs that are placed surely.

    T: [4, 4] static similarity start -> end.  extra: adds tracks of its own to the merged model (marker corners).
    measured: gives a model in the frame of what is known of it, and the ids of the points whose places are; these stay
    there, so that they calibrate the lens (Zhang 2000, DOI 10.1109/34.888718), which a flat front cannot tell from a
    bent one.  by_pixels: puts observations where the pixels say, given cameras that are nearly right.  by_board:
    nothing but the board says T. Then no other point joins the states (a door moves little beside its hinge, and would
    hold the open state there), and lenses' middles stay where they are unless ``measured`` places points.  lens_of: see
    ``merged``.
    """
    model, known = None, []
    for turn in range(ROUNDS):
        pairs = np.zeros((0, 2), np.int64) if by_board else guided_pairs(start, end, T)
        progress(f"{len(pairs)} points seen in both states")
        model = extra(merged(start.model, end.model, T, pairs, lens_of))
        model = filtered(model, MAX_ERROR * (4 if turn == 0 else 2))
        model = filtered(adjusted(model, folder, False, progress))
        model, known = measured(model)
        if turn + 1 < ROUNDS:
            model = filtered(adjusted(model, folder, False, progress, known)) if known else model
            T = _relative(model, start.model, end.model)
    assert model is not None  # there is at least one round
    middle = bool(known) or not by_board
    for _ in range(REFINED):
        model = by_pixels(filtered(adjusted(model, folder, middle, progress, known)))
    model = filtered(adjusted(model, folder, middle, progress, known))
    return filtered(without_unsure(model))


def _relative(model: Model, start: Model, end: Model) -> np.ndarray:
    """The similarity start -> end that the joint model implies, by the cameras of both."""

    def centres(other: Model, shift: int) -> tuple[np.ndarray, np.ndarray]:
        keys = [k for k in other.photos if k + shift in model.photos]
        reach = 0.3 * other.centre()[1]  # a second point on each axis, so that cameras in a line still fix the turn
        own = [
            p
            for k in keys
            for p in (other.photos[k].position, other.photos[k].position + reach * other.photos[k].forward)
        ]
        return np.array(own), np.array(keys)

    def into_joint(other: Model, shift: int) -> np.ndarray:
        own, keys = centres(other, shift)
        T = np.eye(4)
        for _ in range(2):  # the second point of the joint model's cameras depends on the scale
            scale = np.cbrt(np.linalg.det(T[:3, :3]))
            reach = 0.3 * other.centre()[1] * scale
            there = [
                p
                for k in keys
                for p in (
                    model.photos[k + shift].position,
                    model.photos[k + shift].position + reach * model.photos[k + shift].forward,
                )
            ]
            T = similarity(own, np.array(there))
        return T

    return np.linalg.inv(into_joint(end, END_OFFSET)) @ into_joint(start, 0)


def triangulated(model: Model, end: bool) -> tuple[np.ndarray, np.ndarray]:
    """(points [P, 3], count [P]) from one state's photographs alone: nearest to all rays of each point; NaN below two
    rays."""
    A, b, count = np.zeros((len(model.ids), 3, 3)), np.zeros((len(model.ids), 3)), np.zeros(len(model.ids), int)
    for photo in model.photos.values():
        if is_end(photo.name) != end:
            continue
        has = photo.point >= 0
        rows = np.searchsorted(model.ids, photo.point[has])
        ray = (
            np.pad(model.lenses[photo.lens].rays(photo.xy[has]), ((0, 0), (0, 1)), constant_values=1.0)
            @ photo.viewmat[:3, :3]
        )
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        away = np.linalg.norm(model.xyz[rows] - photo.position, axis=1)
        P = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) / away[:, None, None] ** 2
        np.add.at(A, rows, P)
        np.add.at(b, rows, P @ photo.position)
        np.add.at(count, rows, 1)
    out = np.full((len(model.ids), 3), np.nan)
    good = count >= 2
    out[good] = np.linalg.solve(A[good] + 1e-12 * np.eye(3), b[good][..., None])[..., 0]
    return out, count


def state_bias(model: Model) -> Bias:
    """How far the states are apart; see ``Bias``."""
    centre, distance = model.centre()
    (a, na), (b, nb) = triangulated(model, False), triangulated(model, True)
    both = (na >= 3) & (nb >= 3) & np.isfinite(a).all(1) & np.isfinite(b).all(1)
    share = float(states_of(model).all(1).mean()) if len(model.ids) else 0.0
    if both.sum() < 6:
        return Bias(np.nan, np.nan, np.nan, np.nan, int(both.sum()), share)
    a, b = a[both] - centre, b[both] - centre
    weight = np.ones(len(a))
    for _ in range(10):  # triangulation errors have long tails
        T = similarity(a, b, weight, with_scale=False)
        off = np.linalg.norm(a @ T[:3, :3].T + T[:3, 3] - b, axis=1)
        weight = 1 / (np.linalg.norm(a, axis=1) + distance) ** 2 / (1 + (off / (np.median(off) + 1e-12)) ** 2)
    turn = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
    J = np.concatenate([np.cross(np.eye(3)[None], b[:, None]), np.broadcast_to(np.eye(3), (len(b), 3, 3))], 1)
    normal = np.einsum("n,nik,njk->ij", weight, J, J)  # of a turn about the centre and a shift
    variance = (weight * off**2).sum() / (3 * len(b) - 6)
    spread = variance * np.diag(np.linalg.pinv(normal, hermitian=True))
    sd = np.sqrt([spread[3:].sum(), spread[:3].sum()])
    return Bias(
        float(np.linalg.norm(T[:3, 3])), float(turn), float(sd[0]), float(np.degrees(sd[1])), int(both.sum()), share
    )
