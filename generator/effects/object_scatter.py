"""Radiation scattered by the object: a broad floor in its shadow, wider the further the detector stands behind it.

    S = c (E / E0)^e [a P (-ln T)] * K

P is the primary signal and T = P / P_open; photons that the object takes out of the primary beam reappear elsewhere.
a is the share of its materials' attenuation that is scattering, over that of water, at the beam's mean energy E: metal
absorbs (`own_albedo` 0: every material scatters as water does). e says how scatter behind 20 mm of water changes from
beam to beam: coherent scatter goes forward and fades with energy. c is the strength at the energy E0, for a session's
diagnosis the middle one of its own beams. A pixel that a sharp border cuts scatters as its two sides do.
K is the picture of a scattering point, seen on a plane at distance h:

    K(R) = h / (2 pi (h^2 + R^2)^(3/2)) [1 - w + w 4 pi p(theta)],    tan theta = R / g

p is water's share of scattered photons into a direction, per sr, of the beam behind 20 mm of water; g is the air gap plus 10 mm
(half of a product); `own_directions` w = 0 has all directions alike (then K is half as high at R = 0.77 h), w = 1 those of
free atoms, with h = g for what stands nowhere else than in the air gap. One law for the gap: h grows as a power
(`gap_exponent`, 1: in proportion) of g, and what all directions get stays, so that what a field of finite size catches
falls by itself. `beyond` is how much of what stands at the borders of the picture goes on beyond them and scatters there: 0, the
beam is collimated to the detector; 1, it is far wider; the diagnosis tries both. Photons that scatter more than once are not counted
apart: behind 20 mm of water the virtual lab has 3-7 % of them (40 and 90 kV, 100 and 350 mm of air), spread more evenly.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...materials import (
    mass_attenuation_cm2_g,
    mass_photoelectric_cm2_g,
    material_from_name,
    scattering_per_sr,
)
from ..line.line_state import FloatArray, LineContext, LineState, needed
from ..line.spectral_signal import mean_signal_energy_keV
from ..spread._fine_picture import find_borders
from .effect import Effect, Grid, Parameter, Shows

_HALF_PRODUCT_MM = 10.0
_WATER_MM = 20.0
_BORDER_DEPTH = 1.0  # range of optical depth across 3 x 3 pixels from which a pixel cannot be told by its mean
_ENERGIES = 6  # that stand for a beam where directions depend on them
_COARSE = 48  # cells a side: the kernel is broad, so the convolution is done on block means
_COARSE_BEYOND = 12  # of what comes from beyond the borders, which is smoother
_STRIPS = 7  # beyond a border, each twice as wide as the last one, and the last one without an end
_ENDLESS_MM = 1e7


@lru_cache(maxsize=16)
def _block_means(length: int, most: int = _COARSE) -> tuple[FloatArray, FloatArray, float]:
    """(block mean (cell, pixel), linear interpolation back (pixel, cell), pixels a cell) along one axis."""
    cells = min(most, length)
    edges = np.linspace(0.0, length, cells + 1)
    pixel = np.arange(length)
    overlap = np.minimum(pixel[None, :] + 1.0, edges[1:, None]) - np.maximum(pixel[None, :], edges[:-1, None])
    mean = np.clip(overlap, 0.0, None) / (length / cells)
    if cells == 1:
        return mean, np.ones((length, 1)), float(length)
    position = (pixel + 0.5) / (length / cells) - 0.5
    below = np.clip(np.floor(position).astype(int), 0, cells - 2)
    share = position - below  # beyond the outer centres the line goes on
    back = np.zeros((length, cells))
    back[pixel, below] = 1.0 - share
    back[pixel, below + 1] = share
    return mean, back, length / cells


@dataclass(frozen=True, slots=True)
class _Kernel:
    """The picture of a scattering point: height h, mm; share w of water's own directions, at energies alike, over a gap g, mm."""

    height_mm: float
    own_directions: float
    energies_keV: tuple[float, ...]
    gap_mm: float

    def cell(
        self, y_mm: FloatArray, x_mm: FloatArray, up_mm: FloatArray | float, left_mm: FloatArray | float
    ) -> FloatArray:
        """Its integral over cells of half sides `up_mm` and `left_mm` about (y, x)."""
        alike = sum(
            sign_y * sign_x * _corner(y_mm + sign_y * up_mm, x_mm + sign_x * left_mm, self.height_mm)
            for sign_y in (1.0, -1.0)
            for sign_x in (1.0, -1.0)
        )
        if self.own_directions == 0.0:
            return np.asarray(alike)
        angle = np.arctan2(np.hypot(y_mm, x_mm), self.gap_mm)
        water = material_from_name("water_liquid")
        own = np.mean([4.0 * np.pi * scattering_per_sr(water, one, angle) for one in self.energies_keV], axis=0)
        return np.asarray(alike * (1.0 + self.own_directions * (own - 1.0)))


