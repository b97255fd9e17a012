"""Photon transfer of a session: darks and flats -> dark, read noise, optical spread, gain per kV and filter, maps.

Two passes over the frames: one for the per-pixel sums, one over at most `COVARIANCE_FRAMES` frames a series for the
neighbour covariances, once the bad pixels are known.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.setting import Filter, text_from_filters
from ..errors import InputError
from ..generator.twin import BAD_PIXEL_CODES, DetectorMaps, Estimate, Level, NoiseModel, estimate_from_sd
from ._kept_sums import KeptSums, SumsKeeper
from .frame_sums import effective_frames, sum_frames
from .noise_covariance import NoiseCovariance, SpreadFit, compute_noise_covariance, fit_spread
from .repeated_frames import (
    RepeatedFrames,
    beam_of,
    bounded_read_variance,
    evidence_of,
    find_repeated_frames,
    most_read_variance,
    series_of_beams,
    warning_of,
    widened,
)

ESTIMATORS = ("pairs", "stack")
COVARIANCE_FRAMES = 400
_PIECE_BYTES = 8 * 2**20
_COVARIANCE_SAMPLES = 6e7  # pixels x frames a series; the gain is then known to about 0.05 %
_FULL_SCALES = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 16))
_SERIES_REPRODUCIBILITY = 1e-3  # of the level: what series of one setting are weighted by, beside their noise
_DARK_NOISE_SIGMAS = 8.0  # how far a pixel must stand out to be called hot
_CLUSTER_SHARE = 0.6  # of those limits, in pixels that touch a bad one
_CLUSTER_NEIGHBOURS = 5  # bad ones of the eight about a pixel that leave it nothing to be interpolated from
_SINGLE = "a single frame has no noise"
_NOISY_CHANCE = 1e-9  # chance that a good pixel's noise looks as large as one called noisy

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesPoint:
    """One flat series as photon transfer sees it; per frame, detector means over good pixels.

    Fields: series, kV, filters, exposure_ms, load_mAs (None where unknown), frames, averaged, signal_DN (median),
    mean_signal_DN, pair_variance_DN2, stack_variance_DN2 (of one single frame: averaging undone; of a flat without a
    second frame what other series of its beam show), used (False: masked, with the reason in `masked`), drift_percent
    (change of the frame mean over the series), common_mode_percent (rms output noise from frame to frame).
    """

    series: str
    kV: float | None
    filters: tuple[Filter, ...]
    exposure_ms: float | None
    load_mAs: float | None
    source_detector_mm: float | None
    photons_per_pixel: float | None
    frames: int
    averaged: int
    signal_DN: float
    mean_signal_DN: float
    pair_variance_DN2: float
    stack_variance_DN2: float
    used: bool
    masked: str
    drift_percent: float
    common_mode_percent: float

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {
            "series": self.series,
            "kV": self.kV,
            "filter": text_from_filters(self.filters),
            "exposure_ms": self.exposure_ms,
            "load_mAs": self.load_mAs,
            "frames": self.frames,
            "averaged": self.averaged,
            "signal_DN": self.signal_DN,
            "pair_variance_DN2": self.pair_variance_DN2,
            "stack_variance_DN2": self.stack_variance_DN2,
            "used": self.used,
            "masked": self.masked,
            "drift_percent": self.drift_percent,
            "common_mode_percent": self.common_mode_percent,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotonTransfer:
    """Everything that the flats and darks say without a spectrum."""

    maps: DetectorMaps
    noise: NoiseModel
    dark_DN: Estimate
    levels: tuple[Level, ...]
    points: tuple[SeriesPoint, ...]
    fit: SpreadFit
    evidence: dict[str, Any]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Darks:
    """Dark frames: the mean at each session and exposure, growth, and the pairs' variance over all sessions."""

    by_exposure: dict[tuple[int, float | None], NDArray[np.float64]]
    sums: list[tuple[Series, KeptSums]]
    per_ms: NDArray[np.float64]
    variance: NDArray[np.float64]
    effective: float

    def of(self, item: Series) -> NDArray[np.float64]:
        """The dark frame of a series: of its own session where that has darks."""
        return self.at(item.session, item.exposure_ms)

    def at(self, session: int, exposure_ms: float | None) -> NDArray[np.float64]:
        sessions = sorted({key[0] for key in self.by_exposure}, key=lambda one: (abs(one - session), one))
        exposures = {key[1]: mean for key, mean in self.by_exposure.items() if key[0] == sessions[0]}
        if exposure_ms in exposures:
            return exposures[exposure_ms]
        known = [key for key in exposures if key is not None]
        if exposure_ms is None or not known:
            return next(iter(exposures.values()))
        nearest = min(known, key=lambda key: abs(key - exposure_ms))
        return np.asarray(exposures[nearest] + self.per_ms * (exposure_ms - nearest))


def usable_series(acquisition: AcquisitionFile, kind: str) -> list[Series]:
    """Series of a kind that may calibrate: not held back for evaluation, not logged or gain-corrected."""
    return [
        series
        for series in acquisition.of_kind(kind)
        if series.role != "evaluation" and not series.corrected & {"log", "gain"}
    ]


def _sums_of(item: Series, keeper: SumsKeeper) -> KeptSums:
    return keeper.keep(sum_frames(item.iter_frames(maximum_bytes=_PIECE_BYTES), name=f"series {item.name}"))


def _sum_darks(series: Sequence[Series], shape: tuple[int, int], keeper: SumsKeeper) -> _Darks:
    sums = [(item, _sums_of(item, keeper)) for item in series]
    grouped: dict[tuple[int, float | None], list[KeptSums]] = {}
    for item, total in sums:
        grouped.setdefault((item.session, item.exposure_ms), []).append(total)
    frames = {key: sum(total.frames for total in totals) for key, totals in grouped.items()}
    by_exposure = {
        key: np.asarray(sum(total.mean_DN * total.frames for total in totals) / frames[key])
        for key, totals in grouped.items()
    }
    # growth with exposure: a line in each session, one slope
    per_ms = np.zeros(shape)
    denominator = 0.0
    for session in {key[0] for key in grouped}:
        keys = [key for key in grouped if key[0] == session and key[1] is not None]
        if len(keys) < 2:
            continue
        times = np.array([key[1] for key in keys], dtype=np.float64)
        weights = np.array([frames[key] for key in keys], dtype=np.float64)
        centred = times - np.average(times, weights=weights)
        denominator += float(np.sum(weights * centred**2))
        for weight, offset, key in zip(weights, centred, keys, strict=True):
            per_ms += weight * offset * by_exposure[key]
    if denominator > 0:
        per_ms /= denominator
    variance = np.full(shape, np.nan)
    pairs = [(item, total) for item, total in sums if total.pairs > 0]
    effective = sum(effective_frames(total.frames) for _, total in pairs)
    if pairs:
        variance = np.asarray(
            sum(total.pair_variance_DN2 * (item.averaged * effective_frames(total.frames)) for item, total in pairs)
            / effective
        )
    return _Darks(by_exposure=by_exposure, sums=sums, per_ms=per_ms, variance=variance, effective=effective)


