"""What light and heat do along a ray, pixel by pixel, compiled; arrays in, arrays out.

Every pixel is computed on its own, in float32 without re-association, so that results do not depend on
threads. World frame: x along the drift, y left, z up, metres. Colours are BGR. Loops release the GIL.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

_f = np.float32
_i = np.int64
_u = np.uint64  # as an index it cannot be negative, which numba would otherwise test for

# Columns of the table of materials.
BLUE, GREEN, RED, SPREAD, BUMP, PER_M, EMIT_B, EMIT_G, EMIT_R, WET, DEGC, DEGC_SPREAD, EMISSIVITY = range(13)
# Columns of the table of lamps. WIDTH is the beam's scale in 1 - cos, SHADOW the index of its cube or -1.
X, Y, Z, DX, DY, DZ, LAMP_B, LAMP_G, LAMP_R, WIDTH, SPILL, SHADOW, REACH2, HEAD = range(14)


@compiled
def turn_rays(directions, R, origin, rays):
    """Rays (N x 6) of N unit directions turned by R (3 x 3) from one origin."""
    for i in range(directions.shape[0]):
        a, b, c = directions[i, 0], directions[i, 1], directions[i, 2]
        rays[i, 0], rays[i, 1], rays[i, 2] = origin[0], origin[1], origin[2]
        rays[i, 3] = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        rays[i, 4] = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        rays[i, 5] = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c


# Literals are cast: an integer and a float32 would make a float64, which costs twice as much.


@compiled
def floor_of(x):
    """The largest integer not above a float32."""
    i = _i(x)
    return i - 1 if x < _f(i) else i


@compiled
def volume_at(volume, x, y, z):
    """Trilinear value of a periodic cube (side a power of two, int8) at a position in cells."""
    last = _i(volume.shape[0] - 1)
    i, j, k = floor_of(x), floor_of(y), floor_of(z)
    a, b, c = x - _f(i), y - _f(j), z - _f(k)
    i, j, k = i & last, j & last, k & last
    i1, j1, k1 = (i + 1) & last, (j + 1) & last, (k + 1) & last
    near = _mix(_mix(volume[i, j, k], volume[i, j, k1], c), _mix(volume[i, j1, k], volume[i, j1, k1], c), b)
    far = _mix(
        _mix(volume[i1, j, k], volume[i1, j, k1], c), _mix(volume[i1, j1, k], volume[i1, j1, k1], c), b
    )
    return (near + a * (far - near)) * _f(1 / 40)


@compiled
def _mix(a, b, share):
    return _f(a) + share * (_f(b) - _f(a))


@compiled
def _tile_at(tile, first, side, u, v):
    """Bilinear values of a level of the tile (slope along u, along v, albedo, stain) at tile coordinates."""
    x, y = (u - _f(floor_of(u))) * _f(side), (v - _f(floor_of(v))) * _f(side)
    c, r = _i(x), _i(y)
    a, b = x - _f(c), y - _f(r)
    c, r = c & (side - 1), r & (side - 1)
    c1, r1 = (c + 1) & (side - 1), (r + 1) & (side - 1)
    p, q, s, t = (
        _u(first + r * side + c),
        _u(first + r * side + c1),
        _u(first + r1 * side + c),
        _u(first + r1 * side + c1),
    )
    w0, w1, w2, w3 = (_f(1) - a) * (_f(1) - b), a * (_f(1) - b), (_f(1) - a) * b, a * b
    return (
        w0 * tile[p, 0] + w1 * tile[q, 0] + w2 * tile[s, 0] + w3 * tile[t, 0],
        w0 * tile[p, 1] + w1 * tile[q, 1] + w2 * tile[s, 1] + w3 * tile[t, 1],
        w0 * tile[p, 2] + w1 * tile[q, 2] + w2 * tile[s, 2] + w3 * tile[t, 2],
        w0 * tile[p, 3] + w1 * tile[q, 3] + w2 * tile[s, 3] + w3 * tile[t, 3],
    )


@compiled
def _rock_at(tile, levels, footprint, x, y, z, nx, ny, nz):
    """Texture by position, blended over the three axis planes: gradient (x, y, z), albedo, stain."""
    level = 0
    while footprint > _f(1.4) and level < levels.shape[0] - 1:
        footprint *= _f(0.5)
        level += 1
    first, side = levels[level, 0], levels[level, 1]
    wx, wy, wz = nx * nx, ny * ny, nz * nz
    wx, wy, wz = (
        max(wx * wx - _f(0.06), _f(0)),
        max(wy * wy - _f(0.06), _f(0)),
        max(wz * wz - _f(0.06), _f(0)),
    )
    total = _f(1) / (wx + wy + wz)  # the largest is at least 1/9 - 0.06
    wx, wy, wz = wx * total, wy * total, wz * total
    gx = gy = gz = albedo = stain = _f(0)
    if wx > _f(0):
        du, dv, a, s = _tile_at(tile, first, side, y, z)
        gy, gz, albedo, stain = gy + wx * du, gz + wx * dv, albedo + wx * a, stain + wx * s
    if wy > _f(0):
        du, dv, a, s = _tile_at(tile, first, side, x + _f(0.37), z)
        gx, gz, albedo, stain = gx + wy * du, gz + wy * dv, albedo + wy * a, stain + wy * s
    if wz > _f(0):
        du, dv, a, s = _tile_at(tile, first, side, x + _f(0.71), y + _f(0.19))
        gx, gy, albedo, stain = gx + wz * du, gy + wz * dv, albedo + wz * a, stain + wz * s
    return gx, gy, gz, albedo, stain


@compiled
def lit_share(cubes, cube, x, y, z, distance):
    """The share [0, 1] of a lamp's light that reaches (x, y, z) from it, by its cube of distances."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, m, a, b = (0 if x > 0 else 1), ax, y, z
    elif ay >= az:
        face, m, a, b = (2 if y > 0 else 3), ay, x, z
    else:
        face, m, a, b = (4 if z > 0 else 5), az, x, y
    side = cubes.shape[2]
    half = _f(0.5) * _f(side)
    u, v = (a / m + _f(1)) * half - _f(0.5), (b / m + _f(1)) * half - _f(0.5)
    c, r = min(max(floor_of(u), 0), side - 2), min(max(floor_of(v), 0), side - 2)
    fu, fv = min(max(u - _f(c), _f(0)), _f(1)), min(max(v - _f(r), _f(0)), _f(1))
    near = distance * _f(0.985) - _f(0.05)  # what lies this close behind a surface belongs to it
    lit = _f(0)
    if cubes[cube, face, r, c] > near:
        lit += (_f(1) - fu) * (_f(1) - fv)
    if cubes[cube, face, r, c + 1] > near:
        lit += fu * (_f(1) - fv)
    if cubes[cube, face, r + 1, c] > near:
        lit += (_f(1) - fu) * fv
    if cubes[cube, face, r + 1, c + 1] > near:
        lit += fu * fv
    return lit


