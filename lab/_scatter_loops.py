"""The compiled photon histories of `scatter`: first collision forced, every collision heard all over the detector."""

import math

import numpy as np
from numba import njit

from ._loops import seed_stream, uniform

_ELECTRON_KEV = 510.99895
_STREAMS = 64
# Steps of an additive sequence in four dimensions that fills them evenly: powers of 1 / g, g^5 = g + 1.
_STEPS = tuple(1.1673039782614187 ** -(power + 1) for power in range(4))


@njit(inline="always")
def _cell(x_mm, y_mm, half_x, half_y, step_x, step_y, rows, columns):  # type: ignore[no-untyped-def]
    column = math.floor((x_mm + half_x) / step_x)
    row = math.floor((y_mm + half_y) / step_y)
    if row < 0 or column < 0 or row >= rows or column >= columns:
        return -1
    return row * columns + column


@njit(inline="always")
def _mu_of(cell, energy, share, mu):  # type: ignore[no-untyped-def]
    total = 0.0
    for m in range(share.shape[1]):
        total += share[cell, m] * mu[m, energy]
    return total


@njit(inline="always")
def _pick(table, u):  # type: ignore[no-untyped-def]
    """Place (real index) at which a rising table reaches u."""
    low, high = 0, table.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if table[middle] <= u:
            low = middle
        else:
            high = middle
    gap = table[high] - table[low]
    return low + ((u - table[low]) / gap if gap > 0.0 else 0.0)


