"""Segmentation models that the user has, for masks: what the coarse splat says the object is, is the question, and the
model draws its edge.

``FILE.onnx``: a net that finds the object of a picture (U2-Net, IS-Net, BiRefNet: one picture in, one map out), run by
onnxruntime on a cut-out around the object. ``sam2:CONFIG:CHECKPOINT``: SAM 2 (Ravi et al. 2024, arXiv:2408.00714),
asked with the object's frame. None of them comes with p2gs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from p2gs.data.box import mask_bounds
from p2gs.types import UserError

Segmenter = Callable[
    [np.ndarray, np.ndarray], np.ndarray
]  # image [h, w, 3] uint8 RGB, asked [h, w] bool -> [h, w] bool
AROUND = 0.15  # of the object's frame: how much of what is beside it a net sees, to tell it from that
SIDE = 1024  # px: of a net's picture where it takes any
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, with which these nets were trained


def segmenter_of(name: str) -> Segmenter:
    """The model that ``name`` (the option ``--mask_model``) means. Raises UserError where it or what runs it is not
    there, or it is another kind of model."""
    if name.startswith("sam2:"):
        return sam2_segmenter(name)
    if not name.endswith(".onnx"):
        raise UserError(f"--mask_model {name}: expected FILE.onnx or sam2:CONFIG:CHECKPOINT")
    if not Path(name).is_file():
        raise UserError(f"--mask_model {name}: there is no such file")
    try:
        import onnxruntime
    except ImportError as err:
        raise UserError(
            f"--mask_model {name} is run by onnxruntime, which is not installed: pip install onnxruntime"
        ) from err
    try:
        return net_segmenter(onnxruntime.InferenceSession(name, providers=["CPUExecutionProvider"]))
    except Exception as err:  # its own exceptions have no common base
        raise UserError(f"--mask_model {name}: onnxruntime cannot read it: {str(err).splitlines()[0]}") from err


def frame_of(asked: np.ndarray, around: float) -> tuple[slice, slice]:
    """Rows and columns around what is true in ``asked`` [h, w], wider by ``around`` of the longer side."""
    x0, y0, x1, y1 = mask_bounds(torch.from_numpy(asked))
    margin = round(around * (max(x1 - x0, y1 - y0) - 1))
    height, width = asked.shape
    rows = slice(max(y0 - margin, 0), min(y1 + margin, height))
    return rows, slice(max(x0 - margin, 0), min(x1 + margin, width))


def net_segmenter(session) -> Segmenter:
    """session: of onnxruntime; its first input is a picture [1, 3, H, W], its first output a map [1, 1, H, W], of
    shares or of their logits."""
    import cv2

    entry = session.get_inputs()[0]
    if len(entry.shape) != 4 or entry.shape[1] != 3:
        raise ValueError(f"its input {entry.name} is {entry.shape}, expected a picture [1, 3, height, width]")
    height, width = (n if isinstance(n, int) else SIDE for n in entry.shape[2:])

    def segment(image: np.ndarray, asked: np.ndarray) -> np.ndarray:
        window = frame_of(asked, AROUND)
        cut = image[window]
        picture = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        picture = ((picture - MEAN) / DEVIATION).astype(np.float32).transpose(2, 0, 1)[None]
        found = np.asarray(session.run(None, {entry.name: picture})[0], np.float32)
        found = found.reshape(found.shape[-2:])
        logits = found.min() < 0 or found.max() > 1
        found = cv2.resize(found, cut.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        out = np.zeros(asked.shape, bool)
        out[window] = found > (0 if logits else 0.5)
        return out

    return segment


def sam2_segmenter(name: str) -> Segmenter:
    """SAM 2 by ``sam2:CONFIG:CHECKPOINT``, as its ``build_sam2`` takes them."""
    parts = name.split(":", 2)
    if len(parts) != 3 or not all(parts):
        raise UserError(f"--mask_model {name}: expected sam2:CONFIG:CHECKPOINT")
    _, config, checkpoint = parts
    if not Path(checkpoint).is_file():
        raise UserError(f"--mask_model {name}: there is no file {checkpoint}")
    try:
        from sam2.build_sam import build_sam2
        from sam2.sam2_image_predictor import SAM2ImagePredictor
    except ImportError as err:
        raise UserError(f"--mask_model {name} is run by SAM 2, which is not installed: pip install sam2") from err
    device = "cuda" if torch.cuda.is_available() else "cpu"
    predictor = SAM2ImagePredictor(build_sam2(config, checkpoint, device=device))

    def segment(image: np.ndarray, asked: np.ndarray) -> np.ndarray:
        rows, columns = frame_of(asked, 0.0)
        predictor.set_image(image)
        masks, _, _ = predictor.predict(
            box=np.array([columns.start, rows.start, columns.stop, rows.stop], np.float32), multimask_output=False
        )
        return np.asarray(masks[0]) > 0.5

    return segment
