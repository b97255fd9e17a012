"""What series serve for as they stand, what can be learnt from them, and what to measure next."""

from collections.abc import Sequence
from typing import Any

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.pairs import object_pairs
from ..acquisition.scenes import Scene
from ..acquisition.setting import text_from_filters
from ..errors import InputError
from ..results import counted
from .check_result import Allowed, SeriesRow
from .findings import Finding, FindingCode

DARK_LEVEL, READ_NOISE, LEVEL, NOISE, SPECTRUM = "dark level", "read noise", "level", "gain and blur", "spectrum"
LAG, IMAGES, VALIDATION, ATTENUATION = "lag", "reference images", "validation", "attenuation and scatter"
# what can be learnt from series that serve for it
OF_DARKS, OF_READ_NOISE, OF_NOISE = "dark level", "read noise", "gain, blur and photons a pixel"
OF_LOADS, OF_BEAMS, OF_OUTPUT = "linearity", "spectrum: other kV and filters", "output of the tube, dose"
OF_OTHERS = "validation on flats that calibration has not seen"
# frames of one value, and frames that are no detector numbers, have no pattern to compare
NO_PATTERN = frozenset({FindingCode.CONSTANT, FindingCode.LOGARITHMS, FindingCode.SATURATED})
UNFIT = NO_PATTERN | {
    FindingCode.SCENE_CHANGES,
    FindingCode.NO_LIGHT,
    FindingCode.DARK_WITH_LIGHT,
    FindingCode.SHADOW,
    FindingCode.DAMAGED,
    FindingCode.COMPRESSED,
    FindingCode.SAME_AS,
    FindingCode.SHAPES,
    FindingCode.SMALL,
}
_LABELS = frozenset({FindingCode.LOAD_LABEL, FindingCode.LABEL})


def _setting_text(item: Series) -> str:
    words = []
    if item.kV is not None:
        words.append(f"{item.kV:g} kV")
    if item.power_W is not None:
        words.append(f"{item.power_W:g} W")
    elif item.current_mA is not None:
        words.append(f"{item.current_mA:g} mA")
    if item.exposure_ms is not None:
        words.append(f"{item.exposure_ms:g} ms")
    if item.filters:
        words.append(text_from_filters(item.filters))
    if item.averaged != 1:
        words.append(f"mean of {item.averaged}")
    if item.photons_per_pixel is not None:
        words.append(f"{item.photons_per_pixel:.4g} photons")
    if item.scene:
        words.append(f"scene {item.scene}")
    return ", ".join(words)


def series_row(
    item: Series,
    findings: Sequence[Finding],
    *,
    scene: Scene | None,
    level_DN: float | None,
    noise_DN: float | None,
) -> SeriesRow:
    """One series in the table of a check; scene: that it shows, None: none is described; level_DN: None: it was not read."""
    codes = {entry.code for entry in findings if item.name in entry.names}
    return SeriesRow(
        name=item.name,
        kind=item.kind,
        setting=_setting_text(item),
        frames=item.n_frames,
        averaged=item.averaged,
        shape=item.shape,
        level_DN=level_DN,
        noise_DN=noise_DN,
        serves_for=() if level_DN is None else _serves(item, codes, scene),
    )


def _serves(item: Series, codes: set[FindingCode], scene: Scene | None) -> tuple[str, ...]:
    """What a series is good for, as it stands."""
    if codes & (UNFIT - {FindingCode.SCENE_CHANGES}):
        return ()
    serves = []
    repeats = item.n_frames > 1 and FindingCode.SCENE_CHANGES not in codes
    if item.kind == "dark":
        if "offset" not in item.corrected:
            serves.append(DARK_LEVEL)
        if repeats and FindingCode.CLIPPED not in codes:
            serves.append(READ_NOISE)
    elif item.kind == "flat":
        if not item.corrected & {"gain", "log"} and FindingCode.SCENE_CHANGES not in codes:
            serves.append(LEVEL)
            if repeats:
                serves.append(NOISE)
            loaded = item.current_mA is not None or item.power_W is not None
            if item.kV is not None and loaded and item.exposure_ms and not codes & _LABELS:
                serves.append(SPECTRUM)
        if item.role == "evaluation":
            serves = [VALIDATION] if serves else []
    elif item.kind == "object":
        if _is_product(scene):
            serves.append(IMAGES)
        if scene is not None and scene.thickness_mm:
            serves.append(ATTENUATION)
    elif item.kind == "afterglow":
        serves.append(LAG)
    return tuple(serves)


