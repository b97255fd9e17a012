"""Step wedges and slabs of known thickness: their transmissions, as measured and as a twin predicts them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.setting import Filter, filters_from_text, text_from_filters
from ...errors import InputError
from ...generator.line.photon_tables import OTHER_TABLES
from ...generator.line.spectral_signal import OpenBeam, attenuation_scale_name
from ...generator.line.twin import DetectorMaps, Estimate, SpectralPosterior, Twin, estimate_from_log_draws
from ...generator.predictions.predict import spectral_model_of
from ...materials import material_from_name, optical_depth
from ..frames.frame_sums import sum_frames
from .priors import ATTENUATION_SCALE, SHARES_CORRELATION, TABLE_SHARE
from .spectral_data import Transmission

KINDS = ("wedge", "slab")
# A transmission carries at least this: scatter, flatness, the flat's own drift.
TRANSMISSION_SD = 0.002
# Tolerance of a step's thickness, each step on its own; what all steps share is `WEDGE_THICKNESS`.
THICKNESS_SD = 0.005
_LEAST = 0.02  # transmissions below are mostly scatter
_PIXELS = 20  # a step of fewer is left out
_STEPS = 40  # a map of more different thicknesses is a ramp, and is cut into bins
_BINS = 12
_SPREAD_PX = 5  # light and penumbra of the next step reach so far
_LEAST_SHARE = 0.25  # of a step's pixels that must be left
_EDGE_SHARE = 0.06  # of the whole range: where neighbours differ by more there is an edge


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredTransmissions:
    """Transmissions of one series, or why there are none (`skipped`, empty where there are)."""

    series: str
    scene: str
    transmissions: tuple[Transmission, ...]
    skipped: str = ""


def measure_transmissions(
    acquisition: AcquisitionFile, maps: DetectorMaps, *, evaluation: bool = False
) -> tuple[MeasuredTransmissions, ...]:
    """Transmissions (signal behind known layers over the open signal) of the wedges and slabs of an acquisition.

    T = (object / load) / (flat / load) of the same pixels, kV, filters and distance, brought to 1 where nothing stands in
    the beam; pixels of one thickness are averaged, those at an edge left out. Scatter counts as signal: a large gap
    behind the object keeps it small.

    Args:
        acquisition: open file with object series whose scene is a wedge or slab with thickness maps.
        maps: dark and bad pixels of the detector.
        evaluation: also series held back for evaluation.

    Returns:
        One entry a series, with the reason where it gives none.
    """
    found = []
    for item in acquisition.of_kind("object"):
        scene = acquisition.scenes.get(item.scene)
        if scene is None or scene.kind not in KINDS or (item.role == "evaluation" and not evaluation):
            continue
        try:
            values = _transmissions_of(acquisition, item, dict(scene.thickness_mm), maps)
        except InputError as error:
            found.append(
                MeasuredTransmissions(series=item.name, scene=item.scene, transmissions=(), skipped=str(error))
            )
            continue
        found.append(MeasuredTransmissions(series=item.name, scene=item.scene, transmissions=tuple(values)))
    return tuple(found)


def _transmissions_of(
    acquisition: AcquisitionFile, item: Series, thickness_mm: dict[str, NDArray[np.float32]], maps: DetectorMaps
) -> list[Transmission]:
    def refuse(received: str, expected: str) -> InputError:
        return InputError(f"series {item.name}", received=received, expected=expected)

    if item.kV is None:
        raise refuse("no kV", "a series that states it")
    if item.corrected & {"log", "gain"}:
        raise refuse("corrected frames", "raw or offset-corrected frames")
    if not thickness_mm:
        raise refuse("a scene without thickness maps", "thickness_mm for each material")
    for name in thickness_mm:
        material_from_name(name)  # raises for an unknown one
    flat = _flat_for(acquisition, item)
    if flat is None:
        raise refuse("no flat at its kV, filter and distance", "a raw flat at the same kV, filter and distance")
    signals = []
    for series in (item, flat):
        total = sum_frames(series.iter_frames(), name=f"series {series.name}")
        dark = np.float32(0.0) if "offset" in series.corrected else maps.dark_at(series.exposure_ms)
        signals.append((total.mean_DN - dark) / (_load(series) or 1.0))
    good = (maps.bad_pixels == 0) & (signals[1] > 0)
    if any(plane.shape != good.shape for plane in thickness_mm.values()):
        raise refuse("thickness maps of another shape", f"maps of {good.shape} pixels")
    ratio = np.where(good, signals[0] / np.where(good, signals[1], 1.0), np.nan)
    labels, steps = _steps(thickness_mm)
    open_field = [number for number, step in enumerate(steps) if not any(step.values())]
    reference = 1.0
    for number in open_field:
        chosen = ratio[(labels == number) & good]
        if chosen.size >= _PIXELS:
            reference = float(np.mean(chosen))
    if not open_field and (_load(item) is None or _load(flat) is None):
        raise refuse("no open field and no tube load", "one of the two, to measure against")
    result = []
    for number, step in enumerate(steps):
        values = ratio[(labels == number) & good] / reference
        if number in open_field or values.size < _PIXELS:
            continue
        value = float(np.mean(values))
        if not _LEAST < value < 1.0:
            continue
        # neighbours share light: a mean over pixels counts about a quarter of them
        noise = 2.0 * float(np.std(values)) / math.sqrt(values.size) / value
        layers = tuple(Filter(material=name, thickness_mm=mm) for name, mm in step.items() if mm > 0)
        result.append(
            Transmission(
                kV=item.kV,
                filters=item.filters,
                layers=layers,
                value=value,
                relative_sd=math.hypot(noise, TRANSMISSION_SD, THICKNESS_SD * math.log(value)),
                series=item.name,
                wedge=item.scene,
            )
        )
    if not result:
        raise refuse(
            f"no step of {_PIXELS} pixels with a transmission above {_LEAST:g}", "steps that let light through"
        )
    return result


def _flat_for(acquisition: AcquisitionFile, item: Series) -> Series | None:
    """The flat at the same kV, filters and distance whose load is nearest."""
    wanted = sorted(map(str, item.filters))
    distance = acquisition.instrument.source_detector_mm
    matching = [
        flat
        for flat in acquisition.of_kind("flat")
        if flat.kV == item.kV
        and sorted(map(str, flat.filters)) == wanted
        and (flat.source_detector_mm or distance) == (item.source_detector_mm or distance)
        and flat.panel_rotation_deg == item.panel_rotation_deg
        and flat.layer == item.layer
        and not flat.corrected & {"log", "gain"}
        and flat.shape == item.shape
    ]
    load = _load(item)
    if load is None:
        return matching[0] if matching else None
    return min(matching, key=lambda flat: abs(math.log((_load(flat) or 1e-9) / load)), default=None)


def _load(item: Series) -> float | None:
    return None if item.setting is None else item.setting.tube_load_mAs


def _steps(thickness_mm: dict[str, NDArray[np.float32]]) -> tuple[NDArray[np.intp], list[dict[str, float]]]:
    """Number of the step that each pixel belongs to (row, column), -1 at edges, and the steps' thicknesses in mm."""
    from scipy.ndimage import maximum_filter, minimum_filter

    names = list(thickness_mm)
    planes = np.stack([np.asarray(thickness_mm[name], dtype=np.float64) for name in names])
    planes = np.where(np.isfinite(planes), planes, 0.0)
    edge = np.zeros(planes.shape[1:], dtype=bool)
    for plane in planes:
        whole = float(plane.max() - plane.min())
        change = maximum_filter(plane, size=3, mode="nearest") - minimum_filter(plane, size=3, mode="nearest")
        edge |= change > _EDGE_SHARE * max(whole, 1e-9)
    rounded = np.round(planes, 3).reshape(len(names), -1).T
    distinct, labels = np.unique(rounded[~edge.ravel()], axis=0, return_inverse=True)
    inside = np.full(edge.size, -1, dtype=np.intp)
    if len(distinct) > _STEPS:
        # a ramp, or the slant of rays: bins of the summed thickness
        total = planes.sum(axis=0).ravel()
        kept = ~edge.ravel()
        occupied = kept & (total > 0)
        if not occupied.any():
            return inside.reshape(edge.shape), []
        cuts = np.linspace(total[occupied].min(), total[occupied].max() + 1e-9, _BINS + 1)
        inside[occupied] = np.searchsorted(cuts, total[occupied], side="right") - 1
        inside[kept & (total == 0)] = _BINS
    else:
        inside[~edge.ravel()] = labels.ravel()
        inside = _away_from_borders(inside.reshape(edge.shape)).ravel()
    steps = []
    for number in range(int(inside.max()) + 1):
        members = planes.reshape(len(names), -1)[:, inside == number]
        means = members.mean(axis=1) if members.size else np.zeros(len(names))
        steps.append({name: float(f"{mean:.4g}") for name, mean in zip(names, means, strict=True)})
    return inside.reshape(edge.shape), steps


