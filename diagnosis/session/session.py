"""A measured session as the diagnosis sees it: which series calibrate, what each one asks of the forward model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.log_images import holds_shares
from ...acquisition.series_roles import calibrating_names
from ...calibration.flats.repeated_frames import Beam, beam_of
from ...errors import InputError
from ...generator.line.series_request import SeriesRequest

_REMEMBERED = 12  # series before one's own whose trapped charge may still be there
_GAP_S = 1.0  # between series whose times are not stated
# of what the series last, that all of them must span to be on one clock; two that take turns frame by frame span half
_LEAST_SPAN = 0.4
_ONE_RATE = 1.25  # largest over smallest level a unit of exposure that one unknown tube load can have


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSeries:
    """One series and its request to the forward model."""

    series: Series
    request: SeriesRequest
    calibrates: bool  # dark and gain maps come from it
    own_noise: bool  # single flats calibrate its beam: the twin has the noise from series like this one
    divided: bool  # its frames were divided by an open field of another time: their level says nothing
    shares: bool  # they are I/I0, or logarithms of it
    ends_at_zero: bool  # its numbers go down to 0 and not below, so that noise may be cut off

    @property
    def name(self) -> str:
        """The series' name."""
        return self.series.name

    @property
    def place(self) -> tuple[str, float]:
        """Its scene, and how far from the source that stood, mm (0: not stated): series of one place show the same picture."""
        return self.series.scene, self.request.source_object_mm or 0.0


def only_own_noise(session: Sequence[SessionSeries]) -> bool:
    """Whether no flat that calibrates has noise, so that the twin has it from series after them."""
    lit = [item for item in session if item.series.kind == "flat" and item.calibrates]
    return any(item.own_noise for item in session) and all(item.series.n_frames == 1 for item in lit)


def _noiseless_beams(series: Sequence[Series], calibrating: frozenset[str]) -> frozenset[Beam]:
    """Beams whose calibrating flats are all single frames."""
    flats = [item for item in series if item.kind == "flat" and item.name in calibrating]
    return frozenset(map(beam_of, flats)) - {beam_of(item) for item in flats if item.n_frames > 1}


def _mean_DN(item: Series) -> float:
    """Mean over frames and pixels, DN."""
    total, count = 0.0, 0
    for piece in item.iter_frames():
        total += float(piece.sum(dtype=np.float64))
        count += piece.size
    return total / count


def measured_levels(series: Sequence[Series]) -> dict[str, float]:
    """Open-field level (DN) of one exposure for lit series that do not state kV or tube load, by name.

    What is not stated is taken to be the same in all series of equal kV (or none), filters and distance, so that the level goes
    as the exposure time, or as the photons where they were counted: the rate is that of the flats which calibrate. Where
    these contradict one rate, each flat has its own level, and says nothing about linearity or drift.
    """
    unknown = [
        item
        for item in series
        if item.kind in ("flat", "object")
        and item.exposure_ms
        and (item.setting is None or item.setting.tube_load_mAs is None)
    ]
    if not unknown:
        return {}
    darks = sorted((item.exposure_ms, _mean_DN(item)) for item in series if item.kind == "dark" and item.exposure_ms)
    calibrating = calibrating_names(series)

    def beam(item: Series) -> tuple[object, ...]:
        return (item.kV, item.filters, item.current_mA, item.power_W, item.source_detector_mm)

    def amount(item: Series, counted: bool) -> float:
        return float((item.photons_per_pixel if counted else item.exposure_ms) or 0.0)

    def level(item: Series) -> float:
        """Mean of a flat less the dark, DN; 0 where it cannot be told."""
        if item.kind != "flat" or "log" in item.corrected:
            return 0.0
        if "offset" in item.corrected:
            return _mean_DN(item)
        if not darks:
            return 0.0
        return _mean_DN(item) - float(np.interp(item.exposure_ms or 0.0, *np.array(darks).T))

    beams: dict[tuple[object, ...], list[Series]] = {}
    for item in unknown:
        beams.setdefault(beam(item), []).append(item)
    result: dict[str, float] = {}
    for members in beams.values():
        levels = {item.name: found for item in members if (found := level(item)) > 0}
        counted = all((item.photons_per_pixel or 0.0) > 0 for item in members)
        measured = [item for item in members if item.name in levels]
        first = [item for item in measured if item.name in calibrating] or measured
        if not first:
            continue
        weights = np.array([levels[item.name] for item in first])
        rates = weights / [amount(item, counted) for item in first]
        if float(rates.max()) > _ONE_RATE * float(rates.min()):
            result |= levels
            continue
        rate = float(np.sum(weights * rates) / np.sum(weights))
        result |= {item.name: rate * amount(item, counted) for item in members if amount(item, counted) > 0}
    return result


