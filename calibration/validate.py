"""Predictions of a twin against measured flats and wedges, with intervals that include the measurement's own noise.

The levels that calibrated a twin fit it too well to judge it; leaving each out in turn shows what it predicts without it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.cut_off import without_cut_off_darks
from ..acquisition.setting import Setting, text_from_filters
from ..errors import InputError
from ..files import sha256_of_file
from ..generator.effects import effect_of
from ..generator.frames.present_line import present_line
from ..generator.line.measured_flats import measured_flats
from ..generator.line.twin import Z95, Estimate, NoiseModel, Twin
from ..generator.predictions.predict import predict_flatfield
from ..results import Result, Table, axes_or_new, counted, frame, plain
from .frames.frame_sums import effective_frames, sum_frames
from .spectrum.priors import WEDGE_THICKNESS
from .spectrum.spectral_data import Transmission
from .spectrum.wedges import measure_transmissions, predict_transmission, transmissions_of_evidence

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

_LAGS = 24  # px; farther neighbours share no light
_COLOURS = {
    "calibrated with": "#6b7280",
    "not seen": "#1f5fa8",
    "extrapolated": "#d9822b",
    "left out": "#2e7d4f",
}
_WORDS = {True: "yes", False: "NO", None: "-"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationRow:
    """One flat series: measured and predicted detector-median level above dark and temporal noise of one pixel, DN.

    A single frame, averaged or not, shows no noise: its `measured_sd_DN` is None.
    """

    series: str
    setting: Setting
    role: str
    used_in_calibration: bool
    measured_mean_DN: float
    measured_sd_DN: float | None
    predicted_mean_DN: Estimate
    predicted_sd_DN: Estimate
    extrapolated: bool

    @property
    def inside_mean(self) -> bool:
        """Measured mean inside the interval."""
        return self.predicted_mean_DN.low <= self.measured_mean_DN <= self.predicted_mean_DN.high

    @property
    def inside_sd(self) -> bool | None:
        """Measured noise inside the interval; None where none was measured."""
        if self.measured_sd_DN is None:
            return None
        return self.predicted_sd_DN.low <= self.measured_sd_DN <= self.predicted_sd_DN.high

    @property
    def mean_error_percent(self) -> float:
        """Predicted level over the measured one, less 1."""
        return 100.0 * (self.predicted_mean_DN.value / self.measured_mean_DN - 1.0)

    @property
    def sd_error_percent(self) -> float | None:
        """Predicted noise over the measured one, less 1; None where none was measured."""
        if self.measured_sd_DN is None:
            return None
        return 100.0 * (self.predicted_sd_DN.value / self.measured_sd_DN - 1.0)

    def as_dict(self) -> dict[str, Any]:
        """A row of `raytwin validate --json`."""
        return {
            "series": self.series,
            "kV": self.setting.kV,
            "filter": text_from_filters(self.setting.filters),
            "exposure_ms": self.setting.exposure_ms,
            "setting": str(self.setting),
            "role": self.role,
            "used_in_calibration": self.used_in_calibration,
            "measured_mean_DN": self.measured_mean_DN,
            "measured_sd_DN": self.measured_sd_DN,
            "mean_DN": self.predicted_mean_DN.as_dict(),
            "sd_DN": self.predicted_sd_DN.as_dict(),
            "mean_error_percent": self.mean_error_percent,
            "sd_error_percent": self.sd_error_percent,
            "inside": {"mean": self.inside_mean, "sd": self.inside_sd},
            "extrapolated": self.extrapolated,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class WedgeRow:
    """One step of a wedge or slab: measured and predicted transmission (no unit), the measurement's noise included."""

    series: str
    kV: float
    filters: str
    layers: str
    measured: float
    predicted: Estimate
    used_in_calibration: bool

    @property
    def inside(self) -> bool:
        """Measured transmission inside the interval."""
        return self.predicted.low <= self.measured <= self.predicted.high

    def as_dict(self) -> dict[str, Any]:
        """A row of `wedges` in `raytwin validate --json`."""
        return {
            "series": self.series,
            "kV": self.kV,
            "filter": self.filters,
            "layers": self.layers,
            "used_in_calibration": self.used_in_calibration,
            "measured_transmission": self.measured,
            "transmission": self.predicted.as_dict(),
            "error_percent": 100.0 * (self.predicted.value / self.measured - 1.0),
            "inside": self.inside,
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Validation(Result):
    """All rows and what was left out; wedges where the acquisition has some, left_out where that was asked for."""

    rows: tuple[ValidationRow, ...]
    skipped: tuple[str, ...]
    wedges: tuple[WedgeRow, ...] = ()
    left_out: tuple[ValidationRow, ...] | None = None

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin validate --json` prints."""
        answer: dict[str, Any] = {
            "rows": [row.as_dict() for row in self.rows],
            **_summary(self.rows),
            "skipped": list(self.skipped),
        }
        if self.wedges:
            errors = [abs(row.predicted.value / row.measured - 1.0) for row in self.wedges]
            answer["wedges"] = {
                "rows": [row.as_dict() for row in self.wedges],
                "median_abs_error_percent": 100.0 * float(np.median(errors)),
                "coverage": float(np.mean([row.inside for row in self.wedges])),
            }
        if self.left_out is not None:
            answer["leave_one_out"] = {
                "rows": [row.as_dict() for row in self.left_out],
                **(_summary(self.left_out) if self.left_out else {}),
            }
        found: dict[str, Any] = plain(answer)
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each flat series: setting, measured and predicted level and noise with intervals, errors in per cent, inside."""
        return frame([row.as_dict() for row in self.rows])

    def plot(self, ax: Any = None, *, what: str | None = None) -> Any:
        """Errors of the predictions in per cent with their 95 % intervals, row by row; returns the axes.

        Args:
            ax: matplotlib axes; None: of a new figure.
            what: `level`, `noise` or `transmission`; None: the first of them that was compared.

        Raises:
            InputError: nothing of that kind was compared.
        """
        return plot_errors(self, ax=axes_or_new(ax), what=what)

    def _table(self) -> Table:
        rows = [
            (
                row.series,
                str(row.setting),
                f"{row.mean_error_percent:+.2f}",
                "-" if row.sd_error_percent is None else f"{row.sd_error_percent:+.2f}",
                f"{'yes' if row.inside_mean else 'NO'}/{_WORDS[row.inside_sd]}",
            )
            for row in self.rows
        ]
        title = (
            f"{counted(len(self.rows), 'flat')} and {counted(len(self.wedges), 'step')} of wedges against predictions"
        )
        notes = [f"skipped: {line}" for line in self.skipped]
        if self.rows:
            found = _summary(self.rows)
            error, share = found["median_abs_error_percent"], found["coverage"]
            line = f"level: median error {error['mean']:.2f} %, inside the interval {100 * share['mean']:.0f} %"
            if error["sd"] is not None:
                line += f"; noise: {error['sd']:.2f} %, {100 * share['sd']:.0f} %"
            notes.insert(0, line)
            seen = sum(row.used_in_calibration for row in self.rows)
            if seen:
                notes.insert(
                    1, f"{seen} of {len(self.rows)} series calibrated this twin: their errors say how well it fits"
                )
        return Table(
            title=title,
            header=("series", "setting", "level, %", "noise, %", "inside"),
            rows=tuple(rows),
            notes=tuple(notes),
        )


def _summary(rows: Sequence[ValidationRow]) -> dict[str, Any]:
    with_noise = [row for row in rows if row.sd_error_percent is not None]
    noise = [abs(row.sd_error_percent or 0.0) for row in with_noise]
    return {
        "median_abs_error_percent": {
            "mean": float(np.median([abs(row.mean_error_percent) for row in rows])),
            "sd": float(np.median(noise)) if noise else None,
        },
        "coverage": {
            "mean": float(np.mean([row.inside_mean for row in rows])),
            "sd": float(np.mean([bool(row.inside_sd) for row in with_noise])) if with_noise else None,
            "rows": len(rows),
        },
    }


def validate_twin(
    twin: Twin, acquisition: AcquisitionFile, *, progress: Callable[[str], None] | None = None
) -> Validation:
    """Compare predictions with the flats of an acquisition: those held back for evaluation if any, else all.

    Raises:
        InputError: no flat that can be compared, another detector, or no darks.
    """
    tell = progress or (lambda name: None)
    acquisition, cut_off = without_cut_off_darks(acquisition)
    chosen = _flats_to_compare(twin, acquisition)
    rho = twin.noise.spread.value.noise_autocovariance(_LAGS)
    squared_correlations = float(np.sum(rho**2)) / float(rho[_LAGS, _LAGS]) ** 2
    darks = _dark_means(acquisition)
    calibrated = {name for level in twin.levels for name in level.series}
    hashes = str(twin.provenance.get("acquisition_sha256", "")).split("+")
    known = [sha256_of_file(path) in hashes for path in acquisition.paths]
    rows, skipped = [], [*cut_off]
    for item in chosen:
        tell(item.name)
        if item.setting is None or item.setting.tube_load_mAs is None:
            skipped.append(f"{item.name}: kV, exposure or tube load unknown")
            continue
        measured = _measured_flat(item, twin, darks, skipped, bits=acquisition.instrument.bits)
        if measured is None:
            continue
        # an effect that came after calibration is not in the flats that calibrated
        seen = known[item.session] and item.name in calibrated
        try:
            predicted = predict_flatfield(twin, item.setting, after_calibration=not seen)
        except InputError as error:
            skipped.append(f"{item.name}: {error}")
            continue
        skipped += [line for line in predicted.warnings if line.startswith("effect ") and line not in skipped]
        sampled = _sampled(
            measured, twin.noise, gain_DN=predicted.gain_DN.value, squared_correlations=squared_correlations
        )
        rows.append(
            ValidationRow(
                series=item.name,
                setting=item.setting,
                role=item.role or "",
                used_in_calibration=seen,
                measured_mean_DN=measured.median_DN,
                measured_sd_DN=None if sampled.variance_DN2 is None else math.sqrt(sampled.variance_DN2),
                predicted_mean_DN=_widened(predicted.mean_DN, sampled.mean_sd_DN),
                predicted_sd_DN=_widened(predicted.sd_DN, sampled.noise_sd_DN),
                extrapolated=predicted.extrapolated,
            )
        )
    wedges = _wedge_rows(twin, acquisition, skipped, known=known)
    if not rows and not wedges:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="; ".join(skipped) or "no flats",
            expected="at least one flat with kV, exposure and tube load that the twin can predict",
        )
    return Validation(rows=tuple(rows), skipped=tuple(skipped), wedges=wedges)


def _flats_to_compare(twin: Twin, acquisition: AcquisitionFile) -> list[Series]:
    """The raw flats held back for evaluation if any, else all.

    Raises:
        InputError: there is none, or they are of another detector or line.
    """
    flats = [item for item in acquisition.of_kind("flat") if not item.corrected & {"log", "gain"}]
    chosen = [item for item in flats if item.role == "evaluation"] or flats
    if not chosen:
        raise InputError(
            f"acquisition {acquisition.path}", received="no raw flat series", expected="at least one flat series"
        )
    if any(item.shape != twin.maps.shape for item in chosen):
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"frames of {chosen[0].shape}",
            expected=f"the twin's detector of {twin.maps.shape} pixels",
            remedy="validate against flats of the same detector",
        )
    other = twin.instrument.unlike(acquisition.instrument)
    if other is not None:
        raise InputError(
            f"acquisition {acquisition.path}",
            received=other[0],
            expected=f"the twin's: {other[1]}",
            remedy="validate against flats of the same tube and detector, or correct what the file states of them",
        )
    return chosen


@dataclass(frozen=True, slots=True, kw_only=True)
class _MeasuredFlat:
    """Signal above dark and temporal noise of a series of flats, over good pixels.

    Fields: frames; averaged; pixels (good ones); median_DN, mean_DN (signal over pixels); variance_DN2 (temporal, mean over
    pixels; None of a single frame).
    """

    frames: int
    averaged: int
    pixels: int
    median_DN: float
    mean_DN: float
    variance_DN2: float | None


def _measured_flat(
    item: Series, twin: Twin, darks: Mapping[float | None, NDArray[np.float64]], skipped: list[str], *, bits: int | None
) -> _MeasuredFlat | None:
    """What a series of flats shows; None where it cannot be compared. `skipped` is told why, or that it shows no noise."""
    good = twin.maps.bad_pixels == 0
    total = sum_frames(item.iter_frames(), name=f"series {item.name}")
    if total.frames < 2:
        skipped.append(f"{item.name}: its noise, which a single frame does not show")
    if "offset" in item.corrected:
        dark: Any = 0.0
    else:
        dark = darks.get(item.exposure_ms)
        if dark is None:
            dark = twin.maps.dark_at(item.exposure_ms)
    if bits and total.maximum_count > 1e-3 * total.frames * good.size:
        full = 2.0**bits - 1
        if total.maximum_DN >= full:
            skipped.append(f"{item.name}: saturated at {full:g} DN")
            return None
    signal = (total.mean_DN - dark)[good]
    median = float(np.median(signal))
    variance = float(np.mean(total.pair_variance_DN2[good])) if total.frames > 1 else None
    if median <= 0 or variance == 0:
        skipped.append(
            f"{item.name}: {'no signal above dark' if variance != 0 else 'all frames alike: copies, or no noise'}"
        )
        return None
    return _MeasuredFlat(
        frames=total.frames,
        averaged=item.averaged,
        pixels=int(good.sum()),
        median_DN=median,
        mean_DN=float(np.mean(signal)),
        variance_DN2=variance,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sampled:
    """Sampling noise of a measured flat: sd of its level and of its noise, and the variance of the pixel of median signal."""

    mean_sd_DN: float
    noise_sd_DN: float
    variance_DN2: float | None


def _sampled(flat: _MeasuredFlat, noise: NoiseModel, *, gain_DN: float, squared_correlations: float) -> _Sampled:
    """By how much a measured flat may be off for its few frames and pixels; gain_DN: of the prediction."""
    mean, variance = flat.median_DN, flat.variance_DN2
    # quantum noise is correlated: the mean over pixels carries gain, not slope
    spread = gain_DN * mean / flat.averaged + noise.read_variance_DN2 / flat.averaged
    common = 0.0 if noise.common_variance is None else noise.common_variance.value * mean**2 / flat.averaged
    mean_sd = math.sqrt(max(spread, variance or 0.0) / flat.frames / flat.pixels) * 1.2533
    # what pixels share does not average out over them
    mean_sd = math.hypot(mean_sd, math.sqrt(common / flat.frames))
    if variance is None:
        return _Sampled(mean_sd_DN=mean_sd, noise_sd_DN=0.0, variance_DN2=None)
    # neighbours share quantum noise, so a variance over pixels counts fewer of them: by the sum of squared correlations
    quantum = min(max(1.0 - noise.read_variance_DN2 / flat.averaged / variance, 0.0), 1.0)
    shared = 1.0 + quantum**2 * (squared_correlations - 1.0)
    sampling = 2.0 * (variance**2 * shared / flat.pixels + common**2) / effective_frames(flat.frames)
    # noise of the pixel with the median signal, which the prediction is of: quanta follow the signal
    variance *= 1.0 - quantum * (1.0 - mean / flat.mean_DN)
    return _Sampled(mean_sd_DN=mean_sd, noise_sd_DN=0.5 * math.sqrt(sampling / variance), variance_DN2=variance)


def _dark_means(acquisition: AcquisitionFile) -> dict[float | None, NDArray[np.float64]]:
    """Mean dark frame (row, column), DN, by exposure: of all raw darks of that exposure, each by its frames."""
    found: dict[float | None, list[tuple[NDArray[np.float64], float]]] = {}
    for item in acquisition.of_kind("dark"):
        if not item.corrected:
            total = sum_frames(item.iter_frames(), name=f"series {item.name}")
            found.setdefault(item.exposure_ms, []).append((total.mean_DN, float(total.frames * item.averaged)))
    return {
        exposure_ms: np.average([mean for mean, _ in means], axis=0, weights=[weight for _, weight in means])
        for exposure_ms, means in found.items()
    }


def _sd_of_step(item: Transmission) -> float:
    """Standard deviation of a measured transmission, the thickness that all steps of its wedge share included."""
    return item.value * math.hypot(item.relative_sd, WEDGE_THICKNESS.sd * math.log(item.value))


def _wedge_rows(
    twin: Twin, acquisition: AcquisitionFile, skipped: list[str], *, known: Sequence[bool]
) -> tuple[WedgeRow, ...]:
    """known: of each session, whether the twin was calibrated from it."""
    if twin.spectral is None:
        return ()
    rows = []
    entries = measure_transmissions(acquisition, twin.maps, evaluation=True)
    left_out = [
        item.id for item in present_line(twin).effects if effect_of(item).stage in ("beam", "arrivals", "optics")
    ]
    if entries and left_out:
        skipped.append(f"wedges are predicted without the effects {', '.join(left_out)}")
    for entry in entries:
        if entry.skipped:
            skipped.append(entry.skipped)
        series = next(item for item in acquisition.series if item.name == entry.series)
        seen = known[series.session] and series.role != "evaluation"
        for item in entry.transmissions:
            line = present_line(twin, after_calibration=not seen).twin
            predicted = predict_transmission(line, kV=item.kV, filters=item.filters, layers=item.layers)
            rows.append(
                WedgeRow(
                    series=item.series,
                    kV=item.kV,
                    filters=text_from_filters(item.filters),
                    layers=text_from_filters(item.layers),
                    measured=item.value,
                    predicted=_widened(predicted, _sd_of_step(item)),
                    used_in_calibration=seen,
                )
            )
    return tuple(rows)


def leave_one_out(
    twin: Twin, *, rng: np.random.Generator, progress: Callable[[str], None] | None = None
) -> tuple[ValidationRow, ...]:
    """Each level (kV and filter) of a twin predicted from the others: the spectrum is fitted again without it.

    Level and noise are those of the level's mean tube load; the intervals include the level's own sampling noise, and a
    wedge measured at the level's kV and filter is left out with it.

    Args:
        twin: calibrated; levels without kV or tube load are passed over.
        rng: source of randomness of the fits.
        progress: called with the name of each level.

    Returns:
        One row a level; none where fewer than two levels can be used.

    Raises:
        FitError: a posterior that cannot be drawn.
    """
    from .spectrum.spectral_fit import fit_spectrum

    tell = progress or (lambda name: None)
    usable = [level for level in twin.levels if level.kV is not None and level.rate_DN_per_mAs is not None]
    if twin.spectral is None or len(usable) < 2:
        return ()
    loads = {
        flat.series: (flat.load_mAs, flat.exposure_ms)
        for flat in measured_flats(twin)
        if flat.load_mAs and flat.exposure_ms
    }
    transmissions = transmissions_of_evidence(twin)
    rows = []
    for level in usable:
        tell(level.name)
        others = tuple(item for item in twin.levels if item is not level)
        kept = [item for item in transmissions if (item.kV, item.filters) != (level.kV, level.filters)]
        fit = fit_spectrum(
            others,
            twin.instrument,
            rng=rng,
            noise=twin.noise,
            transmissions=kept,
            correction=twin.spectral.correction,
            model_name=twin.spectral.model,
            repeats=twin.evidence.get("repeated_settings") or (),
        )
        mine = [loads[name] for name in level.series if name in loads]
        load_mAs = float(np.mean([load for load, _ in mine])) if mine else 1.0
        exposure_ms = float(np.median([exposure for _, exposure in mine])) if mine else 1000.0
        setting = Setting(
            kV=level.kV or 0.0,
            exposure_ms=exposure_ms,
            current_mA=float(f"{load_mAs / exposure_ms * 1000.0:.6g}"),
            filters=level.filters,
            source_detector_mm=level.source_detector_mm,
        )
        without = replace(
            twin,
            effects=(),
            levels=others,
            spectral=fit.posterior,
            instrument=replace(twin.instrument, maximum_power_w=None),
        )
        predicted = predict_flatfield(without, setting)
        rate, slope = level.rate_DN_per_mAs, level.photon_transfer_slope_DN
        if rate is None:
            continue
        mean = rate.value * load_mAs
        variance = slope.value * mean + twin.noise.read_variance_DN2
        mean_sd = rate.sd * load_mAs
        slope_sd = slope.sd
        rows.append(
            ValidationRow(
                series=level.name,
                setting=setting,
                role="left out",
                used_in_calibration=False,
                measured_mean_DN=mean,
                measured_sd_DN=math.sqrt(variance),
                predicted_mean_DN=_widened(predicted.mean_DN, mean_sd),
                predicted_sd_DN=_widened(predicted.sd_DN, 0.5 * slope_sd * mean / math.sqrt(variance)),
                extrapolated=predicted.extrapolated,
            )
        )
    return tuple(rows)


def plot_validation(result: Validation) -> "Figure":
    """Errors of predicted level, noise and transmission in per cent, with their 95 % intervals, row by row."""
    from matplotlib.figure import Figure

    groups = compared(result)
    tallest = max(len(mine) for mine in groups.values())
    figure = Figure(figsize=(4.6 * len(groups), 1.2 + tallest * min(0.22, 12.0 / tallest)), layout="constrained")
    for axes, what in zip(figure.subplots(1, len(groups), squeeze=False)[0], groups, strict=True):
        plot_errors(result, ax=axes, what=what)
        if what == next(iter(groups)):
            seen = dict.fromkeys(kind for mine in groups.values() for _, _, _, kind in mine)
            for kind in seen:
                axes.plot([], [], "o-", color=_COLOURS[kind], ms=4, lw=1.5, label=kind)
            figure.legend(loc="outside upper left", ncols=len(seen), frameon=False, fontsize=8)
    return figure


def plot_errors(result: Validation, *, ax: Any, what: str | None = None) -> Any:
    """Errors of one quantity in per cent on the axes given; see `Validation.plot`."""
    groups = compared(result)
    if what is not None and what not in groups:
        raise InputError("what", received=repr(what), expected="one of " + ", ".join(groups))
    chosen = what or next(iter(groups))
    mine = groups[chosen]
    for position, (_, measured, predicted, kind) in enumerate(mine):
        error, low, high = (
            100.0 * (value / measured - 1.0) for value in (predicted.value, predicted.low, predicted.high)
        )
        ax.plot([low, high], [position, position], color=_COLOURS[kind], lw=1.5, solid_capstyle="butt")
        ax.plot(error, position, "o", color=_COLOURS[kind], ms=4)
    ax.axvline(0.0, color="#6b7280", lw=0.8)
    every = math.ceil(len(mine) / 55)  # names of more rows would overlap
    ax.set_yticks(range(0, len(mine), every), [name for name, _, _, _ in mine][::every], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel(f"error of the {chosen} (%)")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def compared(result: Validation) -> dict[str, list[tuple[str, float, Estimate, str]]]:
    """Quantity (`level`, `noise`, `transmission`) -> (name, measured, predicted, kind) of each row that has it."""
    groups: dict[str, list[tuple[str, float, Estimate, str]]] = {}

    def add(what: str, name: str, measured: float | None, predicted: Estimate, kind: str) -> None:
        if measured is None:
            return
        groups.setdefault(what, []).append((name, measured, predicted, kind))

    for row in result.rows:
        name = f"{row.setting.kV:g} kV {text_from_filters(row.setting.filters)}".strip()
        name += f", {row.setting.exposure_ms:g} ms"
        kind = "calibrated with" if row.used_in_calibration else "extrapolated" if row.extrapolated else "not seen"
        add("level", name, row.measured_mean_DN, row.predicted_mean_DN, kind)
        add("noise", name, row.measured_sd_DN, row.predicted_sd_DN, kind)
    for row in result.left_out or ():
        add("level", row.series, row.measured_mean_DN, row.predicted_mean_DN, "left out")
        add("noise", row.series, row.measured_sd_DN, row.predicted_sd_DN, "left out")
    for step in result.wedges:
        kind = "calibrated with" if step.used_in_calibration else "not seen"
        add("transmission", f"{step.kV:g} kV {step.layers}", step.measured, step.predicted, kind)
    return groups


def _widened(estimate: Estimate, sd: float) -> Estimate:
    below = math.hypot(estimate.value - estimate.low, Z95 * sd)
    above = math.hypot(estimate.high - estimate.value, Z95 * sd)
    return Estimate(value=estimate.value, low=estimate.value - below, high=estimate.value + above)
