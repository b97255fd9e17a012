"""Photon transfer of a session: darks and flats -> dark, read noise, optical spread, gain per kV and filter, maps.

Three passes over the frames: one for copies and scenes, one for the per-pixel sums, one over at most `POWER_FRAMES` frames a
series for the noise power, once the bad pixels are known.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...errors import InputError
from ...generator.line.twin import (
    BAD_PIXEL_CODES,
    Z95,
    DetectorMaps,
    Estimate,
    Level,
    NoiseModel,
    SpreadEstimate,
    estimate_from_sd,
)
from ..frames._kept_sums import KeptSums, SumsKeeper
from ..frames.bad_pixels import cluster_evidence, find_bad_pixels, unsteady_in_darks
from ..frames.dark_frames import DarkFrames, dark_estimate, dark_map_sd, read_variance_map, sum_darks
from ..frames.frame_checks import repeated_frame_indices, row_length_shown, same_scene, with_median_at
from ..frames.frame_sums import PIECE_BYTES, sum_frames
from ..frames.full_scale import full_scale_reached, reaches, top_of_range
from ..frames.interpolated_pixels import find_interpolated
from ..spread.noise_power import SMALLEST_SQUARE_PX
from ..spread.spread_fit import SpreadFit
from .common_noise import common_variance
from .flat_evidence import flat_evidence, session_evidence
from .flat_levels import SeriesPoint, gain_map_of, levels_of, series_points, with_noise_of_others
from .noise_of_flats import FlatNoise, fit_flat_noise
from .noise_sources import FlatPair, pairs_of_singles
from .repeated_frames import (
    OPEN,
    Beam,
    RepeatedFrames,
    beam_of,
    evidence_of,
    find_repeated_frames,
    series_of_beams,
    warning_of,
)
from .setting_errors import dark_changes, dark_current_sd, setting_errors, told_darks, told_errors

ESTIMATORS = ("pairs", "stack")
_ONE_BEAM = 1.32  # largest over smallest signal a load: 15 % to either side, as `raytwin check` allows
_SINGLE = "a single frame has no noise"
_UNSTEADY_PERCENT = 0.3  # rms of the tube's output from frame to frame that is worth a warning

Progress = Callable[[str], None]
SumsOf = Callable[[Series], KeptSums]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotonTransfer:
    """Everything that the flats and darks say without a spectrum; dark_changes: what `levels` do not allow for yet."""

    maps: DetectorMaps
    noise: NoiseModel
    dark_DN: Estimate
    levels: tuple[Level, ...]
    points: tuple[SeriesPoint, ...]
    dark_changes: Mapping[str, float]
    fit: SpreadFit
    evidence: dict[str, Any]
    warnings: tuple[str, ...]


def compute_photon_transfer(
    acquisition: AcquisitionFile,
    *,
    estimator: str = "pairs",
    repeated: Sequence[Series] | None = None,
    progress: Progress | None = None,
) -> PhotonTransfer:
    """Photon transfer of the darks and flats of an acquisition that may calibrate.

    Where the flats of a beam are single (averaged) frames, level and maps come from these and the noise from the repeated
    frames of other series at the same kV and filters.

    Args:
        acquisition: one session, or several as one (`merge_sessions`): each then has its own darks.
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
    tell = progress or (lambda stage: None)
    session = _calibrating_series(acquisition, tell)
    with SumsKeeper() as keeper:

        def sums_of(item: Series) -> KeptSums:
            return keeper.keep(sum_frames(item.iter_frames(maximum_bytes=PIECE_BYTES), name=f"series {item.name}"))

        tell("darks")
        darks = sum_darks(session.darks, session.shape, sums_of)
        if session.offset_done:
            darks = DarkFrames.taken_off(session.shape, darks if session.darks else None)
        tell("flats")
        flats = _sum_flats(session, darks, sums_of, repeated=acquisition.series if repeated is None else repeated)
        _check_rows(flats)
        noise = fit_flat_noise(
            acquisition, flats.in_use, flats.pairs, flats.others, darks, flats.good, estimator=estimator, tell=tell
        )
        tell("maps")
        return _assembled(session, darks, flats, noise, estimator)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Session:
    """Series that calibrate: flats and darks of one shape (row, column), copies of frames left out.

    Fields: offset_done: darks are subtracted from the flats, or there is no offset; warnings.
    """

    acquisition: AcquisitionFile
    flats: list[Series]
    darks: list[Series]
    shape: tuple[int, int]
    offset_done: bool
    warnings: list[str]


