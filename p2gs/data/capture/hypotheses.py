"""How the end state's reconstruction lies to the start state's: every rigid thing that both show votes for a
similarity.

The room votes for one, each part that moved for another. Which is the room's? Not the one with the most votes: a
textured drawer front in front of a plain wall has nearly all of them, and fastening the open state to it looks perfect
in every photograph. It is the one whose support is widest in space. Where none is wide the capture cannot be used, and
this module says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from p2gs.data.capture.model import Model, similarity

# nearest to second-nearest distance of mean descriptors; they are more alike than single ones, hence not 0.8
RATIO = 0.9
MAX_COSINE_GAP = 0.25  # 1 - cosine of two descriptors of one thing
# reprojection error of a vote as a share of the image's long edge: two reconstructions' points agree to about 8 mm at 1
# m
INLIER = 0.008
MIN_VOTES = 12  # a similarity has 7 unknowns, 3 votes fix it; chance reached 8 in rooms without common texture
MAX_HYPOTHESES = 6
TRIALS = 1500  # samples of three: finds a group of a seventh of the votes with 98 %
WIDE = 0.25  # spread over the cameras' distance from the object: a front that fills the picture reaches 0.2
OUTSIDE = 0.15  # share of the support that lies outside the object's ball
BALL = 0.45  # that ball's radius over the cameras' distance: half of what a 50 degree lens sees
RIVAL = 0.7  # a second hypothesis as wide as this share of the first leaves the choice open


@dataclass
class State:
    """A state's reconstruction and the mean descriptor [P, 128] float32, unit length, of each of its points."""

    model: Model
    descriptors: np.ndarray


@dataclass(frozen=True, eq=False)  # arrays have no one answer to whether they are equal
class Hypothesis:
    """T: [4, 4] similarity start -> end.  pairs: [n, 2] rows of start's and end's points that support it.

    spread: how far the support reaches about its median, root mean square over the cameras' distance.  outside: share
    of it outside the object's ball.  board: whether the marker board says the same (None without one).
    """

    T: np.ndarray
    pairs: np.ndarray
    spread: float
    outside: float
    board: bool | None = None

    @property
    def wide(self) -> bool:
        return self.spread >= WIDE and self.outside >= OUTSIDE

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.T[:3, :3])))

    def to_dict(self) -> dict:
        return {
            "votes": len(self.pairs),
            "spread": round(self.spread, 3),
            "outside": round(self.outside, 3),
            "board": self.board,
        }


