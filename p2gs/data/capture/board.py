"""The printed marker board: a PDF to print, its corners in photographs, what they say about scale and up.

4 x 3 ArUco markers (dictionary 4X4_50, ids 0 to 11) of 40 mm, 10 mm apart, on A4 across. The board lies flat on the
floor and stays there while the parts are moved.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from p2gs.data.capture.marker_fit import fitted
from p2gs.data.capture.model import Model, similarity
from p2gs.types import UserError

COLUMNS, ROWS, MARKER, GAP = 4, 3, 0.040, 0.010  # metres
DPI = 300
MIN_CORNERS = 8  # two markers: one alone fixes the scale to a per cent at best
FITS = 0.05  # rms of the corners over the board's diagonal: more and the sheet was not flat, or is another board
FLAT = 0.001  # metres, rms: a sheet that is bent by more is not what was printed, and would bend the lens
# px: smaller photographs are enlarged before markers are sought, which are a dozen pixels wide from across a room
SMALL = 2400
WEIGHT = 10  # features that a corner counts as: it is known to a sixth of a pixel, they to half of one
POINTS, CENTRE = 5, 4  # of a marker: corners 0 to 3 and its centre
MIN_SIGHTINGS = 4  # markers over all photographs: textures that look like one do so once


def template() -> dict[int, np.ndarray]:
    """Marker id -> [4, 3] corners in metres, in the order in which OpenCV gives them; z = 0, z up out of the sheet."""
    out = {}
    for row in range(ROWS):
        for column in range(COLUMNS):
            x, y = column * (MARKER + GAP), -row * (MARKER + GAP)
            corners = [(x, y, 0), (x + MARKER, y, 0), (x + MARKER, y - MARKER, 0), (x, y - MARKER, 0)]
            out[row * COLUMNS + column] = np.array(corners, float)
    return out


def _dictionary():
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def write_board(path: Path) -> None:
    """The sheet as a PDF (or PNG, by the suffix) of A4 across at 300 dpi."""
    import cv2
    from PIL import Image

    def px(metres: float) -> int:
        return round(metres / 0.0254 * DPI)

    width, height = px(0.297), px(0.210)
    page = np.full((height, width), 255, np.uint8)
    board_w, board_h = COLUMNS * MARKER + (COLUMNS - 1) * GAP, ROWS * MARKER + (ROWS - 1) * GAP
    left, top = (0.297 - board_w) / 2, (0.210 - board_h) / 2 - 0.010
    for key, corners in template().items():
        x, y = px(left + corners[0, 0]), px(top - corners[0, 1])
        side = px(left + corners[1, 0]) - x
        page[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(_dictionary(), key, side)
    y = px(0.185)
    cv2.line(page, (px(left), y), (px(left + 0.100), y), 0, 4)
    for k in range(11):
        x = px(left + 0.010 * k)
        cv2.line(page, (x, y), (x, y - px(0.004 if k % 5 else 0.006)), 0, 4)
    text = (
        "p2gs: print at 100 %. This ruler is 100 mm long. Lay flat on the floor beside the object; leave it there "
        "for both states."
    )
    cv2.putText(page, text, (px(left), y + px(0.008)), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 0, 2, cv2.LINE_AA)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(page).save(path, resolution=DPI)
    except (OSError, ValueError) as err:
        raise UserError(
            f"{path}: the board cannot be written ({err}); expected a name that ends in .pdf or .png"
        ) from err


def find_markers(path: Path, mirrored: bool = False) -> dict[int, np.ndarray]:
    """Marker id -> [4, 2] corners in pixels (centres at +0.5) of the board's markers in a photograph.

    mirrored: of a sheet printed (or rendered) mirror-wise; a plane turned over has the same corners, so nothing else
    changes.
    """
    import cv2

    small = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    small = np.ascontiguousarray(small[:, ::-1]) if mirrored else small
    factor = max(1, round(SMALL / max(small.shape)))
    grey = cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC) if factor > 1 else small
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    options.minMarkerPerimeterRate = 0.012  # of the long edge: a marker 3 thousandths wide is what can be read at all
    options.perspectiveRemovePixelPerCell = 8
    corners, ids, _ = cv2.aruco.ArucoDetector(_dictionary(), options).detectMarkers(grey)
    known, out, picture = template(), {}, small.astype(np.float32)
    for key, c in zip([] if ids is None else np.ravel(ids), corners, strict=True):
        c = fitted(picture, int(key), (c.reshape(4, 2) + 0.5) / factor) if int(key) in known else None
        if c is not None:
            out[int(key)] = np.stack([small.shape[1] - c[:, 0], c[:, 1]], 1) if mirrored else c
    return out


def find_board(names: list[str], folder: Path) -> dict[str, dict[int, np.ndarray]]:
    """Photograph's name -> its markers, of the photographs that show any; read as they are or mirror-wise, whichever
    finds more."""
    best: dict[str, dict[int, np.ndarray]] = {}
    for mirrored in (False, True):
        seen = {name: markers for name in names if (markers := find_markers(folder / name, mirrored))}
        if sum(map(len, seen.values())) > sum(map(len, best.values())):
            best = seen
    return best if sum(map(len, best.values())) >= MIN_SIGHTINGS else {}


def corner_id(marker: int, corner: int) -> int:
    """Number of a marker's corner, or of its centre (``CENTRE``)."""
    return POINTS * marker + corner


