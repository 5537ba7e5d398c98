"""A scene as it lies on disk before any pixel is read: one ``Frame`` per photograph, found by the layout's ``index``
function.

Shared by the layouts: JSON reading, pose conversion (camera-to-world OpenGL -> world-to-camera OpenCV) and its checks.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np

from p2gs.data.report import Report
from p2gs.types import Split

STATES = ("start", "end")
ORTHONORMAL_TOLERANCE = 1e-2  # largest entry of |R R^T - I| that passes as rounding of the file's numbers
# scene units: farther away float32 has no digits left for an object, and squares near the end of its range
MAX_COORDINATE = 1e12


@dataclass(frozen=True)
class Frame:
    """One photograph's files and camera.

    image: colour (and alpha) file.  mask: separate mask file (any channel count, > 0 is object) or None: alpha of
    ``image``.
    depth: 16-bit PNG in millimetres or None.  viewmat: [4, 4] float64 world -> camera (OpenCV).
    K: [3, 3] float64 in pixels of the image file, or None when ``fov`` is given: (x, y) field of view in radians,
    principal point in the image's centre, y None for square pixels.
    K_source: the file that the intrinsics come from, for messages.  size: width and height of the image file that they
    are for, or None where that is not told.
    """

    name: str
    state: int
    split: Split
    image: Path
    viewmat: np.ndarray
    K: Optional[np.ndarray] = None
    fov: Optional[tuple[float, Optional[float]]] = None
    K_source: Optional[Path] = None
    size: Optional[tuple[int, int]] = None
    mask: Optional[Path] = None
    depth: Optional[Path] = None

    @property
    def files(self) -> list[Path]:
        """Image, and mask and depth where they are files of their own."""
        return [path for path in (self.image, self.mask, self.depth) if path is not None]

    def intrinsics(self, width: int, height: int) -> np.ndarray:
        """[3, 3] float64 for an image file of this size."""
        if self.K is not None:
            return self.K.copy()
        assert self.fov is not None  # where there is no K
        x, y = self.fov
        fx = width / (2 * np.tan(x / 2))
        fy = fx if y is None else height / (2 * np.tan(y / 2))
        return np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1.0]])

    @property
    def position(self) -> np.ndarray:
        """Camera centre in world coordinates, [3] float64."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


