"""The same pictures by Mitsuba 3 (extra ``mitsuba``): light that surfaces hand on. The only file that imports it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from p2gs.data.render.tracer import LAMPS, SKY, Picture, Soup, Tracer, srgb
from p2gs.types import Camera, UserError

BOUNCES = 3


class PathTracer:
    """As ``Tracer``: alpha, depth and parts are its, colours Mitsuba's. samples: rays a pixel."""

    def __init__(self, soup: Soup, samples: int = 16):
        try:
            import mitsuba
        except ImportError as err:
            raise UserError("--renderer mitsuba needs the extra 'mitsuba' (pip install 'p2gs[mitsuba]')") from err
        try:
            mitsuba.set_variant("llvm_ad_rgb")
        except Exception as err:  # it finds no LLVM
            raise UserError(f"--renderer mitsuba: {str(err).splitlines()[0]}") from err
        self.mi, self.samples = mitsuba, samples
        self.shape = Tracer(soup, math.ceil(math.sqrt(samples)) ** 2)
        self.scene = mitsuba.load_dict(self.described(soup))

    def described(self, soup: Soup) -> dict[str, Any]:
        """The scene as Mitsuba wants it: a mesh for each texture, and one for each colour."""
        out: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": BOUNCES, "hide_emitters": True},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
        }
        for k, (*way, power) in enumerate(LAMPS):
            light = {"type": "rgb", "value": power}
            out[f"lamp{k}"] = {"type": "directional", "direction": way, "irradiance": light}
        looks = np.concatenate([soup.texture[:, None], np.where(soup.texture[:, None] >= 0, 0, soup.colour)], 1)
        for k, look in enumerate(np.unique(looks, axis=0)):
            out[f"mesh{k}"] = self.mesh(soup, (looks == look).all(1), f"mesh{k}")
        return out

    def mesh(self, soup: Soup, rows: np.ndarray, name: str) -> Any:
        mi, texture = self.mi, int(soup.texture[rows][0])
        if texture >= 0:
            bitmap = mi.Bitmap(np.ascontiguousarray(soup.images[texture]))
            colour: dict[str, Any] = {"type": "bitmap", "bitmap": bitmap, "raw": False, "filter_type": "bilinear"}
        else:
            linear = np.clip(soup.colour[rows][0], 0.03, 0.95) ** 2.2
            colour = {"type": "rgb", "value": linear.tolist()}
        matt = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
        properties, count = mi.Properties(), int(rows.sum())
        properties["mesh_bsdf"] = mi.load_dict(matt)
        made = mi.Mesh(name, 3 * count, count, has_vertex_texcoords=texture >= 0, props=properties)
        parameters = mi.traverse(made)
        parameters["vertex_positions"] = soup.corners[rows].astype(np.float32).ravel()
        parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
        if texture >= 0:
            uv = soup.uv[rows].reshape(-1, 2).astype(np.float32)
            parameters["vertex_texcoords"] = np.stack([uv[:, 0], 1 - uv[:, 1]], 1).ravel()
        parameters.update()
        return made

    def draw(self, camera: Camera) -> Picture:
        """What a camera sees; the principal point is the image's middle."""
        mi, shape = self.mi, self.shape.draw(camera)
        to_world = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        angle = math.degrees(2 * math.atan(camera.width / 2 / float(camera.K[0, 0])))
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgba"}
        sensor = {
            "type": "perspective",
            "fov": angle,
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "film": film | {"rfilter": {"type": "box"}},
            "sampler": {"type": "multijitter", "sample_count": self.samples},
        }
        drawn = np.array(mi.render(self.scene, sensor=mi.load_dict(sensor), spp=self.samples, seed=0))
        light = drawn[..., :3] / np.maximum(drawn[..., 3:4], 1e-4)
        image = (np.clip(srgb(light), 0, 1) * 255 + 0.5).astype(np.uint8)
        return Picture(image, shape.alpha, shape.depth, shape.part)