@compiled
def _beam(lamps, j, cosine):
    """The beam's profile over 1 - cos(angle), 1 on its axis."""
    x = (_f(1) - cosine) / lamps[j, WIDTH]
    x = _f(1) / (_f(1) + x * x)
    return lamps[j, SPILL] + (_f(1) - lamps[j, SPILL]) * x * x


@compiled
def shade(
    rays, range_m, normal, material, printed, table, tile, levels, lamps, cubes, bounce, sigma, pixel_rad, out
):
    """Radiance (N x 3) that leaves each surface towards the camera, before the dust between them.

    Lambert's law under every lamp, dimmed by dust on its way; `tile` tilts normals and varies albedo. Wet
    ground mirrors scene lamps.
    """
    for i in range(range_m.shape[0]):
        r = range_m[i]
        if not r < _f(1e6):
            out[i, 0] = out[i, 1] = out[i, 2] = _f(0)
            continue
        m = _u(material[i])
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        x, y, z = rays[i, 0] + r * dx, rays[i, 1] + r * dy, rays[i, 2] + r * dz
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        facing = max(-(nx * dx + ny * dy + nz * dz), _f(0.15))
        per_m = table[m, PER_M]
        footprint = r * pixel_rad * per_m * _f(levels[0, 1]) / math.sqrt(facing)
        gx, gy, gz, vary, stain = _rock_at(
            tile, levels, footprint, x * per_m, y * per_m, z * per_m, nx, ny, nz
        )
        wet = table[m, WET] * min(max(stain * _f(1.5) - _f(0.3), _f(0)), _f(1))
        bump = table[m, BUMP] * (_f(1) - _f(0.8) * wet)
        along = gx * nx + gy * ny + gz * nz
        mx, my, mz = (
            nx - bump * (gx - along * nx),
            ny - bump * (gy - along * ny),
            nz - bump * (gz - along * nz),
        )
        unit = _f(1) / math.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx * unit, my * unit, mz * unit
        through = math.exp(-sigma * r)  # from head lamps, which are as near as the lens
        gloss = _f(0)
        blue = green = red = _f(0)
        for j in range(lamps.shape[0]):
            lx, ly, lz = lamps[j, X] - x, lamps[j, Y] - y, lamps[j, Z] - z
            d2 = lx * lx + ly * ly + lz * lz
            if d2 > lamps[j, REACH2]:
                continue
            d = math.sqrt(d2)
            inv = _f(1) / max(d, _f(1e-3))
            lx, ly, lz = lx * inv, ly * inv, lz * inv
            power = _beam(lamps, j, -(lx * lamps[j, DX] + ly * lamps[j, DY] + lz * lamps[j, DZ])) / max(
                d2, _f(0.01)
            )
            cosine = max(mx * lx + my * ly + mz * lz, _f(0))
            reached = _f(1)
            if lamps[j, HEAD] != 0:
                power *= through
            else:
                power *= math.exp(-sigma * d) * (_f(1) - d2 / lamps[j, REACH2])
                if lamps[j, SHADOW] >= 0:
                    reached = lit_share(cubes, _i(lamps[j, SHADOW]), -lx * d, -ly * d, -lz * d, d)
                if wet > 0:
                    hx, hy, hz = lx - dx, ly - dy, lz - dz
                    half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
                    half *= half
                    half *= half
                    half *= half
                    half *= half
                    half *= half
                    half *= half
                    gloss += wet * reached * power * half * half * _f(0.6)
            light = power * (cosine * reached + bounce * (_f(0.35) + _f(0.65) * reached))
            blue += lamps[j, LAMP_B] * light
            green += lamps[j, LAMP_G] * light
            red += lamps[j, LAMP_R] * light
        shine = gloss * lamps[lamps.shape[0] - 1, LAMP_G]
        rho = max(_f(1) + table[m, SPREAD] * (_f(0.7) * vary + _f(0.6) * stain), _f(0.15)) * (
            _f(1) - _f(0.5) * wet
        )
        k = _f(1 / math.pi)
        ink = printed[i]
        if ink == ink:
            out[i, 0] = k * ink * blue + table[m, EMIT_B]
            out[i, 1] = k * ink * green + table[m, EMIT_G]
            out[i, 2] = k * ink * red + table[m, EMIT_R]
        else:
            out[i, 0] = k * table[m, BLUE] * rho * blue + shine + table[m, EMIT_B]
            out[i, 1] = k * table[m, GREEN] * rho * green + shine + table[m, EMIT_G]
            out[i, 2] = k * table[m, RED] * rho * red + shine + table[m, EMIT_R]


