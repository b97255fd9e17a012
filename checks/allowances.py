"""What series serve for as they stand, what can be learnt from them, and what to measure next."""

from collections.abc import Sequence
from typing import Any

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.pairs import object_pairs
from ..acquisition.setting import text_from_filters
from ..errors import InputError
from ..results import counted
from .check_result import Allowed, SeriesRow
from .findings import Finding, FindingCode

DARK_LEVEL, READ_NOISE, LEVEL, NOISE, SPECTRUM = "dark level", "read noise", "level", "gain and blur", "spectrum"
LAG, IMAGES, WEDGE, VALIDATION = "lag", "reference images", "attenuation", "validation"
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
    item: Series, findings: Sequence[Finding], *, level_DN: float | None, noise_DN: float | None
) -> SeriesRow:
    """One series in the table of a check; level_DN: None: it was not read."""
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
        serves_for=() if level_DN is None else _serves(item, codes),
    )


def _serves(item: Series, codes: set[FindingCode]) -> tuple[str, ...]:
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
        serves.append(IMAGES)
    elif item.kind == "afterglow":
        serves.append(LAG)
    return tuple(serves)


def allowed_by(
    acquisition: AcquisitionFile, rows: Sequence[SeriesRow], findings: Sequence[Finding]
) -> tuple[Allowed, ...]:
    """What can be learnt from the series as they stand."""
    by_name = {item.name: item for item in acquisition.series}
    instrument = acquisition.instrument

    def serving(purpose: str) -> list[SeriesRow]:
        return [row for row in rows if purpose in row.serves_for]

    def names(found: Sequence[SeriesRow]) -> str:
        told = ", ".join(row.name for row in found[:3])
        return told + (f" and {len(found) - 3} more" if len(found) > 3 else "")

    result = []

    def add(what: str, possible: bool, why: str) -> None:
        result.append(Allowed(what=what, possible=possible, why=why))

    darks, quiet = serving(DARK_LEVEL), serving(READ_NOISE)
    offset_done = any("offset" in item.corrected for item in acquisition.of_kind("flat"))
    if darks:
        add("dark level", True, names(darks))
    elif instrument.counting:
        add("dark level", True, "0, of a detector that counts photons")
    else:
        add("dark level", offset_done, "the frames are offset-corrected" if offset_done else "no dark series")
    add("read noise", bool(quiet), names(quiet) or "no dark series of two or more raw frames")
    noisy, lit = serving(NOISE), serving(LEVEL)
    pairs = _averaged_pairs([by_name[row.name] for row in lit if row.frames == 1])
    add(
        "gain, blur and photons a pixel",
        bool(noisy) or bool(pairs),
        names(noisy)
        or (
            f"the difference of {pairs[0]} and {pairs[1]}"
            if pairs
            else "no flat series of two or more raw frames of one scene"
        ),
    )
    spectral = [by_name[row.name] for row in serving(SPECTRUM)]
    beams = {(item.kV, text_from_filters(item.filters)) for item in spectral}
    loads = max(
        (
            len({(item.current_mA, item.power_W, item.exposure_ms, item.photons_per_pixel) for item in group})
            for group in _grouped([by_name[row.name] for row in lit])
        ),
        default=0,
    )
    add(
        "linearity",
        loads > 2,
        f"{loads} loads at one beam" if loads > 2 else "three or more loads at one beam are needed",
    )
    add(
        "spectrum: other kV and filters",
        bool(spectral),
        f"{len(beams)} beam{'s' * (len(beams) != 1)}: "
        + "; ".join(f"{kV:g} kV {layers}".strip() for kV, layers in sorted(beams)[:4])
        if spectral
        else "flats need kV, current or power, and an exposure time",
    )
    distance = instrument.source_detector_mm is not None or any(item.source_detector_mm for item in spectral)
    absolute = bool(spectral) and distance and instrument.pixel_mm is not None
    add(
        "output of the tube, dose",
        absolute,
        "kV, load, pixel size and distance are known"
        if absolute
        else "needs kV, load, pixel size and source-detector distance",
    )
    evaluated = serving(VALIDATION)
    add(
        "validation on flats that calibration has not seen",
        bool(evaluated),
        names(evaluated) or 'no flat with role = "evaluation"',
    )
    known = [item for item in acquisition.of_kind("object") if _has_thickness(acquisition, item)]
    add(
        "attenuation and scatter",
        bool(known),
        names([row for row in rows if row.name in {item.name for item in known}]) or "no object of known thickness",
    )
    try:
        images = object_pairs(acquisition)
    except InputError:
        images = ()
    add(
        "reference images for two energies",
        bool(images),
        counted(len(images), "pair") if images else "no object measured at two tube voltages with a `scene`",
    )
    afterglow = serving(LAG)
    add("lag", bool(afterglow), names(afterglow) or "no afterglow series (beam off straight after exposure)")
    return tuple(result)


def _has_thickness(acquisition: AcquisitionFile, item: Series) -> bool:
    scene = acquisition.scenes.get(item.scene)
    return scene is not None and len(scene.thickness_mm) > 0


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
    if not possible["dark level"]:
        told.append("20 darks at each exposure time (beam off)")
    elif not possible["read noise"] and not acquisition.instrument.counting:
        told.append("20 raw darks at one exposure time, each kept by itself")
    if not possible["gain, blur and photons a pixel"]:
        told.append("20 raw flats at each of five currents or exposures, each frame kept by itself")
    elif not possible["linearity"]:
        told.append("flats at five exposures of one beam, from a tenth to nine tenths of full scale")
    if not possible["spectrum: other kV and filters"]:
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
        if not possible["output of the tube, dose"]:
            told.append("write down pixel size and source-detector distance")
    if not possible["validation on flats that calibration has not seen"] and possible["gain, blur and photons a pixel"]:
        told.append('a flat at another setting with role = "evaluation", to test the twin on')
    return tuple(told)
