"""What happens to a picture after the lens: motion, noise, counts; and the truth of flow. Compiled loops.

Noise is drawn from a hash of (key, pixel): the same whatever the order or the number of threads.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import compiled

_f, _i, _u = np.float32, np.int64, np.uint64
_BITS = 16


@lru_cache(maxsize=1)
def normal_table() -> NDArray[np.float32]:
    """65536 quantiles of the standard normal distribution, of mean 0 and variance 1 exactly."""
    inverse = NormalDist().inv_cdf
    half = np.array([inverse((k + 0.5) / (1 << _BITS)) for k in range(1 << (_BITS - 1))])
    both = np.concatenate([half, -half[::-1]])
    return np.asarray(both / both.std(), np.float32)


@lru_cache(maxsize=4)
def exponential_ages(longest: int) -> NDArray[np.float32]:
    """Row n: n instants, in time constants ago, that carry equal shares of an exponential's weight."""
    ages = np.zeros((longest + 1, longest), np.float32)
    for n in range(1, longest + 1):
        ages[n, :n] = -np.log(1 - (np.arange(n) + 0.5) / n)
    return ages


def noise_key(seed: int, stream: int, frame: int) -> np.uint64:
    """The key of one frame of one sensor."""
    state: Any = np.random.SeedSequence(seed, spawn_key=(stream, frame)).generate_state(1, np.uint64)
    return np.uint64(state[0])


@compiled
def _hash(key, index):
    """64 bits for a pixel (the finaliser of SplitMix64; Steele, Lea, Flood 2014)."""
    z = _u(key) + _u(index) * _u(0x9E3779B97F4A7C15)
    z = (z ^ (z >> _u(30))) * _u(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> _u(27))) * _u(0x94D049BB133111EB)
    return z ^ (z >> _u(31))


@compiled
def gather(image, z_m, fx, fy, cx, cy, v, w, span_s, longest, out):
    """Average a colour picture (H x W x 3) along each pixel's way during the exposure, centred on now.

    `v` and `w` are the camera's velocity and angular velocity in its own frame, `z_m` (H x W) depth, 0 for
    very far; lens distortion bends these ways too little to matter.
    """
    height, width = z_m.shape
    for r in range(height):
        y = (_f(r) - cy) / fy
        for c in range(width):
            x = (_f(c) - cx) / fx
            near = _f(1) / z_m[r, c] if z_m[r, c] > 0 else _f(0)
            du = fx * span_s * ((x * v[2] - v[0]) * near + x * y * w[0] - (_f(1) + x * x) * w[1] + y * w[2])
            dv = fy * span_s * ((y * v[2] - v[1]) * near + (_f(1) + y * y) * w[0] - x * y * w[1] - x * w[2])
            length = math.sqrt(du * du + dv * dv)
            if length < _f(0.8):
                out[r, c, 0], out[r, c, 1], out[r, c, 2] = image[r, c, 0], image[r, c, 1], image[r, c, 2]
                continue
            n = min(_i(length * _f(0.8)) + 2, _i(longest))
            step = _f(1) / _f(n)
            blue = green = red = _f(0)
            for k in range(n):
                t = (_f(k) + _f(0.5)) * step - _f(0.5)
                j = min(max(_i(_f(c) + t * du + _f(0.5)), 0), width - 1)
                i = min(max(_i(_f(r) + t * dv + _f(0.5)), 0), height - 1)
                blue += image[i, j, 0]
                green += image[i, j, 1]
                red += image[i, j, 2]
            out[r, c, 0], out[r, c, 1], out[r, c, 2] = blue * step, green * step, red * step


@compiled
def lag(image, z_m, fx, fy, cx, cy, v, w, tau_s, ages, out):
    """What a bolometer of time constant `tau_s` still remembers: exponential weights into the past.

    What a pixel saw t seconds ago lies now where the picture has moved to since: t times its velocity ahead.
    `ages` is `exponential_ages`.
    """
    longest = ages.shape[0] - 1
    height, width = z_m.shape
    for r in range(height):
        y = (_f(r) - cy) / fy
        for c in range(width):
            x = (_f(c) - cx) / fx
            near = _f(1) / z_m[r, c] if z_m[r, c] > 0 else _f(0)
            du = fx * tau_s * ((x * v[2] - v[0]) * near + x * y * w[0] - (_f(1) + x * x) * w[1] + y * w[2])
            dv = fy * tau_s * ((y * v[2] - v[1]) * near + (_f(1) + y * y) * w[0] - x * y * w[1] - x * w[2])
            length = math.sqrt(du * du + dv * dv)
            if length < _f(0.3):
                out[r, c] = image[r, c]
                continue
            n = min(_i(_f(1.5) * length) + 3, longest)
            total = _f(0)
            for k in range(n):
                t = ages[n, k]
                j = min(max(_i(_f(c) + t * du + _f(0.5)), 0), width - 1)
                i = min(max(_i(_f(r) + t * dv + _f(0.5)), 0), height - 1)
                total += image[i, j]
            out[r, c] = total / _f(n)


@compiled
def develop(radiance, light, gain, well, read_e, normals, key, curve, out):
    """Radiance (N x 3) to 8 bit: photon and read noise, full well, conversion gain, 12-bit steps, tone curve.

    `light` (N) is electrons a unit of radiance at each pixel. The normal distribution stands for Poisson's.
    """
    top = _f(curve.shape[0] - 1)
    inv = _f(1) / gain
    for i in range(radiance.shape[0]):
        bits = _hash(key, i)
        for c in range(3):
            e = min(max(radiance[i, c] * light[i], _f(0)), well)
            noise = normals[_i((bits >> _u(16 * c)) & _u(0xFFFF))]
            e += math.sqrt(e + read_e * read_e) * noise
            dn = min(max(e * inv + _f(0.5), _f(0)), top)
            out[i, c] = curve[_i(dn)]


