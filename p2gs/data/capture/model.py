"""A structure-from-motion model in plain numpy: lenses, posed photographs, points with tracks.

Cameras are OpenCV, world to camera; image coordinates have their origin in the corner of the first pixel (its centre is
at +0.5), as in COLMAP. Reading and writing of COLMAP's files is in ``colmap_io``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from p2gs.types import UserError

# COLMAP's camera models that can be read: number of parameters, focal lengths come first, then the principal point
LENS_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}
ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}


@dataclass(frozen=True)
class Lens:
    """A camera of COLMAP. params: [n] float64, as its model orders them."""

    model: str
    width: int
    height: int
    params: np.ndarray

    def __post_init__(self):
        if self.model not in LENS_MODELS:
            raise UserError(f"camera model {self.model} is not known; known: {', '.join(LENS_MODELS)}")

    @property
    def K(self) -> np.ndarray:
        """[3, 3] float64, pixel centres at +0.5."""
        p = self.params
        fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if self.model in ONE_FOCAL else p[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def fisheye(self) -> bool:
        return self.model == "OPENCV_FISHEYE"

    @property
    def distortion(self) -> np.ndarray:
        """Coefficients in OpenCV's order, [n] with n = 4, 5 or 8 (fisheye: 4, of cv2.fisheye)."""
        p = self.params
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return np.zeros(4)
        if self.model == "SIMPLE_RADIAL":
            return np.array([p[3], 0, 0, 0])
        if self.model == "RADIAL":
            return np.array([p[3], p[4], 0, 0])
        return np.asarray(p[4:12] if self.model == "FULL_OPENCV" else p[4:8], float)

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """[N, 2] normalised, undistorted coordinates (x / z, y / z) of pixels [N, 2]."""
        import cv2

        if len(xy) == 0:
            return np.zeros((0, 2))
        xy = np.ascontiguousarray(xy, np.float64)[:, None]
        if self.fisheye:
            return cv2.fisheye.undistortPoints(xy, self.K, self.distortion)[:, 0]
        return cv2.undistortPoints(xy, self.K, self.distortion)[:, 0]

    def project(self, local: np.ndarray) -> np.ndarray:
        """[N, 2] pixels of points [N, 3] in the camera's coordinates; NaN behind it."""
        import cv2

        if len(local) == 0:
            return np.zeros((0, 2))
        out = np.full((len(local), 2), np.nan)
        front = local[:, 2] > 1e-9
        if front.any():
            points = np.ascontiguousarray(local[front], np.float64)[:, None]
            if self.fisheye:
                out[front] = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.distortion)[0][
                    :, 0
                ]
            else:
                out[front] = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.distortion)[0][:, 0]
        return out


@dataclass
class Photo:
    """A posed photograph. name: as COLMAP has it, ``start/0003.jpg``.  lens: key into ``Model.lenses``.  viewmat: [4,
    4] world -> camera.

    xy: [M, 2] keypoints.  point: [M] int64, id of the point that each belongs to, -1 for none.
    """

    name: str
    lens: int
    viewmat: np.ndarray
    xy: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    point: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def position(self) -> np.ndarray:
        """[3] camera centre."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """[3] unit vector that the camera looks along."""
        return self.viewmat[2, :3]

    @property
    def up(self) -> np.ndarray:
        """[3] unit vector that is up in the picture."""
        return -self.viewmat[1, :3]


@dataclass
class Model:
    """ids: [P] int64, ascending.  xyz: [P, 3].  rgb: [P, 3] uint8.  photos: image id -> Photo."""

    lenses: dict[int, Lens]
    photos: dict[int, Photo]
    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray

    def __len__(self) -> int:
        return len(self.photos)

    def observations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row of the point [O], image id [O], pixel [O, 2]) of every observation of a point, image by image."""
        rows, images, pixels = [], [], []
        for key, photo in self.photos.items():
            has = photo.point >= 0
            rows.append(np.searchsorted(self.ids, photo.point[has]))
            images.append(np.full(has.sum(), key))
            pixels.append(photo.xy[has])
        if not rows:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
        return np.concatenate(rows), np.concatenate(images), np.concatenate(pixels)

    def pixels_of(self, key: int, points: np.ndarray) -> np.ndarray:
        """[N, 2] pixels of world points [N, 3] in an image, NaN behind it."""
        photo = self.photos[key]
        return self.lenses[photo.lens].project(points @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3])

    def errors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row [O], image id [O], reprojection error in pixels [O]) in the order of ``observations``."""
        rows, images, pixels = self.observations()
        error = np.full(len(rows), np.inf)
        for key in self.photos:
            mine = images == key
            error[mine] = np.linalg.norm(self.pixels_of(key, self.xyz[rows[mine]]) - pixels[mine], axis=1)
        return rows, images, np.nan_to_num(error, nan=np.inf)

    def moved(self, T: np.ndarray) -> "Model":
        """The model after the similarity x -> T x (4x4: scaled rotation and translation)."""
        scale = np.cbrt(np.linalg.det(T[:3, :3]))
        R = T[:3, :3] / scale
        photos = {}
        for key, photo in self.photos.items():
            view = np.eye(4)
            view[:3, :3] = photo.viewmat[:3, :3] @ R.T
            view[:3, 3] = scale * photo.viewmat[:3, 3] - view[:3, :3] @ T[:3, 3]
            photos[key] = replace(photo, viewmat=view)
        return Model(self.lenses, photos, self.ids, self.xyz @ T[:3, :3].T + T[:3, 3], self.rgb)

    def centre(self) -> tuple[np.ndarray, float]:
        """([3], distance): the point nearest to all optical axes, and the cameras' median distance from it."""
        A, b = np.zeros((3, 3)), np.zeros(3)
        for photo in self.photos.values():
            P = np.eye(3) - np.outer(photo.forward, photo.forward)
            A, b = A + P, b + P @ photo.position
        point = np.linalg.lstsq(A, b, rcond=1e-6)[0]
        distances = [np.linalg.norm(photo.position - point) for photo in self.photos.values()]
        return point, float(np.median(distances))


def similarity(source: np.ndarray, target: np.ndarray, weight=None, with_scale: bool = True) -> np.ndarray:
    """[4, 4] least-squares similarity that takes points [N, 3] to others [N, 3] (Umeyama 1991,
    doi:10.1109/34.88573)."""
    w = np.ones(len(source)) if weight is None else np.asarray(weight, float)
    w = w / w.sum()
    a, b = w @ source, w @ target
    x, y = source - a, target - b
    U, D, Vt = np.linalg.svd((y * w[:, None]).T @ x)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(sign) @ Vt
    scale = float((D * sign).sum() / (w @ (x * x).sum(1))) if with_scale else 1.0
    T = np.eye(4)
    T[:3, :3] = scale * R
    T[:3, 3] = b - scale * R @ a
    return T