def _robust_spread(values: NDArray[np.float64]) -> tuple[float, float]:
    centre = float(np.median(values))
    return centre, 1.4826 * float(np.median(np.abs(values - centre)))


def _bad_pixels(darks: _Darks, flats: Sequence[tuple[Series, KeptSums]]) -> NDArray[np.uint8]:
    """Reason codes (row, column) from the darks' level and noise and from the flats' response."""
    from scipy.ndimage import median_filter

    code = np.zeros(darks.per_ms.shape, dtype=np.uint8)
    closest = np.zeros(darks.per_ms.shape)  # largest departure, in limits
    for key, mean in darks.by_exposure.items():
        local = mean - median_filter(mean, size=5, mode="nearest")
        centre, spread = _robust_spread(local)
        limit = _DARK_NOISE_SIGMAS * max(spread, 0.5)
        frames = sum(
            total.frames * item.averaged for item, total in darks.sums if (item.session, item.exposure_ms) == key
        )
        # the mean of a noisy pixel strays by its own noise; that alone does not make it hot
        own = 4.0 * np.sqrt(np.nan_to_num(darks.variance) / max(frames, 1))
        departure = np.abs(local - centre) / np.maximum(limit, own)
        np.maximum(closest, departure, out=closest)
        code[(departure > 1.0) & (code == 0)] = BAD_PIXEL_CODES["hot"]
    if darks.effective > 0 and np.all(np.isfinite(darks.variance)):
        # a variance from few frames has long tails (chi-square): cutting them off would lower the pooled variance
        from scipy.special import chdtri  # of chi-square's upper tail; scipy.stats would take 40 MB

        centre = float(np.median(darks.variance)) * darks.effective / float(chdtri(darks.effective, 0.5))
        limit = centre * float(chdtri(darks.effective, _NOISY_CHANCE)) / darks.effective + 1.0
        code[(darks.variance > max(limit, 2.0 * centre)) & (code == 0)] = BAD_PIXEL_CODES["noisy"]
    brightest = max(flats, key=lambda pair: float(np.median(pair[1].mean_DN)))
    signal = brightest[1].mean_DN - darks.of(brightest[0])
    if not np.median(signal) > 0:
        return _with_clusters(code, closest)  # no response to judge; the caller says so
    local = median_filter(signal, size=5, mode="nearest")
    ratio = signal / np.where(local > 0, local, np.nan)
    code[(~np.isfinite(ratio) | (ratio < 0.5)) & (code == 0)] = BAD_PIXEL_CODES["dead"]
    centre, spread = _robust_spread(ratio[np.isfinite(ratio)])
    departure = np.nan_to_num(np.abs(ratio - centre) / max(_DARK_NOISE_SIGMAS * spread, 0.05))
    np.maximum(closest, departure, out=closest)
    code[(departure > 1.0) & (code == 0)] = BAD_PIXEL_CODES["nonlinear"]
    return _with_clusters(code, closest)