@lru_cache(maxsize=64)
def _kernel_transform(shape: tuple[int, int], cell_mm: tuple[float, float], kernel: _Kernel) -> NDArray[np.complex128]:
    """FFT of the kernel on the doubled coarse grid, half of it (even in both directions)."""
    rows, columns = 2 * shape[0], 2 * shape[1]
    y = np.asarray(np.fft.fftfreq(rows, 1.0 / rows) * cell_mm[0], dtype=np.float64)[:, None]
    x = np.asarray(np.fft.fftfreq(columns, 1.0 / columns) * cell_mm[1], dtype=np.float64)[None, :]
    return np.fft.rfft2(kernel.cell(y, x, cell_mm[0] / 2, cell_mm[1] / 2))


def _spread(field: FloatArray, pitch_mm: float, kernel: _Kernel) -> FloatArray:
    """Maps (k, row, column) spread by the kernel."""
    row_mean, row_back, row_step = _block_means(field.shape[-2])
    column_mean, column_back, column_step = _block_means(field.shape[-1])
    coarse = row_mean @ field @ column_mean.T
    shape = (coarse.shape[-2], coarse.shape[-1])
    transform = _kernel_transform(shape, (row_step * pitch_mm, column_step * pitch_mm), kernel)
    doubled = (2 * shape[0], 2 * shape[1])
    wide = np.fft.rfft2(coarse, s=doubled, axes=(-2, -1)) * transform
    spread = np.fft.irfft2(wide, s=doubled, axes=(-2, -1))[..., : shape[0], : shape[1]]
    return np.asarray(row_back @ spread @ column_back.T)


@lru_cache(maxsize=64)
def _from_beyond(shape: tuple[int, int], cell_mm: tuple[float, float], kernel: _Kernel) -> FloatArray:
    """What each cell of a field (row, column) gets of what goes on beyond its borders (row, column, 4 + 2 rows + 2 columns).

    Each border cell goes on straight outwards, each of the corners over a quarter of the plane. Order: corners, then rows at the
    left and right border, then columns at the upper and lower one.
    """
    (rows, columns), (high, wide) = shape, cell_mm
    outwards = np.append(kernel.height_mm / 8.0 * (2.0 ** np.arange(_STRIPS) - 1.0), _ENDLESS_MM)
    middle, half = 0.5 * (outwards[1:] + outwards[:-1]), 0.5 * np.diff(outwards)
    y, x = (np.arange(rows) + 0.5) * high, (np.arange(columns) + 0.5) * wide
    up, down = y[:, None] + middle, rows * high - y[:, None] + middle  # from each cell (cell, strip)
    left, right = x[:, None] + middle, columns * wide - x[:, None] + middle
    along_y, along_x = y[:, None] - y, x[:, None] - x

    found = [
        kernel.cell(one[:, None, :, None], two[None, :, None, :], half[:, None], half).sum(axis=(2, 3))[:, :, None]
        for one in (up, down)
        for two in (left, right)
    ]
    found += [
        kernel.cell(along_y[:, None, :, None], two[None, :, None, :], 0.5 * high, half).sum(axis=3)
        for two in (left, right)
    ]
    found += [
        kernel.cell(one[:, None, None, :], along_x[None, :, :, None], half, 0.5 * wide).sum(axis=3)
        for one in (up, down)
    ]
    return np.concatenate(found, axis=2)