def with_centre(corners: np.ndarray) -> np.ndarray:
    """[5, 2] pixels of a marker's corners [4, 2] and of its centre, where its diagonals meet."""
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    along = np.linalg.solve(np.stack([a, -b], 1), corners[1] - corners[0])[0]
    return np.vstack([corners, corners[0] + along * a])


def with_corners(model: Model, seen: dict[str, dict[int, np.ndarray]], times: int = 1) -> tuple[Model, dict[int, int]]:
    """The model with a point for each marker's corner and centre that two photographs show, and the ids of these points
    by number (``corner_id``).

    seen: photograph's name -> marker id -> [4, 2] corners.  times: points that each corner becomes; in bundle
    adjustment, which weighs all points alike, it counts as often.
    """
    rays: dict[int, list] = {}
    for key, photo in model.photos.items():
        for marker, found in seen.get(photo.name, {}).items():
            corners = with_centre(found)
            directions = (
                np.pad(model.lenses[photo.lens].rays(corners), ((0, 0), (0, 1)), constant_values=1.0)
                @ photo.viewmat[:3, :3]
            )
            for c in range(POINTS):
                rays.setdefault(corner_id(marker, c), []).append((key, photo.position, directions[c], corners[c]))
    next_id, ids, xyz, points, added = int(model.ids.max(initial=0)) + 1, [], [], {}, {}
    for corner, mine in sorted(rays.items()):
        point = _meet(mine)
        if len(mine) < 2 or point is None:
            continue
        points[corner] = next_id
        for point_id in range(next_id, next_id + times):
            ids.append(point_id), xyz.append(point)
            for key, _, _, pixel in mine:
                added.setdefault(key, []).append((pixel, point_id))
        next_id += times
    if not ids:
        return model, {}
    photos = dict(model.photos)
    for key, mine in added.items():
        photo = photos[key]
        xy, point = np.array([p for p, _ in mine]), np.array([i for _, i in mine])
        photos[key] = replace(photo, xy=np.vstack([photo.xy, xy]), point=np.concatenate([photo.point, point]))
    rgb = np.vstack([model.rgb, np.zeros((len(ids), 3), np.uint8)])
    return Model(model.lenses, photos, np.concatenate([model.ids, ids]), np.vstack([model.xyz, xyz]), rgb), points


