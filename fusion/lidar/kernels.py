"""The loops over all points of a cloud: where they fall in a picture, and which is nearest there."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled


@compiled
def project_pinhole(xyz, T, camera, size, limits, use_range, first, u, v, value, index, counts):
    """Points through a pinhole: writes u, v, value and index of those inside, returns how many.

    `xyz` N x 3, `T` 3 x 4 (camera from cloud), `camera` fx fy cx cy, `size` w h, `limits` least and largest
    value. `counts` grows by in front, in frame, in range. `first` is the number of point 0.
    """
    fx, fy, cx, cy = camera
    right, bottom = size[0] - 0.5, size[1] - 0.5
    front = frame = kept = 0
    for i in range(xyz.shape[0]):
        a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not z > 0:
            continue
        front += 1
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        column, row = fx * (x / z) + cx, fy * (y / z) + cy
        if not (-0.5 <= column < right and -0.5 <= row < bottom):
            continue
        frame += 1
        d = math.sqrt(x * x + y * y + z * z) if use_range else z
        if not (limits[0] <= d <= limits[1]):
            continue
        u[kept], v[kept], value[kept], index[kept] = column, row, d, first + i
        kept += 1
    counts[0] += front
    counts[1] += frame
    counts[2] += kept
    return kept


@compiled
def nearest_of_pixels(u, v, value, image):
    """The z-buffer: the least value of every pixel into `image` (0: none); how many samples lie outside."""
    h, w = image.shape
    pixels = image.reshape(-1)
    right, bottom = w - 0.5, h - 0.5
    outside = 0
    for i in range(u.size):
        if not (-0.5 <= u[i] < right and -0.5 <= v[i] < bottom):
            outside += 1
            continue
        # Not negative. The sum may round up to the size: 0.49999999999999994 + 0.5 is 1.
        column, row = min(np.int64(u[i] + 0.5), w - 1), min(np.int64(v[i] + 0.5), h - 1)
        pixel = np.uint64(row * w + column)
        held = pixels[pixel]
        pixels[pixel] = value[i] if held == 0 or value[i] < held else held
    return outside
