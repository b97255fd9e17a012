"""Radiation scattered by the object: a broad floor in its shadow, wider the further the detector stands behind it.

    S = c (E / 45 keV)^e [a P (-ln T)] * K,    sum K = 1

P is the primary signal and T = P / P_open; photons that the object takes out of the primary beam reappear elsewhere.
a is the share of its materials' attenuation that is scattering, over that of water, at the beam's mean energy E: metal
absorbs (`own_albedo` 0: every material scatters as water does). e says how scatter behind 20 mm of water changes from
beam to beam: coherent scatter goes forward and fades with energy. A pixel that a sharp border cuts scatters as its two
sides do.
K is the picture of a point that scatters into all directions alike, seen on a plane at distance h:
K(R) = h / (2 pi (h^2 + R^2)^(3/2)), half as high at R = 0.77 h. One law for the air gap: h grows as a power
(`gap_exponent`, 1: in proportion) of the gap plus 10 mm (half of a product), and the scattered light in all stays, so
that what a field of finite size catches falls by itself. Only the field that the detector covers is irradiated.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...materials import mass_attenuation_cm2_g, mass_photoelectric_cm2_g, material_from_name
from .._fine_picture import find_borders
from ..line_state import LineContext, LineState, needed
from .effect import Effect, Parameter

_HALF_PRODUCT_MM = 10.0
_WATER_MM = 20.0
_REFERENCE_KEV = 45.0
_BORDER_DEPTH = 1.0  # range of optical depth across 3 x 3 pixels from which a pixel cannot be told by its mean
_COARSE = 48  # cells a side: the kernel is broad, so the convolution is done on block means


@lru_cache(maxsize=8)
def _block_means(length: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(block mean (cell, pixel), linear interpolation back (pixel, cell), pixels a cell) along one axis."""
    cells = min(_COARSE, length)
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


@lru_cache(maxsize=64)
def _kernel_transform(
    shape: tuple[int, int], cell_mm: tuple[float, float], half_height_mm: float
) -> NDArray[np.complex128]:
    """FFT of the kernel on the doubled coarse grid, half of it (even in both directions)."""
    rows, columns = 2 * shape[0], 2 * shape[1]
    y = np.asarray(np.fft.fftfreq(rows, 1.0 / rows) * cell_mm[0], dtype=np.float64)[:, None]
    x = np.asarray(np.fft.fftfreq(columns, 1.0 / columns) * cell_mm[1], dtype=np.float64)[None, :]
    up, left = cell_mm[0] / 2, cell_mm[1] / 2
    kernel = sum(
        sign_y * sign_x * _corner(y + sign_y * up, x + sign_x * left, half_height_mm)
        for sign_y in (1.0, -1.0)
        for sign_x in (1.0, -1.0)
    )
    return np.fft.rfft2(kernel)


def _spread(field: NDArray[np.float64], pitch_mm: float, half_height_mm: float) -> NDArray[np.float64]:
    """Maps (k, row, column) spread by the kernel."""
    row_mean, row_back, row_step = _block_means(field.shape[-2])
    column_mean, column_back, column_step = _block_means(field.shape[-1])
    coarse = row_mean @ field @ column_mean.T
    shape = (coarse.shape[-2], coarse.shape[-1])
    transform = _kernel_transform(shape, (row_step * pitch_mm, column_step * pitch_mm), half_height_mm)
    doubled = (2 * shape[0], 2 * shape[1])
    wide = np.fft.rfft2(coarse, s=doubled, axes=(-2, -1)) * transform
    spread = np.fft.irfft2(wide, s=doubled, axes=(-2, -1))[..., : shape[0], : shape[1]]
    return np.asarray(row_back @ spread @ column_back.T)


def _corner(y_mm: NDArray[np.float64], x_mm: NDArray[np.float64], half_height_mm: float) -> NDArray[np.float64]:
    """Integral of the kernel over a rectangle from its centre to (y, x): the solid angle, over 2 pi."""
    h = half_height_mm
    return np.asarray(np.arctan2(y_mm * x_mm, h * np.sqrt(h**2 + y_mm**2 + x_mm**2)) / (2.0 * np.pi))


