"""Triangles ray-traced on the CPU with Embree (extra ``render``). The only file that imports embreex.

Light as in an overcast yard: an even sky, which every point sees as much of as nothing stands before, and two distant
lamps that cast hard shadows. Surfaces are matt and look alike from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2gs.types import Camera, UserError

SKY = 0.55  # radiance
LAMPS = ((-0.5, 0.6, -1.0, 1.1), (0.8, -0.4, -0.5, 0.6))  # direction of the light, irradiance


@dataclass(frozen=True)
class Soup:
    """corners [F, 3, 3]; part [F]; colour [F, 3] in 0..1 (sRGB); uv [F, 3, 2]; texture [F]: which of ``images``
    ([H, W, 3] uint8), -1 for none."""

    corners: np.ndarray
    part: np.ndarray
    colour: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    images: list[np.ndarray]


@dataclass(frozen=True)
class Picture:
    """image [H, W, 3] and alpha [H, W] uint8; depth [H, W] float32 along the camera's axis (0 where any of the pixel's
    rays passes by) and part [H, W] (-1 for none), both of the ray through its middle."""

    image: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    part: np.ndarray


class Tracer:
    """samples: rays a pixel, a square number.  sky: rays by which a pixel's share of the sky is told.  The same
    arguments give the same pictures. Raises UserError where embreex is not installed."""

    def __init__(self, soup: Soup, samples: int = 9, sky: int = 32):
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as err:
            raise UserError("data render needs the extra 'render' (pip install 'p2gs[render]')") from err
        self.soup, self.samples, self.sky = soup, samples, sky
        self.scene = EmbreeScene()
        TriangleMesh(self.scene, soup.corners.astype(np.float32))
        normal = np.cross(soup.corners[:, 1] - soup.corners[:, 0], soup.corners[:, 2] - soup.corners[:, 0])
        self.normals = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        self.albedo = [_linear(image / 255.0) for image in soup.images]
        extent = soup.corners.reshape(-1, 3)
        self.off = 1e-4 * float((extent.max(0) - extent.min(0)).max())

    def hits(self, origins: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, ...]:
        """Triangle [R] (-1: none), distance [R] in lengths of ``ways`` and barycentric u, v [R] of the first hits."""
        ways = np.ascontiguousarray(ways, np.float32)
        origins = np.ascontiguousarray(np.broadcast_to(origins, ways.shape), np.float32)
        found = self.scene.run(origins, ways, output=True)
        return found["primID"], found["tfar"], found["u"], found["v"]

    def free(self, points: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Whether nothing stands in the way from points [R, 3] along ways [R, 3], [R] bool."""
        ways = np.ascontiguousarray(ways, np.float32)
        return self.scene.run(np.ascontiguousarray(points, np.float32), ways) < 0

    def draw(self, camera: Camera) -> Picture:
        """What a camera sees."""
        width, height, side = camera.width, camera.height, round(self.samples**0.5)
        turn = camera.viewmat[:3, :3].double().numpy()
        eye = -turn.T @ camera.viewmat[:3, 3].double().numpy()
        inverse = np.linalg.inv(camera.K.double().numpy())
        rows, cols = (a.reshape(-1) for a in np.mgrid[0:height, 0:width])

        def cast(x: float, y: float) -> tuple[np.ndarray, ...]:
            ways = np.stack([cols + x, rows + y, np.ones_like(rows)], 1) @ inverse.T @ turn
            return ways, *self.hits(eye, ways)

        _, face, middle, *_ = cast(0.5, 0.5)
        part = np.where(face < 0, -1, self.soup.part[face])
        light, cover, sky = np.zeros((len(rows), 3)), np.zeros(len(rows)), np.full(len(rows), np.nan)
        offsets = (np.arange(side) + 0.5) / side
        for x, y in ((x, y) for y in offsets for x in offsets):
            ways, face, far, u, v = cast(x, y)
            hit = np.flatnonzero(face >= 0)
            light[hit] += self.shade(eye, ways[hit], face[hit], far[hit], u[hit], v[hit], hit, sky)
            cover[hit] += 1
        colour, shape = light / np.maximum(cover, 1)[:, None], (height, width)
        solid = (cover == side * side) & (part >= 0)
        return Picture(
            (np.clip(srgb(colour), 0, 1) * 255 + 0.5).astype(np.uint8).reshape(*shape, 3),
            (255 * cover / side**2 + 0.5).astype(np.uint8).reshape(shape),
            np.where(solid, middle, 0).astype(np.float32).reshape(shape),
            part.reshape(shape),
        )

    def shade(self, eye, ways, face, far, u, v, pixel, sky) -> np.ndarray:
        """Light [R, 3] that rays bring from their first hits. sky [pixels]: shares known so far (NaN: not yet), which
        this fills in."""
        normal = self.normals[face]
        normal = np.where((normal * ways).sum(1, keepdims=True) > 0, -normal, normal)
        point = eye + far[:, None] * ways + self.off * normal
        new = np.flatnonzero(np.isnan(sky[pixel]))
        if len(new):
            sky[pixel[new]] = self.open_sky(point[new], normal[new], pixel[new])
        light = SKY * sky[pixel]
        for *way, power in LAMPS:
            towards = -np.array(way) / np.linalg.norm(way)
            facing = normal @ towards
            lit = np.flatnonzero(facing > 0)
            lit = lit[self.free(point[lit], np.broadcast_to(towards, (len(lit), 3)))]
            light[lit] += power / np.pi * facing[lit]
        return self.colours(face, u, v) * light[:, None]

    def open_sky(self, points: np.ndarray, normals: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Share of the sky [R], by cosine, that points see; each turns one set of directions by an angle of its own."""
        k = np.arange(self.sky)
        radius = np.sqrt((k + 0.5) / self.sky)
        spin = 2 * np.pi * ((seeds * 0.754877666) % 1.0)
        angle = 2.399963 * k[None] + spin[:, None]
        side = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
        a = np.cross(normals, side)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        b = np.cross(normals, a)
        x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)
        ways = x[..., None] * a[:, None] + y[..., None] * b[:, None] + z[None, :, None] * normals[:, None]
        starts = np.repeat(points, self.sky, axis=0)
        return self.free(starts, ways.reshape(-1, 3)).reshape(len(points), self.sky).mean(1)

    def colours(self, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Albedo [R, 3], linear: of the triangle, or its texture between four texels, repeated beyond its rim."""
        out = _linear(np.clip(self.soup.colour[face], 0.03, 0.95))
        which = self.soup.texture[face]
        for k, image in enumerate(self.albedo):
            rows = np.flatnonzero(which == k)
            if not len(rows):
                continue
            weights = np.stack([1 - u[rows] - v[rows], u[rows], v[rows]], 1)
            at = (self.soup.uv[face[rows]] * weights[..., None]).sum(1)
            out[rows] = _texels(image, at)
        return out


def _texels(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    x0, x1, y0, y1 = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    top = (1 - fx) * image[y0, x0] + fx * image[y0, x1]
    return (1 - fy) * top + fy * ((1 - fx) * image[y1, x0] + fx * image[y1, x1])


def _linear(colour: np.ndarray) -> np.ndarray:
    """sRGB decoded (IEC 61966-2-1)."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def srgb(light: np.ndarray) -> np.ndarray:
    """Light in 0..1 encoded (IEC 61966-2-1), an array of any shape."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