def _beyond(field: FloatArray, pitch_mm: float, kernel: _Kernel) -> FloatArray:
    """What maps (k, row, column) get of themselves by the kernel where they go on beyond their borders."""
    row_mean, row_back, row_step = _block_means(field.shape[-2], _COARSE_BEYOND)
    column_mean, column_back, column_step = _block_means(field.shape[-1], _COARSE_BEYOND)
    coarse = row_mean @ field @ column_mean.T
    corners = coarse[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    border = np.concatenate([corners, coarse[:, :, 0], coarse[:, :, -1], coarse[:, 0], coarse[:, -1]], axis=1)
    gets = _from_beyond((coarse.shape[-2], coarse.shape[-1]), (row_step * pitch_mm, column_step * pitch_mm), kernel)
    return np.asarray(row_back @ np.moveaxis(gets @ border.T, -1, 0) @ column_back.T)


def _corner(y_mm: FloatArray, x_mm: FloatArray, height_mm: float) -> FloatArray:
    """Integral of the kernel that has all directions alike, from its centre to (y, x): the solid angle, over 2 pi."""
    h = height_mm
    return np.asarray(np.arctan2(y_mm * x_mm, h * np.sqrt(h**2 + y_mm**2 + x_mm**2)) / (2.0 * np.pi))


@lru_cache(maxsize=64)
def _share_at_centre(shape: tuple[int, ...], pitch_mm: float, kernel: _Kernel) -> float:
    """What the centre of an evenly scattering field gets."""
    up, left = (0.5 * length * pitch_mm / _COARSE for length in shape)
    places: FloatArray = np.arange(_COARSE, dtype=np.float64) * 2.0 + (1.0 - _COARSE)
    y_mm, x_mm = (np.asarray(half * places, dtype=np.float64) for half in (up, left))
    return float(kernel.cell(y_mm[:, None], x_mm[None, :], up, left).sum())


def _energies_keV(weights: FloatArray, energies_keV: FloatArray) -> tuple[float, ...]:
    """Energies that stand for equal shares of a signal (energy,); to 0.1 keV: a step of the spectrum asks for no other kernel."""
    cumulated = np.cumsum(weights) / weights.sum()
    shares = (np.arange(_ENERGIES) + 0.5) / _ENERGIES
    return tuple(round(float(one), 1) for one in np.interp(shares, cumulated, energies_keV[: weights.size]))


def _scattering_share(context: LineContext, energy_keV: float) -> FloatArray:
    """Scattering's share of attenuation (row, column), or (1, 1), over that of water, at an energy."""
    thickness = context.request.thickness_mm
    if not thickness or context.energies_keV is None or context.model is None:
        return np.ones((1, 1))
    water = _albedo("water_liquid", energy_keV)
    at = int(np.searchsorted(context.energies_keV, energy_keV))
    whole, scattered = np.zeros(context.shape), np.zeros(context.shape)
    for name, length_mm in thickness.items():
        depth = float(context.model.mu(name)[at]) * np.asarray(length_mm, dtype=np.float64)
        whole = whole + depth
        scattered = scattered + _albedo(name, energy_keV) / water * depth
    return np.where(whole > 0, scattered / np.maximum(whole, 1e-30), 1.0)


@lru_cache(maxsize=256)
def _albedo(name: str, energy_keV: float) -> float:
    """Share of a material's attenuation that is scattering (Compton and Rayleigh)."""
    material = material_from_name(name)
    total = float(mass_attenuation_cm2_g(material, energy_keV))
    return 1.0 - float(mass_photoelectric_cm2_g(material, energy_keV)) / total


_Shared = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], FloatArray]


def _cut_by_borders(signal: FloatArray, depth: FloatArray) -> _Shared:
    """Pixels that a sharp border cuts, those to either side of it, and the share of each that lies behind the object."""
    borders = find_borders(depth, least_depth=_BORDER_DEPTH)
    bright = signal.ravel()
    thick, thin = bright[borders.thick], bright[borders.thin]
    covered = np.clip((thin - bright[borders.pixel]) / np.maximum(thin - thick, 1e-30), 0.0, 1.0)
    return borders.pixel, borders.thick, borders.thin, covered


def _shared_at_borders(field: FloatArray, shared: _Shared) -> FloatArray:
    """The field (k, row, column) with pixels that a sharp border cuts shared between the values on either side."""
    pixel, thick, thin, covered = shared
    flat = field.reshape(len(field), -1)
    flat[:, pixel] = covered * flat[:, thick] + (1.0 - covered) * flat[:, thin]
    return flat.reshape(field.shape)


