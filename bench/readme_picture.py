"""The README's picture, from a finished run of the demo.

    make demo && python bench/readme_picture.py runs/demo docs/demo.png

What the run's media show: both photographs beside the twin and its parts, and the states between.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

WIDTH = 1000  # pixels


def picture(run: Path) -> np.ndarray:
    """[H, WIDTH, 3] uint8, BGR. Raises FileNotFoundError where the run has no media."""
    rows = []
    for name in ("compare.png", "states.png"):
        image = cv2.imread(str(run / "media" / name))
        if image is None:
            raise FileNotFoundError(f"{run / 'media' / name}: there is no picture; expected a finished run (make demo)")
        height = round(image.shape[0] * WIDTH / image.shape[1])
        rows.append(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA))
    return np.concatenate(rows)


if __name__ == "__main__":
    cv2.imwrite(sys.argv[2], picture(Path(sys.argv[1])), [cv2.IMWRITE_PNG_COMPRESSION, 9])