@njit(cache=True)
def follow_photons(  # type: ignore[no-untyped-def]
    histories,
    key,
    height_mm,
    share,
    field_mm,
    grid,
    source_mm,
    gap_mm,
    detector_mm,
    tally_grid,
    group_cumulated,
    group_energy,
    lowest_keV,
    step_keV,
    mu,
    scattered,
    coherent,
    angles,
    coherent_cumulated,
    coherent_density,
    incoherent_cumulated,
    incoherent_density,
    points,
    orders,
    tally,
):
    """Add to `tally` (stream, order > 1, cell, energy) what photons that scatter bring to the detector's cells.

    Lengths in mm; the object stands on the plane z = 0 with heights `height_mm` (cell,) and material shares `share`
    (cell, material); source at z = source_mm, detector at z = -gap_mm. `mu`, `scattered` (share of collisions that
    scatter) and `coherent` (share of these) are (material, energy). Densities are per sr and per scattered photon, on
    `angles` even steps of sin(theta / 2).
    """
    rows, columns = grid
    half_y, half_x = 0.5 * field_mm[0], 0.5 * field_mm[1]
    cell_y, cell_x = field_mm[0] / rows, field_mm[1] / columns
    n_energy = mu.shape[1]
    n_material = mu.shape[0]
    tally_rows, tally_columns = tally_grid
    area_mm2 = detector_mm[0] * detector_mm[1] / (points * points)
    state = np.empty(4, dtype=np.uint64)
    seed_stream(state, key, 9, 1, 0)
    offset_x, offset_y, offset_energy, offset_depth = uniform(state), uniform(state), uniform(state), uniform(state)
    per_stream = histories // _STREAMS
    for stream in range(_STREAMS):
        seed_stream(state, key, 9, 0, stream)
        for number in range(stream * per_stream, (stream + 1) * per_stream):
            # Where a history starts is spread evenly: place, energy and depth.
            x = ((offset_x + number * _STEPS[0]) % 1.0 - 0.5) * field_mm[1]
            y = ((offset_y + number * _STEPS[1]) % 1.0 - 0.5) * field_mm[0]
            cell = _cell(x, y, half_x, half_y, cell_x, cell_y, rows, columns)
            if cell < 0 or height_mm[cell] <= 0.0:
                continue
            energy = group_energy[int(_pick(group_cumulated, (offset_energy + number * _STEPS[2]) % 1.0) + 1.0)]
            keV = lowest_keV + step_keV * energy
            length = math.sqrt(x * x + y * y + source_mm * source_mm)
            dx, dy, dz = x / length, y / length, -source_mm / length
            here = _mu_of(cell, energy, share, mu)
            depth = here * height_mm[cell]
            weight = -math.expm1(-depth)
            reached = (offset_depth + number * _STEPS[3]) % 1.0
            z = height_mm[cell] * (1.0 + math.log(1.0 - reached * weight) / depth)
            for order in range(orders):
                # The material that is hit, and what remains of the weight when it does not absorb.
                left = uniform(state) * here
                material = 0
                while material < n_material - 1 and left >= share[cell, material] * mu[material, energy]:
                    left -= share[cell, material] * mu[material, energy]
                    material += 1
                weight *= scattered[material, energy]
                if weight < 1e-7:
                    break
                is_coherent = uniform(state) < coherent[material, energy]
                for point in range(points * points):
                    to_x = ((point % points + uniform(state)) / points - 0.5) * detector_mm[1]
                    to_y = ((point // points + uniform(state)) / points - 0.5) * detector_mm[0]
                    px, py, pz = to_x - x, to_y - y, -gap_mm - z
                    away = math.sqrt(px * px + py * py + pz * pz)
                    px, py, pz = px / away, py / away, pz / away
                    cosine = dx * px + dy * py + dz * pz
                    place = math.sqrt(max(0.5 * (1.0 - cosine), 0.0)) * (angles - 1)
                    below = min(int(place), angles - 2)
                    part = place - below
                    if is_coherent:
                        table = coherent_density[material, energy]
                        seen = energy
                    else:
                        table = incoherent_density[material, energy]
                        out_keV = keV / (1.0 + keV / _ELECTRON_KEV * (1.0 - cosine))
                        seen = min(max(int((out_keV - lowest_keV) / step_keV + 0.5), 0), n_energy - 1)
                    density = table[below] * (1.0 - part) + table[below + 1] * part
                    heard = weight * density * area_mm2 * -pz / (away * away)
                    # Out through the object: only what lies below the collision is in the way.
                    path = z / -pz
                    steps = int(path / 1.5) + 2
                    stride = path / steps
                    exponent = 0.0
                    for s in range(steps):
                        along = (s + 0.5) * stride
                        at = _cell(x + along * px, y + along * py, half_x, half_y, cell_x, cell_y, rows, columns)
                        if at >= 0 and height_mm[at] > z + along * pz:
                            exponent += stride * _mu_of(at, seen, share, mu)
                    t = _cell(
                        to_x,
                        to_y,
                        0.5 * detector_mm[1],
                        0.5 * detector_mm[0],
                        detector_mm[1] / tally_columns,
                        detector_mm[0] / tally_rows,
                        tally_rows,
                        tally_columns,
                    )
                    if t >= 0:
                        tally[stream, 0 if order == 0 else 1, t, seen] += heard * math.exp(-exponent)
                if order == orders - 1:
                    break
                # On in a direction of the law's own.
                table = coherent_cumulated[material, energy] if is_coherent else incoherent_cumulated[material, energy]
                half_sine = _pick(table, uniform(state)) / (angles - 1)
                cosine = 1.0 - 2.0 * half_sine * half_sine
                if not is_coherent:
                    keV = keV / (1.0 + keV / _ELECTRON_KEV * (1.0 - cosine))
                    energy = min(max(int((keV - lowest_keV) / step_keV + 0.5), 0), n_energy - 1)
                sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
                turn = 2.0 * math.pi * uniform(state)
                if abs(dz) < 0.999999:
                    flat = math.sqrt(1.0 - dz * dz)
                    nx = sine * (dx * dz * math.cos(turn) - dy * math.sin(turn)) / flat + dx * cosine
                    ny = sine * (dy * dz * math.cos(turn) + dx * math.sin(turn)) / flat + dy * cosine
                    nz = -sine * math.cos(turn) * flat + dz * cosine
                else:
                    nx, ny, nz = sine * math.cos(turn), sine * math.sin(turn), cosine * dz
                dx, dy, dz = nx, ny, nz
                # To the next collision, or out.
                target = -math.log(uniform(state))
                collided = False
                gone = 0.0
                while True:
                    cell = _cell(x, y, half_x, half_y, cell_x, cell_y, rows, columns)
                    if cell < 0 or z < 0.0 or z > height_mm[cell] + 2.0 or gone > 400.0:
                        break
                    stride = 1.0
                    here = _mu_of(cell, energy, share, mu) if z <= height_mm[cell] else 0.0
                    if here > 0.0 and target <= here * stride:
                        stride = target / here
                        collided = True
                    x, y, z = x + stride * dx, y + stride * dy, z + stride * dz
                    if collided:
                        cell = _cell(x, y, half_x, half_y, cell_x, cell_y, rows, columns)
                        collided = cell >= 0 and z > 0.0 and height_mm[cell] >= z
                        break
                    target -= here * stride
                    gone += stride
                if not collided:
                    break
                here = _mu_of(cell, energy, share, mu)