def _add_scatter(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0 or context.weights is None:
        return state
    if context.model is None or context.energies_keV is None:
        return state
    name = "object_scatter"
    pitch = needed(context.twin.instrument.pixel_mm, "pixel_mm", name)
    gap = needed(context.source_detector_mm, "source_detector_mm", name)
    gap -= needed(context.source_object_mm, "source_object_mm", name)
    instrument = context.twin.instrument
    usual = gap
    if instrument.source_detector_mm is not None and instrument.source_object_mm is not None:
        usual = instrument.source_detector_mm - instrument.source_object_mm
    height = parameters["width_mm"] / 1.533  # the kernel's full width at half maximum is 1.533 h
    wider = (max(gap, 0.0) + _HALF_PRODUCT_MM) / (max(usual, 0.0) + _HALF_PRODUCT_MM)
    energy_keV = mean_signal_energy_keV(context.weights[0], context.energies_keV)
    weights = context.weights[0]
    water = context.model.mu("water_liquid")[: weights.size]
    behind = weights * np.exp(-_WATER_MM * water)
    at_usual_gap = _Kernel(
        height,
        parameters["own_directions"],
        _energies_keV(behind, context.energies_keV) if parameters["own_directions"] else (),
        max(usual, 0.0) + _HALF_PRODUCT_MM,
    )
    here = replace(
        at_usual_gap,
        height_mm=height * wider ** parameters["gap_exponent"],
        gap_mm=max(gap, 0.0) + _HALF_PRODUCT_MM,
    )
    shape = np.broadcast_shapes(state.signal_DN.shape, context.shape)
    signal = np.broadcast_to(state.signal_DN, shape)
    depth = -np.log(np.maximum(signal / context.open_signal_DN, 1e-12))
    own = parameters["own_albedo"]
    source = depth if own == 0 else depth * (1.0 + own * (_scattering_share(context, energy_keV) - 1.0))
    field = np.stack([signal * source, np.broadcast_to(state.variance_DN2, shape) * source])
    # whatever scatters, borders lie where they lie
    shared = context.made_of(state.signal_DN, "borders of what scatters", lambda: _cut_by_borders(signal, depth))
    field = _shared_at_borders(field, shared)
    scattered = _spread(field, pitch, here)
    centre = _share_at_centre(context.shape, pitch, at_usual_gap)
    if parameters["beyond"] > 0.0:
        scattered += parameters["beyond"] * _beyond(field, pitch, here)
        even = np.ones((1, *context.shape))
        around = _beyond(even, pitch, at_usual_gap)[0]
        centre += parameters["beyond"] * float(around[tuple(length // 2 for length in context.shape)])
    behind_water = -np.log(float(behind.sum()) / float(weights.sum()))
    factor = parameters["strength"] / 100.0 / (behind_water * centre)
    factor *= (energy_keV / parameters["reference_keV"]) ** parameters["energy_exponent"]
    return replace(
        state,
        signal_DN=state.signal_DN + factor * scattered[0],
        variance_DN2=state.variance_DN2 + factor * scattered[1],
    )


OBJECT_SCATTER = Effect(
    id="object_scatter",
    title="radiation scattered by the object",
    law=r"P \to P + s\,(E/E_0)^e\,[a\,P\,(-\ln T)] * K,\quad K(R) = \frac{h}{2\pi\,(h^2 + R^2)^{3/2}}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=1.0,
            high=50.0,
            default=10.0,
            source="scatter over primary at the centre of this field behind 20 mm of water, usual gap, at the reference energy",
            log=False,
        ),
        Parameter(
            name="width_mm",
            unit="mm",
            low=10.0,
            high=600.0,
            default=100.0,
            source="full width at half maximum at the usual gap; 1.5 gaps for scatter alike in all directions",
            log=True,
        ),
        Parameter(
            name="energy_exponent",
            unit="",
            low=-1.5,
            high=1.5,
            default=-0.1,
            source="photons followed one by one, one line, 40 and 90 kV: -0.1 with 350 mm of air, -0.4 with 100 mm",
            log=False,
        ),
        Parameter(
            name="own_albedo",
            unit="",
            low=0.0,
            high=1.0,
            default=1.0,
            source="0: scatter goes with attenuation alone, 1: with the scattering part of each material's",
            log=False,
        ),
        Parameter(
            name="gap_exponent",
            unit="",
            low=0.0,
            high=1.5,
            default=1.0,
            source="1 for a point that scatters; 0: the same width at any gap",
            log=False,
        ),
        Parameter(
            name="own_directions",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="0: all directions alike, 1: as free atoms of water scatter, more of it forward",
            log=False,
        ),
        Parameter(
            name="beyond",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="0: beam collimated to the detector; 1: what stands at the borders goes on beyond them, irradiated",
            log=False,
            fitted=False,
        ),
        Parameter(
            name="reference_keV",
            unit="keV",
            low=5.0,
            high=500.0,
            default=45.0,
            source="of the session: geometric mean of its beams' mean energies",
            log=True,
            fitted=False,
        ),
    ),
    stage="arrivals",
    reference="convolution model of scatter: Ohnesorge, Flohr, Klingenbeck-Regn (1999), doi:10.1007/s003300050710",
    after_calibration=False,
    course="steady",
    change=_add_scatter,
    needs=("spectral", "scene", "pixel_mm", "source_object_mm", "source_detector_mm"),
    isolated_by="a slab at two gaps to the detector, or a beam stop",
    shows=Shows(series=("object",), axis="level", flats=False),
    absorbed="nothing",
    grid=Grid(
        shares=(0.8,),
        variants=(
            {"width_mm": 25.0},
            {"width_mm": 70.0},
            {"width_mm": 200.0},
            {"width_mm": 400.0, "own_directions": 1.0, "energy_exponent": -0.25},
            {"width_mm": 40.0, "energy_exponent": -0.8, "own_albedo": 0.0, "gap_exponent": 0.5},
            {"width_mm": 100.0, "beyond": 1.0},
        ),
    ),
    # photons followed one by one reach shadows that no kernel fills: as a rule up to 3e-3 of its log evidence goes to another
    # effect, 0.016 where 40 % of scatter filled a wide field
)