def match_descriptors(a: np.ndarray, b: np.ndarray, chunk: int = 2000) -> np.ndarray:
    """[n, 2] rows of a [N, 128] and b [M, 128] (unit length) that are each other's nearest and pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    forth, good = np.zeros(len(a), np.int64), np.zeros(len(a), bool)
    back, best = np.zeros(len(b), np.int64), np.full(len(b), -1.0, np.float32)
    for lo in range(0, len(a), chunk):
        cosine = a[lo : lo + chunk] @ b.T
        top = np.argpartition(-cosine, 1, axis=1)[:, :2]
        values = np.take_along_axis(cosine, top, 1)
        order = np.argsort(-values, axis=1)
        top, values = np.take_along_axis(top, order, 1), np.take_along_axis(values, order, 1)
        forth[lo : lo + chunk] = top[:, 0]
        gap = 1 - values  # squared distance over two
        good[lo : lo + chunk] = (gap[:, 0] < RATIO**2 * gap[:, 1]) & (gap[:, 0] < MAX_COSINE_GAP)
        column, value = cosine.argmax(0), cosine.max(0)
        better = value > best
        back[better], best[better] = column[better] + lo, value[better]
    rows = np.flatnonzero(good & (back[forth] == np.arange(len(a))))
    return np.stack([rows, forth[rows]], 1)


class Sightings:
    """One sighting of each point: its camera [P, 3, 4], the ray it was seen along [P, 2], the focal length over the
    long edge [P]."""

    def __init__(self, model: Model):
        rows, images, pixels = model.observations()
        order = np.argsort(rows, kind="stable")
        starts = np.searchsorted(rows[order], np.arange(len(model.ids)))
        counts = np.bincount(rows, minlength=len(model.ids))
        middle = order[np.minimum(starts + counts // 2, len(order) - 1)]  # of an orbit's track the one in the middle
        self.camera, self.ray, self.focal = (
            np.zeros((len(model.ids), 3, 4)),
            np.zeros((len(model.ids), 2)),
            np.zeros(len(model.ids)),
        )
        for key in np.unique(images[middle]):
            mine = images[middle] == key
            photo = model.photos[key]
            lens = model.lenses[photo.lens]
            self.camera[mine], self.focal[mine] = photo.viewmat[:3], lens.K[0, 0] / max(lens.width, lens.height)
            self.ray[mine] = lens.rays(pixels[middle[mine]])

    def residuals(self, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
        """[n, 2] reprojection errors of points [n, 3] where the points of ``rows`` were seen, over the long edge; 1
        behind the camera."""
        C = self.camera[rows]
        local = np.einsum("nij,nj->ni", C[:, :, :3], points) + C[:, :, 3]
        front = local[:, 2] > 1e-9
        z = np.where(front, local[:, 2], 1.0)
        error = (local[:, :2] / z[:, None] - self.ray[rows]) * self.focal[rows, None]
        return np.where(front[:, None], error, 1.0)


class Votes:
    """Pairs of points that look alike, and how well a similarity explains each of them."""

    def __init__(self, start: State, end: State, pairs: np.ndarray | None = None):
        self.start, self.end = start.model, end.model
        self.pairs = match_descriptors(start.descriptors, end.descriptors) if pairs is None else pairs
        self.seen_start, self.seen_end = Sightings(start.model), Sightings(end.model)

    def residuals(self, T: np.ndarray, which) -> np.ndarray:
        """[n, 4] reprojection errors of start's points in end's photographs and the reverse, over the long edge."""
        a, b = self.pairs[which, 0], self.pairs[which, 1]
        back = np.linalg.inv(T)
        there = self.start.xyz[a] @ T[:3, :3].T + T[:3, 3]
        here = self.end.xyz[b] @ back[:3, :3].T + back[:3, 3]
        return np.hstack([self.seen_end.residuals(b, there), self.seen_start.residuals(a, here)])

    def errors(self, T: np.ndarray, which) -> np.ndarray:
        """[n] the larger of the two reprojection errors."""
        r = self.residuals(T, which)
        return np.maximum(np.hypot(r[:, 0], r[:, 1]), np.hypot(r[:, 2], r[:, 3]))

    def refined(self, T: np.ndarray, which: np.ndarray) -> np.ndarray:
        """T after a robust least-squares fit of its reprojection errors on the votes ``which``."""
        centre = self.start.xyz[self.pairs[which, 0]].mean(0)

        def apply(x):
            return _perturbed(T, x, centre)

        size = np.linalg.norm(self.start.xyz[self.pairs[which, 0]] - centre, axis=1).mean() + 1e-9
        out = least_squares(
            lambda x: self.residuals(apply(x), which).ravel(), np.zeros(7), loss="soft_l1", f_scale=INLIER / 3,
            x_scale=[0.01] * 3 + [0.01 * size] * 3 + [0.01], max_nfev=20,
        )  # fmt: skip
        return apply(out.x)


def _perturbed(T: np.ndarray, x: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """T after a small similarity of start's points about ``centre``: turn x[:3], shift x[3:6], log scale x[6]."""
    step = np.eye(4)
    step[:3, :3] = np.exp(x[6]) * Rotation.from_rotvec(x[:3]).as_matrix()
    step[:3, 3] = centre + x[3:6] - step[:3, :3] @ centre
    return T @ step


def _sampled(votes: Votes, left: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """The similarity of three votes that most of ``left`` agree with; None where no sample makes sense."""
    a, b = votes.start.xyz[votes.pairs[left, 0]], votes.end.xyz[votes.pairs[left, 1]]
    best, most = None, 0
    for _ in range(TRIALS):
        three = rng.choice(len(left), 3, replace=False)
        T = similarity(a[three], b[three])
        scale = np.cbrt(np.linalg.det(T[:3, :3]))
        if not np.isfinite(scale) or not 0.02 < scale < 50:
            continue
        count = int((votes.errors(T, left) < INLIER).sum())
        if count > most:
            best, most = T, count
    return best


def find_hypotheses(start: State, end: State, votes: Votes | None = None, seed: int = 0) -> list[Hypothesis]:
    """All similarities start -> end that at least ``MIN_VOTES`` votes agree on, widest support first."""
    votes = votes or Votes(start, end)
    left, found = np.arange(len(votes.pairs)), []
    rng = np.random.default_rng(seed)
    while len(left) >= MIN_VOTES and len(found) < MAX_HYPOTHESES:
        T = _sampled(votes, left, rng)
        if T is None:
            break
        for _ in range(3):
            support = left[votes.errors(T, left) < INLIER]
            if len(support) < MIN_VOTES:
                break
            T = votes.refined(T, support)
        support = left[votes.errors(T, left) < INLIER]
        if len(support) < MIN_VOTES:
            break
        found.append(Hypothesis(T, votes.pairs[support], *extent(start.model, votes.pairs[support, 0])))
        left = left[votes.errors(T, left) >= 3 * INLIER]  # the fringe of a group is no group of its own
    return sorted(found, key=lambda h: -h.spread)


def extent(model: Model, rows: np.ndarray) -> tuple[float, float]:
    """(spread, share outside the object's ball) of points of a model; see ``Hypothesis``."""
    centre, distance = model.centre()
    points = model.xyz[rows]
    away = np.sort(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    away = away[: max(int(0.9 * len(away)), 1)]  # a few points far behind the room say nothing about it
    outside = np.linalg.norm(points - centre, axis=1) > BALL * distance
    return float(np.sqrt((away**2).mean()) / distance), float(outside.mean())
