"""What was hit, ray by ray: one pass over the answers of the ray caster."""

from __future__ import annotations

import numpy as np

from fusion.kernels import compiled

MISS = np.uint32(0xFFFFFFFF)


@compiled
def look_up(triangle, rays, normals, materials, normal, material):
    """Fill `normal` (N x 3) and `material` (N) of the triangles hit; a miss gets its ray reversed and 0."""
    for i in range(triangle.size):
        t = triangle[i]
        x, y, z = rays[i, 3], rays[i, 4], rays[i, 5]
        if t == MISS:
            normal[i, 0], normal[i, 1], normal[i, 2], material[i] = -x, -y, -z, 0
            continue
        a, b, c = normals[t, 0], normals[t, 1], normals[t, 2]
        sign = np.float32(-1.0) if a * x + b * y + c * z > 0 else np.float32(1.0)
        normal[i, 0], normal[i, 1], normal[i, 2], material[i] = sign * a, sign * b, sign * c, materials[t]