@compiled
def fill_fog(
    directions, R, origin, at, sigma, albedo, forward, lamps, cubes, volume, shift, per_m, patchy, fog
):
    """Single scattering along rays of a coarse grid: `fog` (rays x (slices + 1) x 4), cumulated from the
    lens.

    The last of the four is the share of light that comes through; `at` (slices + 1) are distances in metres.
    """
    g2 = _f(1) + forward * forward
    norm = (_f(1) - forward * forward) / _f(4 * math.pi)
    for i in range(directions.shape[0]):
        a, b, c = directions[i, 0], directions[i, 1], directions[i, 2]
        dx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        dy = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        dz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        through = _f(1)
        blue = green = red = _f(0)
        fog[i, 0, 0] = fog[i, 0, 1] = fog[i, 0, 2] = _f(0)
        fog[i, 0, 3] = _f(1)
        for k in range(at.shape[0] - 1):
            step, s = at[k + 1] - at[k], _f(0.5) * (at[k] + at[k + 1])
            x, y, z = origin[0] + s * dx, origin[1] + s * dy, origin[2] + s * dz
            cloud = volume_at(volume, (x - shift[0]) * per_m, (y - shift[1]) * per_m, (z - shift[2]) * per_m)
            here = sigma * max(_f(1) + patchy * cloud, _f(0.05))
            passed = math.exp(-here * step)
            scattered = (_f(1) - passed) * through
            through *= passed
            for j in range(lamps.shape[0]):
                lx, ly, lz = lamps[j, X] - x, lamps[j, Y] - y, lamps[j, Z] - z
                d2 = lx * lx + ly * ly + lz * lz
                if d2 > lamps[j, REACH2]:
                    continue
                d = math.sqrt(d2)
                inv = _f(1) / max(d, _f(1e-3))
                beam = _beam(lamps, j, -(lx * lamps[j, DX] + ly * lamps[j, DY] + lz * lamps[j, DZ]) * inv)
                # light goes from the lamp along -l, on to the camera along -d: it is turned by acos(l . d)
                q = g2 - _f(2) * forward * (lx * dx + ly * dy + lz * dz) * inv
                phase = norm / (q * math.sqrt(q))
                light = beam * phase * scattered * math.exp(-sigma * d) / max(d2, _f(0.02))
                if lamps[j, HEAD] == 0:
                    light *= _f(1) - d2 / lamps[j, REACH2]
                    if lamps[j, SHADOW] >= 0:
                        light *= lit_share(cubes, _i(lamps[j, SHADOW]), -lx, -ly, -lz, d)
                blue += lamps[j, LAMP_B] * light
                green += lamps[j, LAMP_G] * light
                red += lamps[j, LAMP_R] * light
            fog[i, k + 1, 0] = albedo[0] * blue
            fog[i, k + 1, 1] = albedo[1] * green
            fog[i, k + 1, 2] = albedo[2] * red
            fog[i, k + 1, 3] = through