def _away_from_borders(inside: NDArray[np.intp]) -> NDArray[np.intp]:
    """Step numbers (row, column) without the pixels into which light of the next step spreads, as far as a step is wide."""
    from scipy.ndimage import distance_transform_edt

    if np.all(inside >= 0):
        return inside  # nothing bounds a slab that fills the field
    distance = np.asarray(distance_transform_edt(inside >= 0))
    kept = np.full_like(inside, -1)
    for number in range(int(inside.max()) + 1):
        mine = inside == number
        least = max(2 * _PIXELS, _LEAST_SHARE * int(np.count_nonzero(mine)))
        for reach in range(_SPREAD_PX, -1, -1):
            far = mine & (distance > reach)
            if reach == 0 or np.count_nonzero(far) >= least:
                kept[far] = number
                break
    return kept


def predict_transmission(twin: Twin, *, kV: float, filters: Sequence[Filter], layers: Sequence[Filter]) -> Estimate:
    """Transmission of layers behind filters at a kV, no unit, with its 95 % interval.

    T = sum(N T_layers m1) / sum(N m1) over the posterior's draws; scales cancel. Thicknesses are taken as exact. A
    material whose attenuation the calibration did not carry has the mean of the three tables, one of which is right for all
    its plates, and adds their differences and its density's error.

    Raises:
        InputError: a twin without spectral part, or an unknown material.
    """
    model = spectral_model_of(twin, highest_kV=kV)
    posterior = cast(SpectralPosterior, twin.spectral)
    draws = posterior.samples
    behind = model.signal(draws, OpenBeam(kV=kV, filters=(*filters, *layers))).rate_DN_per_mAs
    before = model.signal(draws, OpenBeam(kV=kV, filters=tuple(filters))).rate_DN_per_mAs
    extra = [posterior.level_discrepancy]
    moved = 0.0
    weight = model.moment_weights(posterior.best, OpenBeam(kV=kV, filters=(*filters, *layers)))[0]
    energies = model.energies_keV[: weight.size]
    # plates of one material share its table and its density
    for material in dict.fromkeys(layer.material for layer in layers):
        if attenuation_scale_name(material) in model.names:
            continue
        plates = [layer for layer in layers if layer.material == material]
        depth = optical_depth(plates, energies)
        other = [optical_depth(plates, energies, table=table) - depth for table in OTHER_TABLES]
        own, first, second = (float(np.sum(weight * row) / np.sum(weight)) for row in (depth, *other))
        moved += TABLE_SHARE.centre * (first + second)
        both = first**2 + second**2 + 2.0 * SHARES_CORRELATION * first * second
        extra += [ATTENUATION_SCALE.sd * own, TABLE_SHARE.sd * math.sqrt(both)]
    return estimate_from_log_draws(np.log(behind / before) - moved, math.hypot(*extra))


def transmissions_of_evidence(twin: Twin) -> tuple[Transmission, ...]:
    """The transmissions that a twin was calibrated with, from its evidence."""
    return tuple(
        Transmission(
            kV=float(row["kV"]),
            filters=filters_from_text(row["filter"]),
            layers=filters_from_text(row["layers"]),
            value=float(row["transmission"]),
            relative_sd=float(row["relative_sd"]),
            series=str(row["series"]),
            wedge=str(row["scene"]),
        )
        for row in twin.evidence.get("wedges") or ()
        if "transmission" in row and row.get("used", True)
    )


def wedge_evidence(measured: Sequence[MeasuredTransmissions]) -> list[dict[str, Any]]:
    """Plain rows of what was measured, for a twin's evidence."""
    rows: list[dict[str, Any]] = []
    for entry in measured:
        if entry.skipped:
            rows.append({"series": entry.series, "scene": entry.scene, "skipped": entry.skipped})
        rows += [
            {
                "series": entry.series,
                "scene": entry.scene,
                "kV": item.kV,
                "filter": text_from_filters(item.filters),
                "layers": text_from_filters(item.layers),
                "transmission": item.value,
                "relative_sd": item.relative_sd,
            }
            for item in entry.transmissions
        ]
    return rows