def there(path: Path) -> bool:
    """Whether the path is a file; a name that no file can have (too long, a NUL in it) is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def camera_file(path: Path, report: Report) -> bool:
    """Whether a file of cameras may be read and is there; an error where it is not there."""
    if not report.may_read(path):
        return False
    if not there(path):
        report.error(f"{path}: camera file is missing")
        return False
    return True


def read_json(path: Path, report: Report):
    """The parsed file, or None after an error: missing file, or text that is not JSON."""
    if not camera_file(path, report):
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as err:
        report.error(f"{path}: is not valid JSON ({err})")
        return None


def matrix_of(value, rows: int, cols: int) -> np.ndarray:
    """[rows, cols] float64 of a nested or flat list of numbers (or their text, as YAML has 1e-05). Raises ValueError
    for anything else.

    Counts before it converts: with YAML's aliases a short file holds lists without end.
    """
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, (list, tuple)):
        raise ValueError("no list")
    if len(value) == rows and all(isinstance(row, (list, tuple)) and len(row) == cols for row in value):
        value = [x for row in value for x in row]
    if len(value) != rows * cols:
        raise ValueError(f"{len(value)} entries instead of {rows * cols}")
    try:
        return np.array([float(x) for x in value]).reshape(rows, cols)
    except (TypeError, OverflowError) as err:
        raise ValueError(str(err)) from err


def pose_matrix(value) -> np.ndarray:
    """[4, 4] float64 of a 4x4 or 3x4 matrix, nested or flat. Raises ValueError."""
    try:
        return matrix_of(value, 4, 4)
    except ValueError:
        return np.vstack([matrix_of(value, 3, 4), [0, 0, 0, 1.0]])


def opengl_pose(matrix, where: str, report: Report) -> Optional[np.ndarray]:
    """World-to-camera OpenCV [4, 4] float64 from a camera-to-world OpenGL matrix (camera looks along -z, y up).

    ``matrix``: 4x4 (or 3x4) nested list or 16 numbers.  ``where`` names the file and frame in messages.  The rotation
    is projected to the nearest orthonormal one, so that rounding in the file does not become shear.
    """
    try:
        c2w = pose_matrix(matrix)
    except ValueError:
        report.error(f"{where}: camera pose is not a 4x4 matrix of numbers")
        return None
    if not np.isfinite(c2w).all():
        report.error(f"{where}: camera pose holds values that are not finite")
        return None
    if np.abs(c2w).max() > MAX_COORDINATE:
        report.error(f"{where}: camera pose holds {np.abs(c2w).max():g}, expected coordinates below {MAX_COORDINATE:g}")
        return None
    if np.abs(c2w[3] - [0, 0, 0, 1]).max() > 1e-6:
        report.error(f"{where}: last row of the camera pose is {c2w[3].tolist()} instead of [0, 0, 0, 1]")
        return None
    R = c2w[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > ORTHONORMAL_TOLERANCE:
        report.error(f"{where}: rotation of the camera pose is not orthonormal (it is scaled or sheared)")
        return None
    if np.linalg.det(R) < 0:
        report.error(f"{where}: rotation of the camera pose is a mirror image (determinant -1)")
        return None
    u, _, vt = np.linalg.svd(R)
    R = u @ vt * np.array([1.0, -1.0, -1.0])  # OpenGL -> OpenCV camera axes: y and z turn round
    viewmat = np.eye(4)
    viewmat[:3, :3] = R.T
    viewmat[:3, 3] = -R.T @ c2w[:3, 3]
    return viewmat


def check_K(K, where: str, report: Report) -> Optional[np.ndarray]:
    """[3, 3] float64 intrinsics, or None after an error: not 3x3, focal length not positive, skew."""
    try:
        K = matrix_of(K, 3, 3)
    except ValueError:
        report.error(f"{where}: K is not a 3x3 matrix of numbers")
        return None
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[2] - [0, 0, 1]).max() > 1e-6:
        report.error(f"{where}: K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths")
        return None
    if abs(K[0, 1]) > 1e-6 * K[0, 0] or abs(K[1, 0]) > 1e-6 * K[0, 0]:
        report.error(f"{where}: K has a skew of {K[0, 1]:g}, which is not supported")
        return None
    return K


def check_frames(frames: list[Frame], root: Path, report: Report) -> None:
    """What holds for every layout: training views in both states, unique names; test views and equal intrinsics are
    worth a note."""
    train = {s: [f for f in frames if f.state == s and f.split == "train"] for s in (0, 1)}
    for s, state in enumerate(STATES):
        if not train[s] and not report.failed:
            report.error(f"{root}: state '{state}' has no training views")
        elif 0 < len(train[s]) < 8:
            report.note(f"{root}: state '{state}' has only {len(train[s])} training views; 32 or more are usual")
    seen = set()
    for f in frames:
        if (f.state, f.split, f.name) in seen:
            report.error(f"{f.image}: frame '{f.name}' of state '{STATES[f.state]}' is listed twice")
        seen.add((f.state, f.split, f.name))
    if all(train.values()):
        if len(train[0]) != len(train[1]):
            report.note(
                f"{root}: states have different numbers of training views ({len(train[0])} and {len(train[1])})"
            )
        a, b = train[0][0], train[1][0]
        differ = (a.K is None) != (b.K is None)
        if not differ:
            # the principal point of a window, whose size is told, is where the window lies
            rows = slice(None) if a.size is None or b.size is None else np.arange(2)
            differ = not np.allclose(*(f.intrinsics(100, 100)[rows, rows] for f in (a, b)), rtol=1e-4)
        if differ:
            report.note(f"{root}: the two states were taken with different intrinsics ({a.K_source} and {b.K_source})")
    if frames and not any(f.split == "test" for f in frames):
        report.note(f"{root}: there are no test views, so image metrics cannot be taken on unseen views")