@compiled
def veil(fog, grid_w, cell, bend_m, far_m, range_m, width, radiance):
    """Lay the fog over `radiance` (N x 3, in place): radiance * transmittance + scattered light."""
    slices = fog.shape[1] - 1
    scale = _f(slices) * (far_m + bend_m) / far_m
    for i in range(range_m.shape[0]):
        r = min(range_m[i], far_m)
        row = i // width
        u, v = _f(i - row * width) / _f(cell), _f(row) / _f(cell)
        c0, r0 = _i(u), _i(v)
        a, b = u - _f(c0), v - _f(r0)
        t = min(scale * r / (r + bend_m), _f(slices) - _f(0.001))
        k = _i(t)
        t -= _f(k)
        p = r0 * grid_w + c0
        q = p + grid_w
        w0, w1, w2, w3 = (_f(1) - a) * (_f(1) - b), a * (_f(1) - b), (_f(1) - a) * b, a * b
        n, f = _f(1) - t, t
        blue = w0 * (n * fog[p, k, 0] + f * fog[p, k + 1, 0]) + w1 * (
            n * fog[p + 1, k, 0] + f * fog[p + 1, k + 1, 0]
        )
        blue += w2 * (n * fog[q, k, 0] + f * fog[q, k + 1, 0]) + w3 * (
            n * fog[q + 1, k, 0] + f * fog[q + 1, k + 1, 0]
        )
        green = w0 * (n * fog[p, k, 1] + f * fog[p, k + 1, 1]) + w1 * (
            n * fog[p + 1, k, 1] + f * fog[p + 1, k + 1, 1]
        )
        green += w2 * (n * fog[q, k, 1] + f * fog[q, k + 1, 1]) + w3 * (
            n * fog[q + 1, k, 1] + f * fog[q + 1, k + 1, 1]
        )
        red = w0 * (n * fog[p, k, 2] + f * fog[p, k + 1, 2]) + w1 * (
            n * fog[p + 1, k, 2] + f * fog[p + 1, k + 1, 2]
        )
        red += w2 * (n * fog[q, k, 2] + f * fog[q, k + 1, 2]) + w3 * (
            n * fog[q + 1, k, 2] + f * fog[q + 1, k + 1, 2]
        )
        left = w0 * (n * fog[p, k, 3] + f * fog[p, k + 1, 3]) + w1 * (
            n * fog[p + 1, k, 3] + f * fog[p + 1, k + 1, 3]
        )
        left += w2 * (n * fog[q, k, 3] + f * fog[q, k + 1, 3]) + w3 * (
            n * fog[q + 1, k, 3] + f * fog[q + 1, k + 1, 3]
        )
        radiance[i, 0] = radiance[i, 0] * left + blue
        radiance[i, 1] = radiance[i, 1] * left + green
        radiance[i, 2] = radiance[i, 2] * left + red


@compiled
def warm(
    rays, range_m, material, printed, table, volume, printed_emissivity, air_kelvin, extinction, surface, seen
):
    """Surface temperature and what is seen of it through emissivity and air, both kelvin, N float32.

    Radiance goes with the fourth power of temperature, near enough for a few tens of kelvin. Rays that met
    nothing see air.
    """
    air4 = air_kelvin * air_kelvin * air_kelvin * air_kelvin
    for i in range(range_m.shape[0]):
        r = range_m[i]
        if not r < _f(1e6):
            surface[i], seen[i] = _f(0), air_kelvin
            continue
        m = _u(material[i])
        x, y, z = rays[i, 0] + r * rays[i, 3], rays[i, 1] + r * rays[i, 4], rays[i, 2] + r * rays[i, 5]
        slow = volume_at(volume, x, y, z) + _f(0.35) * volume_at(
            volume, _f(4.1) * x, _f(4.1) * y, _f(4.1) * z
        )
        kelvin = table[m, DEGC] + table[m, DEGC_SPREAD] * slow + _f(273.15)
        emissivity, ink = table[m, EMISSIVITY], printed[i]
        if ink == ink:
            emissivity = printed_emissivity[0] + ink * (printed_emissivity[1] - printed_emissivity[0])
        left = _f(1) - extinction * r + _f(0.5) * extinction * extinction * r * r
        left = max(left, _f(0.2)) * emissivity
        k2 = kelvin * kelvin
        surface[i] = kelvin
        seen[i] = math.sqrt(math.sqrt(left * k2 * k2 + (_f(1) - left) * air4))


@compiled
def volume_values(volume, cells, out):
    """`volume_at` N x 3 positions."""
    for i in range(out.shape[0]):
        out[i] = volume_at(volume, cells[i, 0], cells[i, 1], cells[i, 2])