def _bad_neighbours(bad: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many of the eight pixels about each are bad (row, column)."""
    from scipy.ndimage import convolve

    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    return np.asarray(convolve(bad.astype(np.int64), around, mode="constant"))


def _with_clusters(code: NDArray[np.uint8], closest: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Bad pixels with those that a cluster of them takes along: beside a bad one and at `_CLUSTER_SHARE` of a limit, or
    hemmed in by bad ones."""
    while True:
        neighbours = _bad_neighbours(code != 0)
        taken = (code == 0) & (((neighbours > 0) & (closest > _CLUSTER_SHARE)) | (neighbours >= _CLUSTER_NEIGHBOURS))
        if not np.any(taken):
            return code
        code = np.where(taken, np.uint8(BAD_PIXEL_CODES["clustered"]), code)


def cluster_evidence(bad: NDArray[np.uint8]) -> dict[str, int]:
    """Groups of two or more bad pixels that touch: how many, pixels in the largest, and kernel pixels.

    A kernel pixel is a bad one with fewer than five good neighbours, which interpolation cannot mend (ASTM E2597).
    """
    from scipy.ndimage import label

    numbered, _ = label(bad != 0, structure=np.ones((3, 3)))
    sizes = np.bincount(numbered.ravel())[1:]
    kernel = (bad != 0) & (_bad_neighbours(bad != 0) > 3)
    return {
        "groups": int(np.count_nonzero(sizes > 1)),
        "largest": int(sizes.max(initial=0)),
        "kernel_pixels": int(np.count_nonzero(kernel)),
    }


def _saturation(total: KeptSums, bits: int | None) -> float | None:
    """The full scale (DN) if more than 0.1 % of the values stand at it, else None."""
    full = float(2**bits - 1) if bits else None
    share = total.maximum_count / (total.frames * total.pixels)
    scales = (full,) if full is not None else _FULL_SCALES
    if total.maximum_DN in scales and share > 1e-3:
        return total.maximum_DN
    constant = total.pairs > 0 and float(np.median(total.pair_variance_DN2)) == 0.0
    return total.maximum_DN if share > 0.5 and constant else None


def _covariance(
    item: Series,
    total: KeptSums,
    signal: NDArray[np.float64],
    good: NDArray[np.bool_],
    radius: int,
    estimator: str,
) -> NoiseCovariance:
    most = int(min(total.frames, COVARIANCE_FRAMES, max(2, _COVARIANCE_SAMPLES // good.size)))

    def pieces() -> Any:
        left = most
        for piece in item.iter_frames(maximum_bytes=_PIECE_BYTES):
            yield piece[:left]
            left -= piece.shape[0]
            if left <= 0:
                return

    result = compute_noise_covariance(
        pieces(),
        signal_DN=signal,
        good=good,
        radius=radius,
        about=(total.mean_DN, total.frames) if estimator == "stack" else None,
    )
    return NoiseCovariance(
        covariance_DN2=result.covariance_DN2 * item.averaged,
        samples=result.samples,
        signal_DN=result.signal_DN,
        pair_share=result.pair_share,
        common_mode=result.common_mode,
    )


def compute_photon_transfer(
    acquisition: AcquisitionFile,
    *,
    radius: int = 5,
    estimator: str = "pairs",
    repeated: Sequence[Series] | None = None,
    progress: Progress | None = None,
) -> PhotonTransfer:
    """Photon transfer of the darks and flats of an acquisition that may calibrate.

    Where the flats of a beam are single (averaged) frames, level and maps come from these and the noise from the repeated
    frames of other series at the same kV and filters.

    Args:
        acquisition: one session, or several as one (`merge_sessions`): each then has its own darks.
        radius: largest lag of the noise covariances, px.
        estimator: where variances come from: `pairs` of successive frames, which slow drift leaves alone, or the `stack`
            about its mean, which lag lowers less. The evidence holds both.
        repeated: flats and objects that the noise of beams with single-frame flats may be read from; None: those of the
            acquisition, which are held back for evaluation only where there are no others.
        progress: called with the name of each stage.

    Raises:
        InputError: no darks, no flats, nothing but saturated flats or single frames, frames of several shapes, binned ones.
    """
    if estimator not in ESTIMATORS:
        raise InputError("estimator", received=estimator, expected="one of " + ", ".join(ESTIMATORS))
    with SumsKeeper() as keeper:
        return _photon_transfer(
            acquisition,
            keeper,
            radius=radius,
            estimator=estimator,
            repeated=acquisition.series if repeated is None else repeated,
            progress=progress,
        )


def _photon_transfer(
    acquisition: AcquisitionFile,
    keeper: SumsKeeper,
    *,
    radius: int,
    estimator: str,
    repeated: Sequence[Series],
    progress: Progress | None,
) -> PhotonTransfer:
    tell = progress or (lambda stage: None)
    warnings: list[str] = []
    flats = usable_series(acquisition, "flat")
    dark_series = usable_series(acquisition, "dark")
    if not flats:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="no flat series that may calibrate",
            expected="at least one series of kind flat, raw or offset-corrected, whose role is not evaluation",
        )
    offset_done = all("offset" in item.corrected for item in flats)
    if not dark_series and not offset_done:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats without a dark series",
            expected="at least one series of kind dark with two or more frames",
            remedy="measure darks (beam off, same exposure) and add them",
        )
    binned = [item.name for item in flats if item.setting is not None and item.setting.binning != 1]
    if binned:
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"binned flats ({', '.join(binned)})",
            expected="frames of single pixels",
            remedy="leave `binning` out and give the binned pixel's pixel_mm: the twin's pixels are then the binned ones",
        )
    shapes = {item.shape for item in [*flats, *dark_series]}
    if len(shapes) > 1:
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"frames of shapes {sorted(shapes)}",
            expected="darks and flats of one shape",
        )
    shape = shapes.pop()

    tell("darks")
    if offset_done:
        zero = np.zeros(shape)
        darks = _Darks({(0, None): zero}, [], zero, np.full(shape, np.nan), 0.0)
        if dark_series:
            measured = _sum_darks(dark_series, shape, keeper)
            darks = _Darks({(0, None): zero}, measured.sums, zero, measured.variance, measured.effective)
    else:
        darks = _sum_darks(dark_series, shape, keeper)

    tell("flats")
    bits = acquisition.instrument.bits
    sums: list[tuple[Series, KeptSums, str]] = []
    saturation: dict[str, float] = {}
    for item in flats:
        total = _sums_of(item, keeper)
        full = _saturation(total, bits)
        reason = ""
        if full is not None:
            saturation[item.name] = full
            reason = f"saturated at {full:g} DN"
        elif total.frames < 2:
            reason = _SINGLE
        else:
            top = _top(total, bits)
            if _reaches(total, top):
                saturation[item.name] = top
                reason = f"within 4 standard deviations of the full scale of {top:g} DN"
        sums.append((item, total, reason))
    # beams of single frames alone: their noise is looked for in what was repeated at the same beam
    single = {beam_of(item) for item, _, reason in sums if reason == _SINGLE}
    single -= {beam_of(item) for item, _, reason in sums if not reason}
    noise_series = series_of_beams(repeated, sorted(single, key=str), shape)
    judged = [
        (item, total) for item, total, reason in sums if not reason or (reason == _SINGLE and beam_of(item) in single)
    ]
    if all(reason for *_, reason in sums) and not noise_series:
        raise _no_usable_flat(acquisition, sums)
    bad = _bad_pixels(darks, judged if noise_series else [pair for pair in judged if pair[1].pairs > 0])
    good = bad == 0
    radius = max(1, min(radius, (min(shape) - 1) // 4))
    others = find_repeated_frames(
        acquisition,
        noise_series,
        sums_of=lambda item: _sums_of(item, keeper),
        dark_of=lambda item: _dark_of(darks, item),
        usable=lambda total, mask: _saturation(total, bits) is None and not _reaches(total, _top(total, bits), mask),
        good=good,
        radius=radius,
    )
    if others:
        sums = [(item, total, _reason_beside(item, total, reason, others, darks, good)) for item, total, reason in sums]
        lit = {beam_of(item) for item, _, reason in sums if not reason}
        others = tuple(item for item in others if item.beam in lit)
    masked = [(item.name, reason) for item, _, reason in sums if reason]
    if len(masked) == len(sums):
        raise _no_usable_flat(acquisition, sums)
    if masked:
        warnings.append("left out of the fit: " + "; ".join(f"{name} ({reason})" for name, reason in masked))
    good_sums = [(item, total) for item, total, reason in sums if not reason]
    if good.mean() < 0.5:
        warnings.append(f"{100 * (1 - good.mean()):.0f} % of the pixels look bad; the maps may not be trusted")

    tell("noise covariances")
    keys = sorted(
        {beam_of(item) for item, _ in good_sums}, key=lambda key: (key[0] is None, key[0] or 0.0, str(key[1]))
    )
    index_of = {key: index for index, key in enumerate(keys)}
    dark_pairs = [(item, total) for item, total in darks.sums if total.pairs > 0]
    stacks = [(item, total) for item, total in good_sums if total.pairs > 0]

    def collect(reach: int) -> tuple[list[NoiseCovariance], list[int]]:
        covariances, groups = [], []
        for item, total in stacks:
            signal = total.mean_DN - darks.of(item)
            covariances.append(_covariance(item, total, signal, good, reach, estimator))
            groups.append(index_of[beam_of(item)])
        for other in others:
            covariances.append(
                other.covariance(
                    lambda item, total, mask: _covariance(
                        item, total, total.mean_DN - _dark_of(darks, item), mask, reach, estimator
                    )
                )
            )
            groups.append(index_of[other.beam])
        for item, total in dark_pairs:
            covariances.append(_covariance(item, total, np.zeros(shape), good, reach, estimator))
            groups.append(-1)
        return covariances, groups

    covariances, groups = collect(radius)
    usable = [c.signal_DN > 0 or g < 0 for c, g in zip(covariances, groups, strict=True)]
    for (item, _), keep in zip(stacks, usable, strict=False):
        if not keep:
            warnings.append(f"left out of the fit: {item.name} (no signal above dark)")
    if not any(keep for keep, g in zip(usable, groups, strict=True) if g >= 0):
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats no brighter than the darks",
            expected="flats with signal above dark",
            remedy="check that the series' kinds are not swapped",
        )
    tell("spread and gain")
    fit = _fit(covariances, groups, usable, radius)
    wider = min(math.ceil(4 * math.sqrt(2) * fit.sigma_px), (min(shape) - 1) // 4, *(item.reach for item in others))
    if wider > radius:
        radius = wider
        covariances, groups = collect(radius)
        fit = _fit(covariances, groups, usable, radius)

    # a flat above full well or bent by nonlinearity lies below the line: drop the brightest while it does
    dropped = set()
    of_others = range(len(stacks), len(stacks) + len(others))
    while True:
        worst = _bent(covariances, groups, [keep and i not in of_others for i, keep in enumerate(usable)], fit)
        if worst is None:
            break
        usable[worst] = False
        dropped.add(worst)
        name = stacks[worst][0].name
        warnings.append(f"left out of the fit: {name} (its variance bends away from the photon-transfer line)")
        fit = _fit(covariances, groups, usable, radius)

    tell("maps")
    # averaged frames are no whole numbers whatever the ADC does
    counted = [*dark_pairs, *stacks, *((item, total) for other in others for item, total, _ in other.members)]
    quantised = all(total.integer for _, total in counted)
    rounding = 1.0 / 12.0 if quantised else 0.0
    flat_groups = [index_of[beam_of(item)] for item, _ in good_sums]
    flat_usable = [True] * len(good_sums)
    for (item, _), keep in zip(stacks, usable, strict=False):
        flat_usable[next(i for i, (flat, _) in enumerate(good_sums) if flat is item)] = keep
    if others:
        fit = _with_others(fit, groups, usable, {index_of[item.beam]: item.where for item in others}, darks, good)
    read_variance = fit.read_variance_DN2 - rounding
    if not dark_pairs:
        warnings.append(
            "no dark series of two or more frames: the read noise is the intercept of the photon-transfer line"
        )
    if read_variance <= 0:
        warnings.append("read noise not seen above the ADC's rounding; set to 0 with its interval")
    read_sd = fit.read_sd_DN2
    read_noise = _root_estimate(read_variance, read_sd)
    points = _points(sums, darks, good, covariances, stacks, usable, dropped)
    if others:
        points = _with_noise_of_others(
            points, others, covariances[of_others.start : of_others.stop], fit.read_variance_DN2
        )
    read_map, read_relative_sd = _read_variance_map(darks, good, fit.read_variance_DN2)
    gain_map, gain_sd = _gain_map(good_sums, flat_usable, darks, good, fit, flat_groups, read_map, estimator)
    levels = _levels(acquisition, keys, good_sums, flat_usable, darks, good, fit, flat_groups, points, saturation)
    session = max((item.session for item in [*flats, *dark_series]), default=0)
    dark_estimate, reference_exposure = _dark_estimate(
        darks,
        good,
        session,
        [item.exposure_ms for item, _ in good_sums if item.session == session],
        fit.read_variance_DN2,
    )
    evidence = _evidence(points, fit, darks, covariances, groups, good, warnings)
    evidence["estimator"] = estimator
    evidence["clusters"] = cluster_evidence(bad)
    evidence["maps"] = {
        "gain_relative_sd": gain_sd,
        "gain_relative_spread": float(np.std(gain_map[good])),
        "read_variance_relative_sd": read_relative_sd,
        "dark_sd_DN": _dark_map_sd(darks, good, session, reference_exposure, fit.read_variance_DN2),
    }
    if others:
        evidence["repeated_frames"] = evidence_of(others, good)
        warnings.append(warning_of(evidence["repeated_frames"]))
    sessions = _session_evidence(acquisition, sums, flat_usable, good_sums, darks, good, warnings)
    if sessions is not None:
        evidence["sessions"] = sessions
    for point in points:
        if point.used and point.common_mode_percent > 0.3:
            warnings.append(
                f"tube output varies by {point.common_mode_percent:.2g} % rms from frame to frame in {point.series}"
            )
            break
    reference_dark = darks.at(session, reference_exposure)
    return PhotonTransfer(
        maps=DetectorMaps(
            dark_DN=reference_dark.astype(np.float32),
            dark_exposure_ms=reference_exposure,
            dark_DN_per_ms=darks.per_ms.astype(np.float32),
            gain_relative=gain_map.astype(np.float32),
            read_variance_DN2=read_map.astype(np.float32),
            bad_pixels=bad,
        ),
        noise=NoiseModel(
            psf_model=fit.model,
            psf_sigma_px=estimate_from_sd(fit.sigma_px, fit.sigma_sd_px, lowest=0.0),
            white_fraction=float(np.clip(np.nanmean(fit.white_fraction), 0.0, None)),
            read_noise_DN=read_noise,
            quantised=quantised,
        ),
        dark_DN=dark_estimate,
        levels=levels,
        points=points,
        fit=fit,
        evidence=evidence,
        warnings=tuple(warnings),
    )


def _no_usable_flat(acquisition: AcquisitionFile, sums: Sequence[tuple[Series, KeptSums, str]]) -> InputError:
    return InputError(
        f"acquisition {acquisition.path}",
        received=f"no usable flat ({sums[0][0].name}: {sums[0][2]})",
        expected="at least one unsaturated flat series of two or more frames",
        remedy="lower the current or the exposure, or take more frames",
    )


def _top(total: KeptSums, bits: int | None) -> float:
    """Full scale that a series may reach, DN."""
    return float(2**bits - 1) if bits else max(_next_full_scale(total.maximum_DN), total.maximum_DN)


def _reaches(total: KeptSums, top_DN: float, mask: NDArray[np.bool_] | None = None) -> bool:
    """Whether the noise of a series reaches a full scale."""
    chosen = slice(None) if mask is None else mask
    spread = math.sqrt(max(float(np.median(total.pair_variance_DN2[chosen])), 0.0))
    return float(np.median(total.mean_DN[chosen])) + 4 * spread > top_DN


def _dark_of(darks: _Darks, item: Series) -> NDArray[np.float64]:
    return np.zeros(item.shape) if "offset" in item.corrected else darks.of(item)


def _reason_beside(
    item: Series,
    total: KeptSums,
    reason: str,
    others: Sequence[RepeatedFrames],
    darks: _Darks,
    good: NDArray[np.bool_],
) -> str:
    """Why a flat is left out once the noise of single frames is known from other series; empty: it is not."""
    if reason != _SINGLE or all(other.beam != beam_of(item) for other in others):
        return reason
    return "" if float(np.median((total.mean_DN - darks.of(item))[good])) > 0 else "no signal above dark"


def _with_others(
    fit: SpreadFit,
    groups: Sequence[int],
    usable: Sequence[bool],
    wheres: Mapping[int, str],
    darks: _Darks,
    good: NDArray[np.bool_],
) -> SpreadFit:
    """The fit with what the noise of other series leaves open; a read variance without darks' noise is kept between 0 and
    what the darks' difference leaves."""
    present = sorted({group for group, keep in zip(groups, usable, strict=True) if keep and group >= 0})
    fit = widened(fit, {present.index(group): where for group, where in wheres.items() if group in present})
    if darks.effective > 0:
        return fit
    most = most_read_variance([(total.mean_DN, total.frames * item.averaged) for item, total in darks.sums], good)
    if most is None:
        return fit
    value, sd = bounded_read_variance(fit.read_variance_DN2, fit.read_sd_DN2, most)
    return replace(fit, read_variance_DN2=value, read_sd_DN2=sd)


def _with_noise_of_others(
    points: Sequence[SeriesPoint],
    others: Sequence[RepeatedFrames],
    covariances: Sequence[NoiseCovariance],
    read_DN2: float,
) -> tuple[SeriesPoint, ...]:
    """Single-frame flats with the variance of one exposure, and the rms output noise, that other series of their beam show."""
    result = []
    for point in points:
        beam = (point.kV, tuple(sorted(str(layer) for layer in point.filters)))
        mine = [item for other, item in zip(others, covariances, strict=True) if other.beam == beam]
        if point.used and point.frames < 2 and mine:
            weights = [item.samples for item in mine]
            slopes = [(item.covariance_DN2[item.radius, item.radius] - read_DN2) / item.signal_DN for item in mine]
            variance = float(np.average(slopes, weights=weights)) * point.mean_signal_DN + read_DN2
            common = float(np.average([item.common_mode for item in mine], weights=weights))
            result.append(
                replace(
                    point,
                    pair_variance_DN2=variance,
                    stack_variance_DN2=variance,
                    common_mode_percent=100.0 * math.sqrt(common),
                )
            )
        else:
            result.append(point)
    return tuple(result)


def _next_full_scale(value: float) -> float:
    """The smallest usual full scale at or above a value, DN."""
    return next((scale for scale in _FULL_SCALES if scale >= value), math.inf)


def _fit(covariances: list[NoiseCovariance], groups: list[int], usable: list[bool], radius: int) -> SpreadFit:
    kept = [index for index, keep in enumerate(usable) if keep]
    present = sorted({groups[index] for index in kept if groups[index] >= 0})
    renumbered = {old: new for new, old in enumerate(present)} | {-1: -1}
    return fit_spread(
        [covariances[index] for index in kept], group=[renumbered[groups[index]] for index in kept], radius=radius
    )


def _bent(covariances: list[NoiseCovariance], groups: list[int], usable: list[bool], fit: SpreadFit) -> int | None:
    """Index of the brightest flat of a group if its variance lies 6 sigma and 5 % below the line through the others."""
    present = sorted({group for group, keep in zip(groups, usable, strict=True) if keep and group >= 0})
    # the bent flat is in the fit and moves its read variance, so that of the darks is taken where there are any
    darks = [c for c, group in zip(covariances, groups, strict=True) if group < 0]
    read = (
        float(np.average([c.covariance_DN2[c.radius, c.radius] for c in darks], weights=[c.samples for c in darks]))
        if darks
        else fit.read_variance_DN2
    )
    for group in present:
        members = [i for i, g in enumerate(groups) if g == group and usable[i]]
        if len(members) < 3:
            continue
        brightest = max(members, key=lambda i: covariances[i].signal_DN)
        others = [i for i in members if i != brightest]

        def zero_lag(i: int) -> float:
            centre = covariances[i].radius
            return float(covariances[i].covariance_DN2[centre, centre]) - read

        signal = np.array([covariances[i].signal_DN for i in others])
        variance = np.array([zero_lag(i) for i in others])
        sd = np.array([math.sqrt(2.0 / covariances[i].samples) * (zero_lag(i) + read) for i in others])
        weight = signal**2 / sd**2
        ratio = variance / signal
        slope = float(np.sum(weight * ratio) / np.sum(weight))
        scatter = float(np.sum(weight * (ratio - slope) ** 2)) / max(len(others) - 1, 1)
        slope_sd = math.sqrt(max(scatter, 1.0) / float(np.sum(weight)))
        item = covariances[brightest]
        measured = zero_lag(brightest) / item.signal_DN
        measured_sd = math.sqrt(2.0 / item.samples) * (measured + read / item.signal_DN)
        if measured - slope < -6.0 * math.hypot(slope_sd, measured_sd) and measured < 0.95 * slope:
            return brightest
    return None


def _root_estimate(variance: float, sd: float) -> Estimate:
    """Standard deviation with its interval from a variance with its own."""
    half = 1.959964 * sd
    value, low, high = (math.sqrt(max(v, 0.0)) for v in (variance, variance - half, variance + half))
    return Estimate(value=value, low=low, high=high)


def _median_of_means(values: NDArray[np.float64], frames: int, integer: bool) -> float:
    """Median of pixel means; means of few whole numbers tie, so the ties are taken as spread over their step."""
    middle = float(np.median(values))
    if not integer or frames < 1:
        return middle
    step = 1.0 / frames
    # an even number of pixels may put the median between two steps
    middle = float(np.partition(values, len(values) // 2)[len(values) // 2])
    below = int(np.count_nonzero(values < middle - 0.5 * step))
    tied = int(np.count_nonzero(np.abs(values - middle) <= 0.5 * step))
    return middle - 0.5 * step + step * (0.5 * len(values) - below) / tied


def _dark_estimate(
    darks: _Darks,
    good: NDArray[np.bool_],
    session: int,
    exposures: Sequence[float | None],
    read_DN2: float,
) -> tuple[Estimate, float | None]:
    """Median dark (DN) of a session at the shortest exposure of its flats that was measured dark; spread of repeats
    included."""
    known = sorted(key[1] for key in darks.by_exposure if key[0] == session and key[1] is not None)
    shared = [key for key in known if key in exposures]
    candidates = shared or known
    exposure = candidates[0] if candidates else None
    mean = darks.at(session, exposure)
    integer = all(total.integer for _, total in darks.sums)
    there = [(item, total) for item, total in darks.sums if item.session == session and item.exposure_ms == exposure]
    level = _median_of_means(mean[good], sum(total.frames for _, total in there), integer)
    repeats = [_median_of_means(total.mean_DN[good], total.frames, total.integer) for _, total in there]
    frames = sum(total.frames for _, total in there)
    pixels = int(good.sum())
    if darks.effective > 0:
        noise = float(np.nanmedian(darks.variance[good])) / max(frames, 1)
    else:
        noise = max(read_DN2, 0.0) / max(sum(total.frames * item.averaged for item, total in there), 1)
    # frame noise carries pixels over the median of the map: sd^2 = E|noise| / (pixels x density at the median)
    low, high = np.quantile(mean[good], [0.4, 0.6])
    sd = math.sqrt(math.sqrt(2.0 * noise / math.pi) * max(float(high - low), 0.5 * math.sqrt(noise)) / 0.2 / pixels)
    if len(repeats) > 1:
        sd = max(sd, float(np.std(repeats, ddof=1)) / math.sqrt(len(repeats)))
    return estimate_from_sd(level, max(sd, 1e-9)), exposure


def _dark_map_sd(
    darks: _Darks, good: NDArray[np.bool_], session: int, exposure_ms: float | None, read_DN2: float
) -> float | None:
    """Standard deviation of one pixel of the dark frame (DN), from the frames it is the mean of; `read_DN2` where these
    show no noise."""
    frames = sum(
        total.frames * item.averaged
        for item, total in darks.sums
        if (item.session, item.exposure_ms) == (session, exposure_ms)
    )
    if frames == 0:
        return None
    variance = float(np.mean(darks.variance[good])) if darks.effective >= 1 else read_DN2
    return math.sqrt(max(variance, 0.0) / frames)


def _read_variance_map(
    darks: _Darks, good: NDArray[np.bool_], pooled: float
) -> tuple[NDArray[np.float64], float | None]:
    """Electronic and rounding variance per pixel (row, column), shrunk towards the pooled value, DN^2; its relative
    standard deviation in one pixel."""
    if darks.effective < 1 or not np.all(np.isfinite(darks.variance)):
        return np.full(darks.per_ms.shape, max(pooled, 0.0)), None
    ratio = darks.variance / max(float(np.mean(darks.variance[good])), 1e-12)
    noise = 2.0 / darks.effective
    keep = _shrinkage(ratio[good], noise)
    result = max(pooled, 0.0) * (1.0 + keep * (ratio - 1.0))
    return np.asarray(np.where(good, result, pooled * ratio)), math.sqrt(keep * noise)


def _shrinkage(ratio: NDArray[np.float64], noise: float) -> float:
    """Share of a map's spread about 1 that is real rather than sampling noise of variance `noise`."""
    low, high = np.quantile(ratio, [0.1587, 0.8413])
    total = (0.5 * float(high - low)) ** 2
    return max(0.0, 1.0 - noise / total) if total > 0 else 0.0


def _gain_map(
    sums: Sequence[tuple[Series, KeptSums]],
    usable: Sequence[bool],
    darks: _Darks,
    good: NDArray[np.bool_],
    fit: SpreadFit,
    groups: Sequence[int],
    read_map: NDArray[np.float64],
    estimator: str,
) -> tuple[NDArray[np.float64], float | None]:
    """Gain of each pixel over the detector median (row, column), shrunk towards 1 as far as its own slope is noise, and
    the standard deviation of one pixel's value: of noise s^2 and true spread t^2, s t / sqrt(s^2 + t^2)."""
    present = sorted({g for g, keep in zip(groups, usable, strict=False) if keep})
    renumbered = {old: new for new, old in enumerate(present)}
    numerator = np.zeros(good.shape)
    weight_sum = 0.0
    for (item, total), keep, group in zip(sums, usable, groups, strict=False):
        if not keep or total.pairs < 1:
            continue
        slope = float(fit.slope_DN[renumbered[group]])
        signal = total.mean_DN - darks.of(item)
        typical = float(np.median(signal[good]))
        if slope <= 0 or typical <= 0:
            continue
        variance = slope * typical + fit.read_variance_DN2
        stack = estimator == "stack"
        effective = total.frames - 1.0 if stack else effective_frames(total.frames)
        weight = effective * (slope * typical / variance) ** 2 / 2.0
        own = total.stack_variance_DN2 if stack else total.pair_variance_DN2
        # in place: at full size every array that need not be made counts
        lit = signal > 0
        signal *= slope
        ratio = own * item.averaged
        ratio -= read_map
        np.divide(ratio, signal, out=ratio, where=lit)
        ratio[~lit] = 1.0
        ratio *= weight
        numerator += ratio
        weight_sum += weight
    if weight_sum <= 0:
        return np.ones(good.shape), None
    ratio = numerator / weight_sum
    ratio = ratio / float(np.median(ratio[good]))
    real = _shrinkage(ratio[good], 1.0 / weight_sum)
    gain_map = np.where(good, np.clip(1.0 + real * (ratio - 1.0), 0.1, 10.0), 1.0)
    return np.asarray(gain_map), math.sqrt(real / weight_sum)


def _points(
    sums: Sequence[tuple[Series, KeptSums, str]],
    darks: _Darks,
    good: NDArray[np.bool_],
    covariances: Sequence[NoiseCovariance],
    stacks: Sequence[tuple[Series, KeptSums]],
    usable: Sequence[bool],
    dropped: set[int],
) -> tuple[SeriesPoint, ...]:
    order = {item.name: index for index, (item, _) in enumerate(stacks)}
    points = []
    for item, total, reason in sums:
        signal = total.mean_DN - darks.of(item)
        index = order.get(item.name)
        covariance = covariances[index] if index is not None else None
        means = total.frame_mean_DN
        drift = 0.0
        typical = float(np.mean(signal[good]))
        if total.frames > 2 and typical > 0:
            position = np.linspace(-0.5, 0.5, total.frames)
            drift = 100.0 * float(np.polyfit(position, means, 1)[0]) / typical
        why = reason
        if index is not None and not usable[index]:
            why = "bends away from the photon-transfer line" if index in dropped else "no signal above dark"
        points.append(
            SeriesPoint(
                series=item.name,
                kV=item.kV,
                filters=item.filters,
                exposure_ms=item.exposure_ms,
                load_mAs=_load(item),
                source_detector_mm=item.source_detector_mm,
                photons_per_pixel=item.photons_per_pixel,
                frames=total.frames,
                averaged=item.averaged,
                signal_DN=float(np.median(signal[good])),
                mean_signal_DN=typical,
                pair_variance_DN2=float(np.mean(total.pair_variance_DN2[good])) * item.averaged,
                stack_variance_DN2=float(np.mean(total.stack_variance_DN2[good])) * item.averaged,
                used=not why,
                masked=why,
                drift_percent=drift,
                common_mode_percent=100.0 * math.sqrt(covariance.common_mode) if covariance else 0.0,
            )
        )
    return tuple(points)


def _load(item: Series) -> float | None:
    if item.kV is None or item.exposure_ms is None:
        return None
    current = (
        item.current_mA
        if item.current_mA is not None
        else (item.power_W / item.kV if item.power_W is not None else None)
    )
    return None if current is None else current * item.exposure_ms / 1000.0


def _levels(
    acquisition: AcquisitionFile,
    keys: Sequence[tuple[float | None, tuple[str, ...]]],
    sums: Sequence[tuple[Series, KeptSums]],
    usable: Sequence[bool],
    darks: _Darks,
    good: NDArray[np.bool_],
    fit: SpreadFit,
    groups: Sequence[int],
    points: Sequence[SeriesPoint],
    saturation: dict[str, float],
) -> tuple[Level, ...]:
    point_of = {point.series: point for point in points}
    present = sorted({groups[i] for i in range(len(sums)) if usable[i]})
    levels = []
    for fitted, group in enumerate(present):
        members = [i for i in range(len(sums)) if groups[i] == group and usable[i]]
        shape_sum = np.zeros(good.shape)
        for i in members:
            item, total = sums[i]
            shape_sum += (total.mean_DN - darks.of(item)) * total.frames
        centre = float(np.median(shape_sum[good]))
        flat_shape = shape_sum / centre if centre > 0 else np.ones(good.shape)
        first = sums[members[0]][0]
        distance = first.source_detector_mm or acquisition.instrument.source_detector_mm
        same = [i for i in members if (sums[i][0].source_detector_mm or distance) == distance]
        saturated = [
            value
            for name, value in saturation.items()
            if beam_of(next(s for s in acquisition.series if s.name == name)) == keys[group]
        ]
        levels.append(
            Level(
                kV=keys[group][0],
                filters=first.filters,
                gain_DN=estimate_from_sd(float(fit.gain_DN[fitted]), float(fit.gain_sd_DN[fitted])),
                photon_transfer_slope_DN=estimate_from_sd(float(fit.slope_DN[fitted]), float(fit.slope_sd_DN[fitted])),
                rate_DN_per_mAs=_rate([point_of[sums[i][0].name] for i in same], darks, good, flat_shape),
                source_detector_mm=distance,
                saturation_DN=min(saturated) if saturated else None,
                flat_shape=flat_shape.astype(np.float32),
                series=tuple(sums[i][0].name for i in members),
                role="calibration",
            )
        )
    return tuple(levels)


def median_variance(noise_variance: ArrayLike, *, spread_sd: ArrayLike, pixels: int) -> NDArray[np.float64]:
    """Variance of the median of a fixed map under noise, in the unit of `noise_variance`.

        var = s sqrt((2 m)^2 + (pi / 2 s)^2) / n

    s: noise sd of a pixel, m: sd of the map. Where m >> s only the pixels within s of the median can move it, so its noise is
    sqrt(2 m / s) times that of the mean. Right at both ends, between them within 15 % for Gaussian maps.
    """
    noise = np.asarray(noise_variance, dtype=np.float64)
    spread = np.asarray(spread_sd, dtype=np.float64)
    return np.asarray(np.sqrt(noise * (4.0 * spread**2 + (0.5 * math.pi) ** 2 * noise)) / pixels)


def _rate(
    points: Sequence[SeriesPoint], darks: _Darks, good: NDArray[np.bool_], flat_shape: NDArray[np.float64]
) -> Estimate | None:
    """Signal per mAs (DN) by weighted mean over the series; the scatter between them is part of the interval.

    What a single series cannot show, how well tube and filters repeat themselves, is not: the spectral fit learns it.
    """
    known = [point for point in points if point.load_mAs]
    if not known:
        return None
    load = np.array([point.load_mAs for point in known], dtype=np.float64)
    signal = np.array([point.signal_DN for point in known])
    noise = float(np.nanmedian(darks.variance[good])) if darks.effective > 0 else 0.0
    frames = np.array([point.frames * point.averaged for point in known], dtype=np.float64)
    of_a_pixel = (noise + np.array([p.pair_variance_DN2 for p in known])) / frames
    # robust: a few pixels far off do not move a median
    spread = 1.4826 * float(np.median(np.abs(flat_shape[good] - np.median(flat_shape[good]))))
    sampling = median_variance(of_a_pixel, spread_sd=spread * signal, pixels=int(good.sum())) / load**2
    weight = 1.0 / (sampling + (_SERIES_REPRODUCIBILITY * signal / load) ** 2)
    weight /= weight.sum()
    rate = float(np.sum(weight * signal / load))
    variance = float(np.sum(weight**2 * sampling))
    if len(known) > 1:
        variance = max(variance, float(np.sum(weight * (signal / load - rate) ** 2)) / (len(known) - 1))
    return estimate_from_sd(rate, math.sqrt(variance))


def _evidence(
    points: Sequence[SeriesPoint],
    fit: SpreadFit,
    darks: _Darks,
    covariances: Sequence[NoiseCovariance],
    groups: Sequence[int],
    good: NDArray[np.bool_],
    warnings: list[str],
) -> dict[str, Any]:
    """What the series say about drift, lag, linearity and the shape of the noise, beside the fit."""
    used = [point for point in points if point.used]
    lit = [p for p in used if p.pair_variance_DN2 > 0 and math.isfinite(p.stack_variance_DN2) and p.frames > 2]
    weights = np.array([p.frames for p in lit], dtype=np.float64)
    ratio = (
        float(np.average([p.stack_variance_DN2 / p.pair_variance_DN2 for p in lit], weights=weights)) if lit else None
    )
    if ratio is not None and ratio > 1.02:
        warnings.append(
            f"stack variances are {100 * (ratio - 1):.1f} % above pair variances: the level drifts or frames are"
            " correlated; gains come from pairs"
        )
    linearity = _linearity(used)
    read_DN2 = float(np.nanmedian(darks.variance[good])) if darks.effective > 0 else 0.0
    dark_frames = min((kept.frames for _, kept in darks.sums), default=1)
    left = np.asarray(fit.slope_DN / np.where(fit.gain_DN > 0, fit.gain_DN, np.nan))
    repeats = _repeats(
        used,
        read_DN2=read_DN2,
        dark_frames=dark_frames,
        pixels=int(good.sum()),
        share=float(np.nanmedian(left)) if np.isfinite(left).any() else 1.0,
    )
    for row in repeats:
        if abs(row["change_percent"]) > max(0.3, 5.0 * row["noise_percent"]):
            warnings.append(
                f"the level changed by {row['change_percent']:+.2g} % from {row['series'][0]} to {row['series'][-1]} at"
                " the same setting: output or detector drift between series"
            )
    if linearity is not None and linearity["largest_departure_percent"] > 1.0:
        warnings.append(
            "signal departs from a line in tube load or exposure by up to"
            f" {linearity['largest_departure_percent']:.2g} %"
        )
    if fit.degrees > 0 and fit.chi_square / fit.degrees > 2.0:
        warnings.append(
            f"the noise covariances do not look like a Gaussian spread (chi-square {fit.chi_square / fit.degrees:.1f}"
            " per degree of freedom); gains are sums of covariances, and the images generated from this twin have a Gaussian spread"
        )
    dark_levels = [
        {
            "series": item.name,
            "index": item.index,
            "exposure_ms": item.exposure_ms,
            "median_DN": float(np.median(total.mean_DN[good])),
            "frames": total.frames,
        }
        for item, total in darks.sums
    ]
    neighbour = [c for c, g in zip(covariances, groups, strict=True) if g < 0]
    dark_correlation = None
    if neighbour:
        centre = neighbour[0].radius
        zero = sum(c.covariance_DN2[centre, centre] for c in neighbour)
        dark_correlation = {
            "row_direction": float(sum(c.covariance_DN2[centre + 1, centre] for c in neighbour) / zero)
            if zero
            else 0.0,
            "column_direction": float(sum(c.covariance_DN2[centre, centre + 1] for c in neighbour) / zero)
            if zero
            else 0.0,
        }
    return {
        "stack_over_pair_variance": ratio,
        "drift_percent_per_series": {p.series: p.drift_percent for p in used},
        "output_rms_percent": max((p.common_mode_percent for p in used), default=0.0),
        "repeated_settings": repeats,
        "linearity": linearity,
        "dark": dark_levels,
        "dark_neighbour_correlation": dark_correlation,
        "spread_fit": {
            "model": fit.model,
            "chi_square_per_degree": fit.chi_square / max(fit.degrees, 1),
            "degrees": fit.degrees,
            "other_model_chi_square_excess": fit.chi_square_other - fit.chi_square,
            "other_model_sigma_px": fit.sigma_other_px,
            "white_fraction": [float(value) for value in fit.white_fraction],
        },
        "photon_transfer": [point.as_dict() for point in points],
    }


def _session_evidence(
    acquisition: AcquisitionFile,
    sums: Sequence[tuple[Series, KeptSums, str]],
    usable: Sequence[bool],
    good_sums: Sequence[tuple[Series, KeptSums]],
    darks: _Darks,
    good: NDArray[np.bool_],
    warnings: list[str],
) -> list[dict[str, Any]] | None:
    """Per session: its series, dark levels, levels a mAs, and their change since the first session that has the same;
    None for one session."""
    numbers = sorted({item.session for item in [*(row[0] for row in sums), *(row[0] for row in darks.sums)]})
    if len(numbers) < 2:
        return None
    dark_first: dict[float | None, float] = {}
    rate_first: dict[tuple[Any, ...], float] = {}
    found = []
    for number in numbers:
        dark_change: dict[str, float] = {}
        for key, mean in darks.by_exposure.items():
            if key[0] == number:
                level = float(np.median(mean[good]))
                dark_change[f"{key[1]:g} ms" if key[1] is not None else "unknown"] = level - dark_first.setdefault(
                    key[1], level
                )
        loads: dict[tuple[Any, ...], list[tuple[float, float]]] = {}
        for (item, total), keep in zip(good_sums, usable, strict=False):
            load = _load(item)
            if keep and load is not None and item.session == number:
                signal = float(np.median((total.mean_DN - darks.of(item))[good]))
                loads.setdefault((*beam_of(item), item.source_detector_mm), []).append((signal, load))
        level_change: dict[str, float] = {}
        for beam, pairs in loads.items():
            rate = sum(signal for signal, _ in pairs) / sum(load for _, load in pairs)
            name = f"{beam[0]:g} kV" + "".join(f" {layer}" for layer in beam[1])
            level_change[name] = 100.0 * (rate / rate_first.setdefault(beam, rate) - 1.0)
        found.append(
            {
                "session": number,
                "series": sum(item.session == number for item in acquisition.series),
                "dark_change_DN": dark_change,
                "level_change_percent": level_change,
            }
        )
        largest = max(level_change.values(), key=abs, default=0.0)
        if abs(largest) > 0.3:
            warnings.append(f"session {number + 1}: levels changed by up to {largest:+.2g} % since the first session")
        largest = max(dark_change.values(), key=abs, default=0.0)
        if abs(largest) > 1.0:
            warnings.append(
                f"session {number + 1}: the dark level moved by {largest:+.3g} DN; each session has its own darks"
            )
    return found


def _repeats(
    points: Sequence[SeriesPoint], *, read_DN2: float, dark_frames: int, pixels: int, share: float
) -> list[dict[str, Any]]:
    """Settings measured more than once: levels in order of time, sampling noise of each, change from first to last, %.

    Args:
        points: the flats.
        read_DN2: electronic variance of a pixel and frame.
        dark_frames: of the shortest dark series.
        pixels: that the levels are means of.
        share: of the quanta's variance that the spread leaves in one pixel; a mean over pixels carries all of it.
    """
    groups: dict[tuple[Any, ...], list[SeriesPoint]] = {}
    for point in points:
        key = (point.kV, point.filters, point.exposure_ms, point.load_mAs, point.photons_per_pixel)
        groups.setdefault((*key, point.source_detector_mm), []).append(point)
    rows = []
    for members in groups.values():
        if len(members) < 2:
            continue
        levels = [point.mean_signal_DN for point in members]
        change = 100.0 * (levels[-1] / levels[0] - 1.0)
        sampling = []
        for point in members:
            quanta_DN2 = max(point.pair_variance_DN2 - read_DN2, 0.0) / max(share, 1e-3)
            noise_DN2 = ((quanta_DN2 + read_DN2) / (point.frames * point.averaged) + read_DN2 / dark_frames) / pixels
            of_pixels = 100.0 * math.sqrt(noise_DN2) / max(point.mean_signal_DN, 1e-9)
            sampling.append(math.hypot(point.common_mode_percent / math.sqrt(point.frames), of_pixels))
        rows.append(
            {
                "series": [point.series for point in members],
                "mean_signal_DN": levels,
                "change_percent": change,
                "sampling_percent": sampling,
                "noise_percent": math.hypot(sampling[0], sampling[-1], 0.02),
            }
        )
    return rows


def _linearity(points: Sequence[SeriesPoint]) -> dict[str, Any] | None:
    """Departure of the signal from a line through zero in mAs (or photons, or ms) within each kV and filter, %."""
    groups: dict[tuple[Any, ...], list[SeriesPoint]] = {}
    for point in points:
        groups.setdefault((point.kV, point.filters, point.source_detector_mm), []).append(point)
    rows: list[dict[str, Any]] = []
    for members in groups.values():
        for quantity in ("load_mAs", "photons_per_pixel", "exposure_ms"):
            values = [getattr(point, quantity) for point in members]
            if all(value for value in values) and len(set(values)) > 1:
                load = np.array(values, dtype=np.float64)
                signal = np.array([point.signal_DN for point in members])
                slope = float(np.sum(signal) / np.sum(load))
                departure = 100.0 * (signal - slope * load) / np.max(signal)
                rows.append(
                    {
                        "kV": members[0].kV,
                        "filter": text_from_filters(members[0].filters),
                        "against": quantity,
                        "DN_per_unit": slope,
                        "departure_percent_of_full": [float(value) for value in departure],
                    }
                )
                break
    if not rows:
        return None
    largest = max(max(abs(value) for value in row["departure_percent_of_full"]) for row in rows)
    return {"largest_departure_percent": largest, "groups": rows}
