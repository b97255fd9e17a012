"""Do the series of a session show what their labels say? `check` tells it, and a diagnosis asks before effects compete.

A dark that is a flat, a flat that is a mean of frames (`beam_checks`), a thickness map of another object (`map_checks`), a kV, filter
or exposure that belongs to another series (`relabelling`): no effect of the forward model is meant to explain these.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.log_images import holds_shares
from ..errors import InputError
from .beam_checks import flats_without_beam, lit_darks, shadows_in_flats, undeclared_means
from .findings import Finding, FindingCode
from .label_model import LabelModel, spectral_model_of
from .map_checks import wrong_maps
from .readings import (
    DARK_SD_DN,
    FRAMES_READ,
    READ_NOISE_SD,
    Dark,
    Explained,
    Reading,
    good_pixels,
    is_top,
    mean_of,
    measure,
    reading_of,
    refuse_fractions,
    relative_gain,
    share_at_the_top,
    silent_darks,
)
from .relabelling import relabelled

_PIXELS = 96  # a side that are looked at
_SATURATED = 0.03  # share of the pixels at the top of the range; bad pixels alone are fewer
_RELEASED_LATER = 0.02  # of the exposures before, which an image lag may leave in the last frames of a lit series
_REMEMBERED = 3  # exposures before


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelCheck:
    """What was found.

    Fields: findings: labels that the frames contradict; unusable: series without any signal or noise, or saturated -> why;
    saturated: names of those that were lit too much; stops: series whose numbers stop at one that others of the session exceed.
    """

    findings: tuple[Finding, ...]
    unusable: Mapping[str, str]
    saturated: frozenset[str] = frozenset()
    stops: tuple[Finding, ...] = ()


def check_labels(
    acquisition: AcquisitionFile,
    *,
    calibrating: frozenset[str],
    dark_DN: Callable[[float | None], NDArray[np.floating]] | None = None,
    explained: Mapping[str, Explained] | None = None,
    progress: Callable[[str], None] | None = None,
) -> LabelCheck:
    """Series of a session that do not show what their labels say.

    Args:
        acquisition: open file.
        calibrating: names of the series that calibrate; effects may have set in after them.
        dark_DN: exposure_ms -> dark frame (row, column) of a twin, for sessions without darks.
        explained: what an explanation does to series, by name; it is taken off them first.
        progress: called with the name of the stage.

    Raises:
        InputError: frames that cannot be read, or that are fractions of something and no detector numbers.
    """
    (progress or (lambda stage: None))("labels")
    stride = max(1, math.ceil(min(acquisition.series[0].shape) / _PIXELS))
    readings, found = _read(acquisition, calibrating, stride)
    for item in readings:
        if explained and item.name in explained:
            item.without(explained[item.name], stride)
    darks = [item for item in readings if item.series.kind == "dark"]
    lit = [item for item in readings if item.series.kind in ("flat", "object")]
    refuse_fractions(lit)
    good = good_pixels(readings)
    shone_on = lit_darks(darks, lit, good, bits=acquisition.instrument.bits)
    known = _Darks(readings=_less(darks, shone_on), twins_DN=dark_DN, good=good, stride=stride)
    dim, judged = flats_without_beam(_measured(lit, known))
    _flatten(judged, good)
    shadowed = shadows_in_flats(judged, known.noise_DN2, good)
    judged = _less(judged, shadowed)
    means = undeclared_means(judged, known.noise_DN2, good)
    judged = _less(judged, means)
    try:
        model = spectral_model_of(acquisition, judged)
    except InputError:
        model = None  # a voltage or material that the spectral model does not reach: said where it belongs
    maps = LabelModel(acquisition, model, stride, good)
    misfits = wrong_maps(judged, maps)
    wrong = (*shone_on, *dim, *shadowed, *means, *misfits, *relabelled(_less(judged, misfits), maps))
    return replace(found, findings=wrong)


def _read(acquisition: AcquisitionFile, calibrating: frozenset[str], stride: int) -> tuple[list[Reading], LabelCheck]:
    """Readings, at every `stride`th pixel and in order of time, and what cannot be used."""
    readings: list[Reading] = []
    unusable: dict[str, str] = {}
    saturated: set[str] = set()
    stops: list[tuple[Series, float]] = []  # lit series without any correction whose numbers pile up at one, and that
    reached: dict[str, float] = {}  # what a share of the numbers of others exceed that bad pixels do not make up
    blank: dict[str, tuple[Reading, float]] = {}  # and the one number that all their pixels have
    for item in acquisition.series:
        if "log" in item.corrected or holds_shares(item):
            continue
        # the last ones: the first may hold what the exposure before has left
        first = max(0, item.n_frames - FRAMES_READ)
        frames = np.asarray(item.read_frames(first, item.n_frames)[:, ::stride, ::stride], dtype=np.float64)
        found = reading_of(item, frames, acquisition, since=item.name not in calibrating)
        full = 0.0 if item.kind in ("dark", "afterglow") else share_at_the_top(frames)
        same = float(np.ptp(frames)) == 0.0
        if (full > _SATURATED or (same and item.kind in ("flat", "object"))) and not item.corrected:
            stops.append((item, float(frames.max())))
        if same:
            blank[item.name] = found, float(frames.flat[0])
        elif full > _SATURATED:
            unusable[item.name] = f"saturated: {100 * full:.0f} % of the pixels stand at {frames.max():.0f} DN"
            saturated.add(item.name)
        else:
            readings.append(found)
            reached[item.name] = float(np.quantile(frames, 1.0 - _SATURATED))
    silent = silent_darks(acquisition, calibrating, blank)
    for name, (found, value_DN) in blank.items():
        top = is_top(value_DN, acquisition.instrument.bits)
        if name in silent and not top:
            readings.append(found)
            continue
        unusable[name] = f"every pixel of every frame is {value_DN:g} DN"
        if top and found.series.kind in ("flat", "object"):
            saturated.add(name)
    readings.sort(key=lambda item: item.series.index)
    early = _stop_early(stops, reached)
    return readings, LabelCheck(findings=(), unusable=unusable, saturated=frozenset(saturated), stops=early)


def _stop_early(stops: Sequence[tuple[Series, float]], reached: Mapping[str, float]) -> tuple[Finding, ...]:
    """Series whose numbers stop at one that another series exceeds, one finding for all that stop at the same.

    A converter ends at one number in all frames: what stops below it was cut off by something else. Numbers of one beam alone may
    also pile up where codes are coarse; where those of two beams stop at the same one, they are cut off.

    Args:
        stops: series and the number at which theirs pile up.
        reached: by name, what a share of the numbers of a series exceed.
    """
    at: dict[float, list[Series]] = {}
    for item, top in stops:
        at.setdefault(top, []).append(item)
    brightest = max(reached, key=lambda name: reached[name], default="")
    found = []
    for top, members in at.items():
        beams = {(one.kV, one.filters, one.exposure_ms, one.current_mA, one.power_W) for one in members}
        if len(beams) > 1 and brightest and top < reached[brightest]:
            first, *others = (one.name for one in members)
            values = {"top": top, "other": brightest, "reached": reached[brightest]}
            found.append(Finding(code=FindingCode.STOPS, series=first, others=tuple(others), values=values))
    return tuple(found)


def _less(readings: Sequence[Reading], findings: Sequence[Finding]) -> list[Reading]:
    """Readings that no finding names."""
    blamed = {name for finding in findings for name in finding.names}
    return [item for item in readings if item.name not in blamed]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Darks:
    """Dark frames of the session, or those of a twin where it has none (as in `check_labels`), at every `stride`th pixel."""

    readings: list[Reading]
    twins_DN: Callable[[float | None], NDArray[np.floating]] | None
    good: NDArray[np.bool_]
    stride: int

    @property
    def noise_DN2(self) -> float:
        """Variance of the quietest."""
        images = [item.variance_DN2 for item in self.readings if item.variance_DN2 is not None]
        return min((mean_of(image, self.good) for image in images), default=0.0)

    def of(self, item: Series) -> Dark | None:
        """Dark of a series: the median of those nearest to its exposure time; None: nothing is known.

        They may be off by how far they differ, and by what darks of a line without fault differ.
        """
        nearest = self._nearest(item)
        known = [one.variance_DN2 for one in nearest if one.variance_DN2 is not None]
        variances_DN2 = [mean_of(image, self.good) for image in known] or [0.0]
        variance_DN2 = float(np.median(variances_DN2))
        levels_DN = [mean_of(one.mean_DN, self.good) for one in nearest] or [0.0]
        if "offset" in item.corrected:
            mean_DN = np.zeros(self.good.shape)
        elif nearest:
            mean_DN = np.median(np.stack([one.mean_DN for one in nearest]), axis=0)
        elif self.twins_DN is not None:
            mean_DN = np.asarray(self.twins_DN(item.exposure_ms), dtype=np.float64)[:: self.stride, :: self.stride]
            if mean_DN.shape != self.good.shape:
                return None
        else:
            return None
        return Dark(
            mean_DN=mean_DN,
            mean_sd_DN=math.hypot(DARK_SD_DN, float(np.std(levels_DN))),
            variance_DN2=variance_DN2,
            variance_sd_DN2=math.hypot(READ_NOISE_SD * variance_DN2, float(np.std(variances_DN2))),
        )

    def _nearest(self, item: Series) -> list[Reading]:
        """Dark series whose exposure time is nearest to that of a series."""
        off = [abs((dark.series.exposure_ms or 0.0) - (item.exposure_ms or 0.0)) for dark in self.readings]
        nearest = min(off, default=0.0) * 1.001 + 1e-9
        return [dark for dark, far in zip(self.readings, off, strict=True) if far <= nearest]


def _measured(lit: Sequence[Reading], darks: _Darks) -> list[Reading]:
    """Lit series that a dark can be taken off, with level, noise and picture, and what lag may have released in them."""
    judged = [item for item in lit if measure(item, darks.of(item.series), darks.good)]
    for reading in judged:
        before = [one.level_DN for one in judged if one.series.index < reading.series.index][-_REMEMBERED:]
        reading.released = _RELEASED_LATER * max(before, default=0.0) / max(reading.level_DN, 1e-9)
    return judged


def _flatten(judged: Sequence[Reading], good: NDArray[np.bool_]) -> None:
    """Divide pictures by the shape of the flats, where that has not been done."""
    relative = relative_gain([item for item in judged if item.series.kind == "flat"], good)
    for reading in judged:
        if reading.picture is not None and "gain" not in reading.series.corrected:
            reading.picture = reading.picture / relative