@compiled
def count(kelvin, gain, pattern, housing, netd, per_kelvin, normals, key, out):
    """Kelvin (N) to 14-bit counts: vignetting (`gain`) towards the housing, fixed pattern, temporal noise."""
    for i in range(kelvin.shape[0]):
        noise = normals[_i(_hash(key, i) & _u(0xFFFF))]
        k = housing + (kelvin[i] - housing) * gain[i] + pattern[i] + netd * noise
        out[i] = np.uint16(min(max(k * per_kelvin + _f(0.5), _f(0)), _f(16383)))


@compiled
def depths(range_m, forward, z_m, stored):
    """Range along N rays, whose z is `forward`, to depth: metres (0 for none) and uint16 of 1/256 m."""
    for i in range(range_m.shape[0]):
        z = range_m[i] * forward[i]
        if not z < _f(255.99):
            z_m[i], stored[i] = _f(0), np.uint16(0)
            continue
        z_m[i] = z
        stored[i] = np.uint16(z * _f(256) + _f(0.5))


@compiled
def flow(xn, yn, z_m, T, K, next_z_m, out, hidden):
    """Where every pixel goes in the next frame, in KITTI's form, and whether it can be seen there.

    `xn`, `yn` (H x W) are the pixels' undistorted directions at z = 1, `T` (4 x 4) is T_next_this, `K` is
    fx fy cx cy k1 k2 p1 p2 k3. `out` is H x W x 3 uint16 (u, v, validity), steps of 1/64 px from 2^15.
    `hidden` is 255 outside the frame, and where all four pixels around it are nearer by 1 cm + 1 %.
    """
    height, width = z_m.shape
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = K
    for r in range(height):
        for c in range(width):
            z = np.float64(z_m[r, c])
            out[r, c, 0] = out[r, c, 1] = out[r, c, 2] = np.uint16(0)
            hidden[r, c] = np.uint8(0)
            if z <= 0:
                continue
            px, py = xn[r, c] * z, yn[r, c] * z
            qz = T[2, 0] * px + T[2, 1] * py + T[2, 2] * z + T[2, 3]
            hidden[r, c] = np.uint8(255)
            if qz < 0.01:
                continue
            a = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * z + T[0, 3]) / qz
            b = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * z + T[1, 3]) / qz
            r2 = a * a + b * b
            if r2 > 9:
                continue
            k = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            u = fx * (a * k + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx
            v = fy * (b * k + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy
            du, dv = math.floor((u - c) * 64 + 0.5), math.floor((v - r) * 64 + 0.5)
            if abs(du) >= 32768 or abs(dv) >= 32768:
                continue
            out[r, c, 0], out[r, c, 1] = np.uint16(du + 32768), np.uint16(dv + 32768)
            out[r, c, 2] = np.uint16(1)
            j, i = _i(math.floor(u)), _i(math.floor(v))
            if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
                continue
            j0, j1 = max(j, 0), min(j + 1, width - 1)
            i0, i1 = max(i, 0), min(i + 1, height - 1)
            far = max(max(next_z_m[i0, j0], next_z_m[i0, j1]), max(next_z_m[i1, j0], next_z_m[i1, j1]))
            nothing = (
                min(min(next_z_m[i0, j0], next_z_m[i0, j1]), min(next_z_m[i1, j0], next_z_m[i1, j1])) <= 0
            )
            if nothing or far > qz * 0.99 - 0.01:
                hidden[r, c] = np.uint8(0)


@compiled
def splat(grains, fx, fy, cx, cy, v, w, span_s, radiance):
    """Add discs out of focus, drawn out by motion, to `radiance` (H x W x 3, in place); see `dust.grains`."""
    height, width = radiance.shape[0], radiance.shape[1]
    for g in range(grains.shape[0]):
        u0, v0, z, radius, light = grains[g, 0], grains[g, 1], grains[g, 2], grains[g, 3], grains[g, 4]
        x, y = (u0 - cx) / fx, (v0 - cy) / fy
        du = fx * span_s * ((x * v[2] - v[0]) / z + x * y * w[0] - (_f(1) + x * x) * w[1] + y * w[2])
        dv = fy * span_s * ((y * v[2] - v[1]) / z + (_f(1) + y * y) * w[0] - x * y * w[1] - x * w[2])
        n = min(_i(math.sqrt(du * du + dv * dv) / radius) * 2 + 1, 40)
        value = light / (_f(math.pi) * radius * radius * _f(n))
        for k in range(n):
            t = (_f(k) + _f(0.5)) / _f(n) - _f(0.5)
            u, r = u0 + t * du, v0 + t * dv
            for i in range(max(_i(r - radius - 1), 0), min(_i(r + radius + 2), height)):
                for j in range(max(_i(u - radius - 1), 0), min(_i(u + radius + 2), width)):
                    away = math.sqrt((_f(i) - r) * (_f(i) - r) + (_f(j) - u) * (_f(j) - u))
                    share = min(max(radius - away + _f(0.5), _f(0)), _f(1))
                    share *= _f(0.75) + _f(0.25) * min(away / radius, _f(1))
                    radiance[i, j, 0] += share * value
                    radiance[i, j, 1] += share * value
                    radiance[i, j, 2] += share * value