def _meet(rays: list) -> np.ndarray | None:
    """The point nearest to rays [(_, origin, direction, _)], robust to one that is off; None where they do not fix
    one."""
    weight = np.ones(len(rays))
    origins, directions = np.array([r[1] for r in rays]), np.array([r[2] for r in rays])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    P = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    for _ in range(5):
        A, b = (weight[:, None, None] * P).sum(0), (weight[:, None] * np.einsum("nij,nj->ni", P, origins)).sum(0)
        if np.linalg.cond(A) > 1e6:
            return None
        point = np.linalg.solve(A, b)
        off = np.linalg.norm(np.einsum("nij,nj->ni", P, point - origins), axis=1)
        weight = 1 / (1 + (off / (np.median(off) + 1e-12)) ** 2)
    return point


def ids_of(points: dict[int, int], times: int, corner: int | None = None) -> list[int]:
    """Ids of all points of the board, or of one number's (``corner_id``). points, times: of ``with_corners``."""
    first = points.values() if corner is None else [points[corner]] if corner in points else []
    return [i + k for i in first for k in range(times)]


def board_pose(model: Model, points: dict[int, int]) -> tuple[np.ndarray, float] | None:
    """([4, 4] similarity metres -> model, weighted rms in metres) of the board; None where too few markers are whole or
    they do not fit."""
    known, there = template(), set(model.ids.tolist())
    whole = [m for m in known if all(points.get(corner_id(m, c)) in there for c in range(POINTS))]
    if 4 * len(whole) < MIN_CORNERS:
        return None
    # centres: a corner creeps where white bleeds into black, a marker's centre does not
    flat = np.array([known[m].mean(0) for m in whole])
    rows = np.searchsorted(model.ids, [[points[corner_id(m, c)] for c in range(POINTS)] for m in whole])
    found = model.xyz[rows[:, CENTRE]]
    if len(whole) == 2:  # two centres are a line: all corners, then
        flat, found = np.concatenate([known[m] for m in whole]), model.xyz[rows[:, :4]].reshape(-1, 3)
    weight = np.ones(len(flat))
    for _ in range(8):  # a marker read wrongly must not stretch the rest
        T = similarity(flat, found, weight)
        scale = np.cbrt(np.linalg.det(T[:3, :3]))
        off = np.linalg.norm(flat @ T[:3, :3].T + T[:3, 3] - found, axis=1) / scale
        weight = 1 / (1 + (off / (np.median(off) + 1e-6)) ** 2)
    rms = float(np.sqrt((weight * off**2).sum() / weight.sum()))
    diagonal = float(np.hypot(COLUMNS, ROWS) * (MARKER + GAP))
    return (T, rms) if rms < FITS * diagonal else None


def measured(model: Model, points: dict[int, int], times: int = 1) -> tuple[Model, list[int], float | None]:
    """The model in the board's frame (metres) with its markers' centres where they are printed, the ids of these points
    and how far they were off before (metres, root mean square); as it is, and no ids, where the board does not fit or
    does not lie flat. (Corners are seen a quarter of a millimetre off, by what is black beside them.)

    points, times: of ``with_corners``.
    """
    pose = board_pose(model, points)
    if pose is None or pose[1] > FLAT:
        return model, [], None if pose is None else pose[1]
    model = model.moved(np.linalg.inv(pose[0]))
    xyz, known = model.xyz.copy(), []
    for marker, corners in template().items():
        ids = ids_of(points, times, corner_id(marker, CENTRE))
        if ids and np.isin(ids, model.ids).all():
            xyz[np.searchsorted(model.ids, ids)] = corners.mean(0)
            known += ids
    return replace(model, xyz=xyz), known, pose[1]


def board_similarity(start: Model, end: Model, seen: dict[str, dict[int, np.ndarray]]) -> np.ndarray | None:
    """[4, 4] similarity start -> end by the board's corners in each state's own model; None where it was not seen in
    both."""
    found = []
    for model in (start, end):
        grown, points = with_corners(model, seen)
        pose = board_pose(grown, points)
        if pose is None:
            return None
        found.append(pose[0])
    return found[1] @ np.linalg.inv(found[0])
