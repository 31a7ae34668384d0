"""What each camera makes of the light: exposure, white balance, gamma, vignette, blur, noise, JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Random = np.random.Generator
Image = NDArray[np.uint8]


def through_a_camera(image: Image, random: Random) -> Image:
    """An ideal (h, w, 3) uint8 image as one more camera would have taken it."""
    h, w = image.shape[:2]
    value = image.astype(np.float32) / 255
    value *= np.exp(random.normal(0, 0.15)) * np.exp(random.normal(0, 0.04, 3)).astype(np.float32)
    if random.random() < 0.5:
        y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j]
        value *= (1 - random.uniform(0, 0.35) * (x * x + y * y) / 2).astype(np.float32)[..., None]
    if random.random() < 0.4:
        value = cv2.GaussianBlur(value, (0, 0), random.uniform(0.3, 1.0))
    value = np.clip(value, 0, 1) ** np.float32(np.exp(random.normal(0, 0.15)))
    value += random.normal(0, 1, value.shape).astype(np.float32) * np.float32(random.uniform(0, 0.03))
    out = np.clip(value * 255 + 0.5, 0, 255).astype(np.uint8)
    if random.random() < 0.4:
        done, code = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(50, 96))])
        out = cv2.imdecode(code, cv2.IMREAD_COLOR) if done else out
    return out