def _share_at_centre(shape: tuple[int, ...], pitch_mm: float, half_height_mm: float) -> float:
    """What the centre of an evenly scattering field gets."""
    y, x = (np.array(0.5 * length * pitch_mm) for length in shape)
    return 4.0 * float(_corner(y, x, half_height_mm))


def _mean_energy_keV(context: LineContext) -> float:
    """Mean energy of the open beam's signal, keV."""
    if context.weights is None or context.energies_keV is None:
        return _REFERENCE_KEV
    weights = context.weights[0]
    return float(weights @ context.energies_keV[: weights.size] / weights.sum())


def _scattering_share(context: LineContext, energy_keV: float) -> NDArray[np.float64]:
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


def _shared_at_borders(
    field: NDArray[np.float64], signal: NDArray[np.float64], depth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The field (k, row, column) with pixels that a sharp border cuts shared between the values on either side."""
    borders = find_borders(depth, least_depth=_BORDER_DEPTH)
    if not borders.pixel.size:
        return field
    flat, bright = field.reshape(len(field), -1).copy(), signal.ravel()
    thick, thin = bright[borders.thick], bright[borders.thin]
    covered = np.clip((thin - bright[borders.pixel]) / np.maximum(thin - thick, 1e-30), 0.0, 1.0)
    flat[:, borders.pixel] = covered * flat[:, borders.thick] + (1.0 - covered) * flat[:, borders.thin]
    return flat.reshape(field.shape)


def _add_scatter(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0 or context.weights is None or context.model is None:
        return state
    name = "object_scatter"
    pitch = needed(context.twin.instrument.pixel_mm, "pixel_mm", name)
    gap = needed(context.source_detector_mm, "source_detector_mm", name)
    gap -= needed(context.source_object_mm, "source_object_mm", name)
    instrument = context.twin.instrument
    usual = gap
    if instrument.source_detector_mm is not None and instrument.source_object_mm is not None:
        usual = instrument.source_detector_mm - instrument.source_object_mm
    half_height = parameters["width_mm"] / 1.533  # the kernel's full width at half maximum is 1.533 h
    at_usual_gap = half_height
    wider = (max(gap, 0.0) + _HALF_PRODUCT_MM) / (max(usual, 0.0) + _HALF_PRODUCT_MM)
    half_height *= wider ** parameters["gap_exponent"]
    shape = np.broadcast_shapes(state.signal_DN.shape, context.shape)
    signal = np.broadcast_to(state.signal_DN, shape)
    depth = -np.log(np.maximum(signal / context.open_signal_DN, 1e-12))
    energy_keV = _mean_energy_keV(context)
    own = parameters["own_albedo"]
    source = depth if own == 0 else depth * (1.0 + own * (_scattering_share(context, energy_keV) - 1.0))
    field = np.stack([signal * source, np.broadcast_to(state.variance_DN2, shape) * source])
    field = _shared_at_borders(field, signal, depth)
    scattered = _spread(field, pitch, half_height)
    centre = _share_at_centre(context.shape, pitch, at_usual_gap)
    weights = context.weights[0]
    top = weights.size
    water = context.model.mu("water_liquid")[:top]
    behind_water = -np.log(float(weights @ np.exp(-_WATER_MM * water)) / float(weights.sum()))
    factor = parameters["strength"] / 100.0 / (behind_water * centre)
    factor *= (energy_keV / _REFERENCE_KEV) ** parameters["energy_exponent"]
    return replace(
        state,
        signal_DN=state.signal_DN + factor * scattered[0],
        variance_DN2=state.variance_DN2 + factor * scattered[1],
    )


OBJECT_SCATTER = Effect(
    id="object_scatter",
    title="radiation scattered by the object",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=1.0,
            high=50.0,
            default=10.0,
            source="scatter over primary at the centre of this field behind 20 mm of water, usual gap, beam of 45 keV",
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
    ),
    stage="arrivals",
    reference="convolution model of scatter: Ohnesorge, Flohr, Klingenbeck-Regn (1999), doi:10.1007/s003300050710",
    after_calibration=False,
    change=_add_scatter,
    needs=("spectral", "scene", "pixel_mm", "source_object_mm", "source_detector_mm"),
)