def _without_copies(series: Sequence[Series], warnings: list[str]) -> list[Series]:
    """The series with each exposure once: frames that a grabber repeated are left out."""
    result = []
    for item in series:
        copies = repeated_frame_indices(item.iter_frames(maximum_bytes=PIECE_BYTES)) if item.n_frames > 1 else ()
        if copies:
            warnings.append(
                f"{item.name}: {len(copies)} of {item.n_frames} frames are copies of another frame (first: frame {copies[0]});"
                " each exposure is counted once"
            )
        result.append(item.without_frames(copies) if copies else item)
    return result


def _calibrating_series(acquisition: AcquisitionFile, tell: Progress) -> _Session:
    """Series that may calibrate: not held back for evaluation, not logged or gain-corrected.

    Raises:
        InputError: no darks, no flats, frames of several shapes, binned ones.
    """
    of = f"acquisition {acquisition.path}"
    flats, darks = (
        [
            series
            for series in acquisition.of_kind(kind)
            if series.role != "evaluation" and not series.corrected & {"log", "gain"}
        ]
        for kind in ("flat", "dark")
    )
    if not flats:
        raise InputError(
            of,
            received="no flat series that may calibrate",
            expected="at least one series of kind flat, raw or offset-corrected, whose role is not evaluation",
        )
    counting = bool(acquisition.instrument.counting)
    offset_done = all("offset" in item.corrected for item in flats) or (counting and not darks)
    if not darks and not offset_done:
        raise InputError(
            of,
            received="flats without a dark series",
            expected="at least one series of kind dark with two or more frames",
            remedy="measure darks (beam off, same exposure) and add them; a photon counter without darks needs counting = true"
            " in its instrument",
        )
    binned = [item.name for item in flats if item.setting is not None and item.setting.binning != 1]
    if binned:
        raise InputError(
            of,
            received=f"binned flats ({', '.join(binned)})",
            expected="frames of single pixels",
            remedy="leave `binning` out and give the binned pixel's pixel_mm: the twin's pixels are then the binned ones",
        )
    shapes = {item.shape for item in [*flats, *darks]}
    if len(shapes) > 1:
        raise InputError(of, received=f"frames of shapes {sorted(shapes)}", expected="darks and flats of one shape")
    rows, columns = next(iter(shapes))
    if min(rows, columns) < SMALLEST_SQUARE_PX:
        raise InputError(
            of,
            received=f"frames of {rows} x {columns} pixels",
            expected=f"{SMALLEST_SQUARE_PX} x {SMALLEST_SQUARE_PX} pixels or more",
            remedy="check that the files are no colour pictures and that rows and columns of raw files are as stated; lines of a line"
            " camera make frames when a hundred or more are stacked",
        )
    tell("copies of frames")
    warnings: list[str] = []
    flats, darks = _without_copies(flats, warnings), _without_copies(darks, warnings)
    if counting and not darks:
        warnings.append("no darks: a photon counter has no offset, and the dark level counts as 0")
        flats = [replace(item, corrected=item.corrected | {"offset"}) for item in flats]
    return _Session(
        acquisition=acquisition,
        flats=flats,
        darks=darks,
        shape=shapes.pop(),
        offset_done=offset_done,
        warnings=warnings,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flats:
    """Flats summed.

    Fields: sums: each flat with its sums and why it is left out (empty: it is not); pairs: of single flats of one beam;
    others: what was repeated at the beams of other single flats; bad: reason codes of pixels (row, column);
    saturation_DN: full scale that series reach, by name; noted: what else is to be said.
    """

    sums: list[tuple[Series, KeptSums, str]]
    pairs: tuple[FlatPair, ...]
    others: tuple[RepeatedFrames, ...]
    bad: NDArray[np.uint8]
    saturation_DN: dict[str, float]
    noted: list[str]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Pixels in use (row, column)."""
        return np.asarray(self.bad == 0)

    @property
    def in_use(self) -> list[tuple[Series, KeptSums]]:
        """Flats that are not left out."""
        return [(item, total) for item, total, reason in self.sums if not reason]

    def warnings(self) -> list[str]:
        """What is left out, and whether too much of the panel is bad."""
        found = list(self.noted)
        masked = "; ".join(f"{item.name} ({reason})" for item, _, reason in self.sums if reason)
        if masked:
            found.append("left out of the fit: " + masked)
        share = float(self.good.mean())
        if share < 0.5:
            found.append(f"{100 * (1 - share):.0f} % of the pixels look bad; the maps may not be trusted")
        return found


def _scene_change(item: Series, darks: DarkFrames, unsteady: NDArray[np.bool_]) -> str:
    """What differs between the frames of a series beyond noise, drift and flicker; empty: nothing that can be seen.

    unsteady (row, column): pixels whose noise is no sign of another scene.
    """
    if item.n_frames < 2:
        return ""
    pieces = (with_median_at(piece, unsteady) for piece in item.iter_frames(maximum_bytes=PIECE_BYTES))
    found = same_scene(pieces, offset_DN=float(np.median(darks.of(item))))
    if found.same is not False or found.change is None:
        return ""
    return f"its frames do not show one scene: {found.change.value} changes from frame {found.frame}"


def _sum_flats(session: _Session, darks: DarkFrames, sums_of: SumsOf, *, repeated: Sequence[Series]) -> _Flats:
    """Sums of the flats, what is wrong with some, bad pixels, and series that stand for the noise of single frames.

    Raises:
        InputError: no flat can be used.
    """
    bits = session.acquisition.instrument.bits
    sums: list[tuple[Series, KeptSums, str]] = []
    saturation_DN: dict[str, float] = {}
    unsteady = unsteady_in_darks(darks)
    for item in session.flats:
        total = sums_of(item)
        full, top = full_scale_reached(total, bits), top_of_range(total, bits)
        reason = ""
        if full is not None:
            saturation_DN[item.name] = full
            reason = f"saturated at {full:g} DN"
        elif total.frames < 2:
            reason = _SINGLE
        elif reaches(total, top):
            saturation_DN[item.name] = top
            reason = f"within 4 standard deviations of the full scale of {top:g} DN"
        else:
            reason = _scene_change(item, darks, unsteady)
        sums.append((item, total, reason))
    _check_one_beam(
        [(item, float(np.median(total.mean_DN - darks.of(item)))) for item, total, reason in sums if not reason]
    )
    # beams of single frames alone: their noise is looked for in what was repeated at the same beam
    single = {beam_of(item) for item, _, reason in sums if reason == _SINGLE}
    single -= {beam_of(item) for item, _, reason in sums if not reason}
    lone = [
        (item, total)
        for item, total, reason in sums
        if reason == _SINGLE and beam_of(item) in single and float(np.median(total.mean_DN - darks.of(item))) > 0
    ]
    pairs = pairs_of_singles(lone)
    noted: list[str] = []
    noise_series = []
    for item in series_of_beams(repeated, sorted(single, key=str), session.shape):
        change = _scene_change(item, darks, unsteady)
        if change:
            noted.append(f"{item.name} is not used for noise: {change}; declare each scene as a series of its own")
        else:
            noise_series.append(item)
    judged = [
        (item, total) for item, total, reason in sums if not reason or (reason == _SINGLE and beam_of(item) in single)
    ]
    if all(reason for *_, reason in sums) and not noise_series and not pairs:
        raise _no_usable_flat(session.acquisition, sums)
    bad = find_bad_pixels(darks, judged if noise_series or pairs else [pair for pair in judged if pair[1].pairs > 0])
    noted += _mark_interpolated(bad, [*(item for item, _ in judged), *session.darks])
    good = bad == 0

    def usable(total: KeptSums, mask: NDArray[np.bool_]) -> bool:
        return full_scale_reached(total, bits) is None and not reaches(total, top_of_range(total, bits), mask)

    others = find_repeated_frames(
        session.acquisition,
        noise_series,
        sums_of=sums_of,
        dark_of=darks.of,
        usable=usable,
        good=good,
    )
    # frames in a row hold less besides noise than flats of different series, but not where an object hardens the beam
    paired = {pair.beam for pair in pairs}
    others = tuple(item for item in others if item.where == OPEN or item.beam not in paired)
    pairs = tuple(pair for pair in pairs if pair.beam not in {item.beam for item in others})
    if others or pairs:
        beams = {other.beam for other in others} | {pair.beam for pair in pairs}
        sums = [(item, total, _reason_beside(item, total, reason, beams, darks, good)) for item, total, reason in sums]
        lit = {beam_of(item) for item, _, reason in sums if not reason}
        others = tuple(item for item in others if item.beam in lit)
    if all(reason for *_, reason in sums):
        raise _no_usable_flat(session.acquisition, sums)
    return _Flats(sums=sums, pairs=pairs, others=others, bad=bad, saturation_DN=saturation_DN, noted=noted)


def _check_one_beam(levels: Sequence[tuple[Series, float]]) -> None:
    """Flats without kV count as one beam.

    Args:
        levels: flats with their signal, DN.

    Raises:
        InputError: signals over current and exposure that one beam does not have.
    """
    groups: dict[tuple[Any, ...], list[float]] = {}
    for item, signal_DN in levels:
        unit, load = ("mAs", item.current_mA) if item.current_mA else ("Ws", item.power_W)
        if item.kV is None and load and item.exposure_ms and signal_DN > 0:
            group = (unit, item.session, item.filters, item.source_detector_mm)
            groups.setdefault(group, []).append(1000.0 * signal_DN / (load * item.exposure_ms))
    for (unit, *_), rates in groups.items():
        if max(rates) > _ONE_BEAM * min(rates):
            raise InputError(
                "flats without kV",
                received=f"{min(rates):.0f} to {max(rates):.0f} DN a {unit}",
                expected="one beam, whose signal is proportional to current or power, and to exposure",
                remedy="state the kV of every flat: those of several voltages have gains of their own",
            )


def _check_rows(flats: _Flats) -> None:
    """Refuse frames whose rows are of another length than the file has.

    Raises:
        InputError: the brightest flat's noise repeats after another length.
    """
    repeated = [(item, total) for item, total in flats.in_use if total.frames > 1]
    if not repeated:
        return
    item, _ = max(repeated, key=lambda one: float(np.median(one[1].mean_DN)))
    frames = (frame for piece in item.iter_frames(maximum_bytes=PIECE_BYTES) for frame in piece)
    length = row_length_shown(next(frames), next(frames))
    if length is not None:
        rows, columns = item.shape
        raise InputError(
            f"series {item.name}",
            received=f"{rows} rows of {columns} px, where pixels share light with those {length} px on",
            expected=f"{rows * columns // length} rows of {length} px",
            remedy="exchange or correct rows and columns where the frames were imported",
        )


def _mark_interpolated(bad: NDArray[np.uint8], series: Sequence[Series]) -> list[str]:
    """Mark pixels (row, column) that hold means of their neighbours, and say what is to be said of them."""
    found = find_interpolated(series)
    if found is None:
        declared = [item.name for item in series if "defects" in item.corrected]
        if not declared:
            return []
        return [
            f"{declared[0]}: pixels are replaced (corrected = defects), and so few frames do not tell which: the noise of means is in"
            " gain and spread"
        ]
    new = found & (bad == 0)
    bad[new] = BAD_PIXEL_CODES["interpolated"]
    share = 100.0 * float(new.mean())
    return [f"{share:.2g} % of the pixels hold means of their neighbours and are left out"] if share > 0 else []


def _no_usable_flat(acquisition: AcquisitionFile, sums: Sequence[tuple[Series, KeptSums, str]]) -> InputError:
    return InputError(
        f"acquisition {acquisition.path}",
        received=f"no usable flat ({sums[0][0].name}: {sums[0][2]})",
        expected="at least one unsaturated flat series of two or more frames",
        remedy="lower the current or the exposure, or take more frames",
    )


def _reason_beside(
    item: Series,
    total: KeptSums,
    reason: str,
    beams: set[Beam],
    darks: DarkFrames,
    good: NDArray[np.bool_],
) -> str:
    """Why a flat is left out once the noise of single frames is known for some beams; empty: it is not."""
    if reason != _SINGLE or beam_of(item) not in beams:
        return reason
    return "" if float(np.median((total.mean_DN - darks.of(item))[good])) > 0 else "no signal above dark"


def _assembled(session: _Session, darks: DarkFrames, flats: _Flats, noise: FlatNoise, estimator: str) -> PhotonTransfer:
    """Maps, levels and evidence once spread and gain are known."""
    good, fit = flats.good, noise.fit
    warnings = [*session.warnings, *flats.warnings(), *noise.warnings]
    # averaged frames are no whole numbers whatever the ADC does
    of_others = [total for other in flats.others for _, total, _ in other.members]
    counted = [*(total for _, total in (*darks.repeated, *noise.stacks)), *of_others]
    quantised = all(total.integer for total in counted)
    read_DN2 = fit.read_variance_DN2 - (1.0 / 12.0 if quantised else 0.0)
    if not darks.repeated:
        warnings.append(
            "no dark series of two or more frames: the read noise is the intercept of the photon-transfer line"
        )
    if read_DN2 <= 0:
        warnings.append("read noise not seen above the ADC's rounding; set to 0 with its interval")
    points = series_points(flats.sums, noise, darks, good)
    if flats.others or flats.pairs:
        points = with_noise_of_others(points, noise)
    read_map, read_relative_sd = read_variance_map(darks, good, fit.read_variance_DN2)
    gain_map, gain_sd = gain_map_of(noise, darks, good, read_map=read_map, estimator=estimator)
    last = max(item.session for item in [*session.flats, *session.darks])
    exposures = [item.exposure_ms for item, _ in noise.flats if item.session == last]
    dark_DN, exposure_ms = dark_estimate(darks, good, last, exposures, fit.read_variance_DN2)
    evidence, found = flat_evidence(points, noise, darks, good)
    warnings += found
    evidence["estimator"] = estimator
    used, instrument = [point for point in points if point.used], session.acquisition.instrument
    growths = [float(np.median(mean[good])) / ms for (_, ms), mean in darks.by_exposure.items() if ms]
    dark_sd = dark_current_sd(min(growths, default=0.0), bits=instrument.bits)
    evidence["setting_errors"] = setting_errors(
        used, source_detector_mm=instrument.source_detector_mm, dark_DN_per_ms_sd=dark_sd
    )
    changes = dark_changes(used, evidence["setting_errors"], dark_DN_per_ms_sd=dark_sd)
    evidence["clusters"] = cluster_evidence(flats.bad)
    evidence["maps"] = {
        "gain_relative_sd": gain_sd,
        "gain_relative_spread": float(np.std(gain_map[good])),
        "read_variance_relative_sd": read_relative_sd,
        "dark_sd_DN": dark_map_sd(darks, good, last, exposure_ms, fit.read_variance_DN2),
    }
    warnings += [*told_errors(evidence["setting_errors"]), *told_darks(used, changes)]
    if flats.others:
        evidence["repeated_frames"] = evidence_of(flats.others, good)
        warnings.append(warning_of(evidence["repeated_frames"]))
    if flats.pairs:
        evidence["flat_pairs"] = [
            {"kV": pair.beam[0], "series": [pair.first[0].name, pair.second[0].name]} for pair in flats.pairs
        ]
        warnings.append(
            f"noise comes from {len(flats.pairs)} pairs of single flats: whatever changed in single pixels between the two of a"
            " pair counts as noise"
        )
    sessions, found = session_evidence(session.acquisition, session.flats, noise, darks, good)
    warnings += found
    if sessions:
        evidence["sessions"] = sessions
    unsteady = next((item for item in points if item.used and item.common_mode_percent > _UNSTEADY_PERCENT), None)
    if unsteady is not None:
        warnings.append(
            f"tube output varies by {unsteady.common_mode_percent:.2g} % rms from frame to frame in {unsteady.series}"
        )
    return PhotonTransfer(
        maps=DetectorMaps(
            dark_DN=darks.at(last, exposure_ms).astype(np.float32),
            dark_exposure_ms=exposure_ms,
            dark_DN_per_ms=darks.per_ms.astype(np.float32),
            gain_relative=gain_map.astype(np.float32),
            read_variance_DN2=read_map.astype(np.float32),
            bad_pixels=flats.bad,
            dark_noise=darks.noise_at(last, exposure_ms),
        ),
        noise=NoiseModel(
            spread=spread_estimate(fit),
            white_fraction=_white_fraction(fit),
            read_noise_DN=_root_estimate(read_DN2, fit.read_sd_DN2, fit.most_read_DN2),
            quantised=quantised,
            shared_gain_sd=fit.shared_gain_sd,
            common_variance=common_variance(points, noise),
        ),
        dark_DN=dark_DN,
        levels=levels_of(session.acquisition, noise, darks, good, points=points, saturation_DN=flats.saturation_DN),
        points=points,
        dark_changes=changes,
        fit=fit,
        evidence=evidence,
        warnings=tuple(warnings),
    )


def spread_estimate(fit: SpreadFit) -> SpreadEstimate:
    """The fitted spread with the 95 % intervals of its parameters."""
    return SpreadEstimate(
        value=fit.spread,
        family=fit.family,
        others=fit.others,
        intervals={
            name: estimate_from_sd(
                getattr(fit.spread, name), sd, lowest=0.0, highest=1.0 if name == "tail_share" else math.inf
            )
            for name, sd in fit.spread_sd.items()
            if name == "sigma_px" or sd > 0
        },
    )


def _white_fraction(fit: SpreadFit) -> float:
    """White noise that follows the signal over that of quanta, no unit, in a beam of the mean gain.

    In DN of variance for each DN of signal that white noise is the same in all beams.
    """
    lit = np.isfinite(fit.white_fraction) & (fit.gain_DN > 0)
    if not lit.any():
        return 0.0
    white = np.clip(fit.white_fraction[lit], 0.0, None)
    white_DN = float(np.mean(fit.gain_DN[lit] * white / (1.0 + white)))
    return white_DN / max(float(np.exp(np.mean(np.log(fit.gain_DN[lit])))) - white_DN, 1e-3 * white_DN)


def _root_estimate(variance: float, sd: float, most: float) -> Estimate:
    """Standard deviation with its interval from a variance with its own, which is at most `most`."""
    half = Z95 * sd
    ends = (variance, variance - half, max(min(variance + half, most), variance))
    value, low, high = (math.sqrt(max(v, 0.0)) for v in ends)
    return Estimate(value=value, low=low, high=high)