def allowed_by(acquisition: AcquisitionFile, rows: Sequence[SeriesRow]) -> tuple[Allowed, ...]:
    """What can be learnt from the series as they stand."""
    series = _Serving(acquisition, rows)
    return (
        _dark_level(series),
        _read_noise(series),
        _gain_and_blur(series),
        _linearity(series),
        _spectrum(series),
        _output(series),
        _validation(series),
        _attenuation(series),
        _reference_images(series),
        _lag(series),
    )


class _Serving:
    """The series of an acquisition by what they serve for."""

    def __init__(self, acquisition: AcquisitionFile, rows: Sequence[SeriesRow]) -> None:
        self.acquisition, self._rows = acquisition, rows
        self._series = {item.name: item for item in acquisition.series}

    def rows(self, purpose: str) -> list[SeriesRow]:
        return [row for row in self._rows if purpose in row.serves_for]

    def series(self, purpose: str) -> list[Series]:
        return [self._series[row.name] for row in self.rows(purpose)]

    def names(self, purpose: str) -> str:
        """Names of the series that serve for something, in words; empty where none does."""
        return _names([row.name for row in self.rows(purpose)])


def _names(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _dark_level(series: _Serving) -> Allowed:
    darks = series.names(DARK_LEVEL)
    if darks:
        return Allowed(what=OF_DARKS, possible=True, why=darks)
    if series.acquisition.instrument.counting:
        return Allowed(what=OF_DARKS, possible=True, why="0, of a detector that counts photons")
    done = any("offset" in item.corrected for item in series.acquisition.of_kind("flat"))
    return Allowed(what=OF_DARKS, possible=done, why="the frames are offset-corrected" if done else "no dark series")


def _read_noise(series: _Serving) -> Allowed:
    quiet = series.names(READ_NOISE)
    return Allowed(what=OF_READ_NOISE, possible=bool(quiet), why=quiet or "no dark series of two or more raw frames")


def _gain_and_blur(series: _Serving) -> Allowed:
    noisy = series.names(NOISE)
    if noisy:
        return Allowed(what=OF_NOISE, possible=True, why=noisy)
    pair = _averaged_pairs([item for item in series.series(LEVEL) if item.n_frames == 1])
    if pair is not None:
        return Allowed(what=OF_NOISE, possible=True, why=f"the difference of {pair[0]} and {pair[1]}")
    return Allowed(what=OF_NOISE, possible=False, why="no flat series of two or more raw frames of one scene")


def _linearity(series: _Serving) -> Allowed:
    loads = max(
        (
            len({(item.current_mA, item.power_W, item.exposure_ms, item.photons_per_pixel) for item in group})
            for group in _grouped(series.series(LEVEL))
        ),
        default=0,
    )
    why = f"{loads} loads at one beam" if loads > 2 else "three or more loads at one beam are needed"
    return Allowed(what=OF_LOADS, possible=loads > 2, why=why)


def _spectrum(series: _Serving) -> Allowed:
    beams = {(item.kV, text_from_filters(item.filters)) for item in series.series(SPECTRUM)}
    if not beams:
        why = "flats need kV, current or power, and an exposure time"
        return Allowed(what=OF_BEAMS, possible=False, why=why)
    named = "; ".join(f"{kV:g} kV {layers}".strip() for kV, layers in sorted(beams)[:4])
    return Allowed(what=OF_BEAMS, possible=True, why=f"{counted(len(beams), 'beam')}: {named}")


def _output(series: _Serving) -> Allowed:
    instrument, spectral = series.acquisition.instrument, series.series(SPECTRUM)
    distance = instrument.source_detector_mm is not None or any(item.source_detector_mm for item in spectral)
    known = bool(spectral) and distance and instrument.pixel_mm is not None
    why = (
        "kV, load, pixel size and distance are known"
        if known
        else "needs kV, load, pixel size and source-detector distance"
    )
    return Allowed(what=OF_OUTPUT, possible=known, why=why)


def _validation(series: _Serving) -> Allowed:
    evaluated = series.names(VALIDATION)
    return Allowed(what=OF_OTHERS, possible=bool(evaluated), why=evaluated or 'no flat with role = "evaluation"')


def _attenuation(series: _Serving) -> Allowed:
    known = series.names(ATTENUATION)
    return Allowed(what=ATTENUATION, possible=bool(known), why=known or "no object of known thickness")


def _reference_images(series: _Serving) -> Allowed:
    scenes = series.acquisition.scenes
    try:
        pairs = sum(_is_product(scenes.get(pair.scene)) for pair in object_pairs(series.acquisition))
    except InputError:
        pairs = 0
    why = counted(pairs, "pair") if pairs else "no product measured at two tube voltages with a `scene`"
    return Allowed(what="reference images for two energies", possible=bool(pairs), why=why)


def _is_product(scene: Scene | None) -> bool:
    """Whether images of a scene are those of a product: it is described as one, or as nothing."""
    return scene is None or scene.kind in ("", "product")


def _lag(series: _Serving) -> Allowed:
    afterglow = series.names(LAG)
    why = afterglow or "no afterglow series (beam off straight after exposure)"
    return Allowed(what="lag", possible=bool(afterglow), why=why)


def _grouped(flats: Sequence[Series]) -> list[list[Series]]:
    groups: dict[Any, list[Series]] = {}
    for item in flats:
        groups.setdefault((item.kV, text_from_filters(item.filters)), []).append(item)
    return list(groups.values())


def _averaged_pairs(flats: Sequence[Series]) -> tuple[str, str] | None:
    """Two single flats of one beam and load: their difference holds noise."""
    seen: dict[Any, str] = {}
    for item in flats:
        if item.corrected & {"gain", "log"}:
            continue
        key = (item.kV, text_from_filters(item.filters), item.current_mA, item.power_W, item.exposure_ms)
        if key in seen:
            return seen[key], item.name
        seen[key] = item.name
    return None


def next_measurements(
    acquisition: AcquisitionFile, rows: Sequence[SeriesRow], allows: Sequence[Allowed]
) -> tuple[str, ...]:
    """What would be worth measuring or writing down next, most useful first."""
    possible = {item.what: item.possible for item in allows}
    told = []
    if not possible[OF_DARKS]:
        told.append("20 darks at each exposure time (beam off)")
    elif not possible[OF_READ_NOISE] and not acquisition.instrument.counting:
        told.append("20 raw darks at one exposure time, each kept by itself")
    if not possible[OF_NOISE]:
        told.append("20 raw flats at each of five currents or exposures, each frame kept by itself")
    elif not possible[OF_LOADS]:
        told.append("flats at five exposures of one beam, from a tenth to nine tenths of full scale")
    if not possible[OF_BEAMS]:
        told.append("write down kV, mA (or W) and exposure of every flat")
    else:
        spectral = [row for row in rows if SPECTRUM in row.serves_for]
        voltages = {item.kV for item in acquisition.series for row in spectral if row.name == item.name}
        filters = {
            text_from_filters(item.filters) for item in acquisition.series for row in spectral if row.name == item.name
        }
        if len(voltages) < 2:
            told.append("flats at a second tube voltage, as far from the first as the line goes")
        if len(filters) < 2:
            told.append("the same flats behind a known filter (0.1 mm Cu or 2 mm Al)")
        if len(voltages) == 2:
            told.append("flats at a third tube voltage: two do not tell what lies beyond them")
        if not possible[OF_OUTPUT]:
            told.append("write down pixel size and source-detector distance")
    if not possible[OF_OTHERS] and possible[OF_NOISE]:
        told.append('a flat at another setting with role = "evaluation", to test the twin on')
    return tuple(told)