def _on_one_clock(series: Sequence[Series]) -> bool:
    """Whether the times of all series can be of one clock: together they last about as long as each by itself."""
    times = [item.time_s for item in series if item.time_s is not None and len(item.time_s) > 1]
    if len(times) < 2:
        return True
    span = max(float(one[-1]) for one in times) - min(float(one[0]) for one in times)
    return span > _LEAST_SPAN * sum(float(one[-1] - one[0]) for one in times)


def read_session(
    acquisition: AcquisitionFile,
    *,
    calibrated_elsewhere: bool = False,
    exposed: Sequence[Series] = (),
    ends_at_zero: frozenset[str] = frozenset(),
) -> tuple[SessionSeries, ...]:
    """The series of an acquisition in order of time, each with its request to the forward model.

    calibrated_elsewhere: the twin comes from another session, and all series that are not marked as calibrating came after it;
    exposed: further series, of which no more is known than what they left in the panel; ends_at_zero: names of series whose numbers
    go down to 0 and not below.

    Raises:
        InputError: no series that the diagnosis can use.
    """
    ordered = sorted(acquisition.series, key=lambda item: item.index)
    if not ordered:
        raise InputError(f"acquisition {acquisition.path}", received="no series", expected="darks and flats at least")
    elsewhere = calibrated_elsewhere and all(item.role != "calibration" for item in ordered)
    calibrating = frozenset() if elsewhere else calibrating_names(ordered)
    noiseless = frozenset() if calibrated_elsewhere else _noiseless_beams(ordered, calibrating)
    instrument = acquisition.instrument
    levels = measured_levels(ordered)
    clock, one_clock = 0.0, _on_one_clock(ordered)
    result: list[SessionSeries] = []
    requests: list[SeriesRequest] = []
    scenes: dict[str, dict[str, NDArray[np.float32]]] = {}
    lit_too_much = [item for item in exposed if item.setting is not None and item.setting.tube_load_mAs is not None]
    silent = {item.name for item in lit_too_much}
    for item in sorted((*ordered, *lit_too_much), key=lambda item: item.index):
        exposure_ms = item.exposure_ms or 0.0
        times_s = np.zeros(0) if item.time_s is None else item.time_s
        if item.frame_interval_ms is not None:
            interval_ms = item.frame_interval_ms
        elif len(times_s) > 1:
            interval_ms = 1000.0 * float(np.median(np.diff(times_s)))
        else:
            interval_ms = exposure_ms * item.averaged + (instrument.readout_ms or 0.0)
        clocked = len(times_s) > 0 and one_clock
        if clocked:
            start = float(times_s[0])
            clock = float(times_s[-1]) + interval_ms / 1000.0
        else:
            # beam-off frames follow straight after the exposure
            start = clock if item.kind == "afterglow" or not requests else clock + _GAP_S
            clock = start + item.n_frames * interval_ms / 1000.0
        scene = acquisition.scenes.get(item.scene) if item.scene else None
        thickness: dict[str, NDArray[np.float32]] | None = None
        if scene is not None and len(scene.thickness_mm):
            # one mapping a scene: the forward model knows a scene that it has projected by its identity
            if item.scene not in scenes:
                scenes[item.scene] = {material: scene.thickness_mm[material] for material in scene.thickness_mm}
            thickness = scenes[item.scene]
        calibrates = item.name in calibrating
        stated_role = None if elsewhere else item.role
        after = not calibrates if stated_role is None else stated_role != "calibration"
        request = SeriesRequest(
            kind=item.kind,
            setting=item.setting,
            frames=item.n_frames,
            averaged=item.averaged,
            exposure_ms=exposure_ms,
            frame_interval_ms=interval_ms,
            start_s=start,
            index=item.index,
            thickness_mm=thickness,
            scene_kind=None if scene is None else scene.kind,
            source_object_mm=item.source_object_mm or instrument.source_object_mm,
            source_detector_mm=item.source_detector_mm or instrument.source_detector_mm,
            belt_speed_mm_s=item.belt_speed_mm_s,
            belt_axis=instrument.belt_axis or "row",
            panel_rotation_deg=item.panel_rotation_deg,
            after_calibration=after,
            open_signal_DN=levels.get(item.name),
            previous=tuple(requests[-_REMEMBERED:]),
            long_ago=tuple(requests[:-_REMEMBERED]),
            pause_stated=clocked or item.kind == "afterglow",
        )
        requests.append(replace(request, previous=(), long_ago=()))
        if item.name in silent:
            continue
        result.append(
            SessionSeries(
                series=item,
                request=request,
                calibrates=calibrates,
                own_noise=item.kind != "dark" and beam_of(item) in noiseless,
                divided=bool(item.corrected & {"gain", "log"}),
                shares=(shares := holds_shares(item)),
                ends_at_zero=shares or item.name in ends_at_zero,
            )
        )
    return tuple(result)
