"""What happens to a session before its gap is looked for: series that cannot be used, labels that frames contradict, the twin."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.binned_frames import binned
from ...acquisition.cut_off import share_of_zeros, without_cut_off_darks
from ...acquisition.series_roles import calibrating_names, commonest_shape
from ...calibration.calibrate import calibrate_twin
from ...calibration.flats.repeated_frames import beam_of
from ...checks.findings import Finding, FindingCode
from ...checks.labels import LabelCheck, check_labels
from ...checks.readings import Explained
from ...errors import FitError, InputError, RaytwinError
from ...generator.effects import EFFECTS
from ...generator.line.twin import Twin
from ..arrays import FloatArray
from .binned_twin import binned_twin
from .binning import LEAST_SIDE, bin_factor, lost_by_binning
from .origin import made_of

_OF_THIS_SESSION = (
    "the twin was calibrated from series of this session: the first of each kind and setting, or those whose role says so, count"
    " as its calibration, and the others are compared with it"
)
_CONTRADICTED = "its frames contradict what it states"


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedSession:
    """A session ready for its diagnosis."""

    acquisition: AcquisitionFile  # less the series that cannot be used
    exposed: tuple[Series, ...]  # of these, lit ones: what they left in the panel is known
    twin: Twin
    calibrated_elsewhere: bool  # the twin was given, and none of these series is in it
    contradicted: tuple[Finding, ...]  # labels that frames contradict, whose series are left out
    findings: tuple[Finding, ...]  # labels that frames contradict, whose series are not
    other_findings: tuple[Finding, ...]  # numbers that stop early, flats that fit no spectrum
    left_out: tuple[str, ...]  # series that are not used, each with the reason
    notes: tuple[str, ...]  # how the session is looked at, and what calibration took in
    factor: int  # pixels along each side of a bin
    all_pixels: AcquisitionFile  # the same series with all pixels
    ends_at_zero: frozenset[str]  # names of lit series whose numbers go down to 0 and not below
    # (parameter,): where the twin's spectral nuisances are taken as linear; None: at its best parameters
    spectral_point: FloatArray | None

    @property
    def lost(self) -> dict[str, str]:
        """Why effects cannot be seen in its squares of pixels, by id."""
        return lost_by_binning() if self.factor > 1 else {}

    @property
    def out_of_question(self) -> tuple[str, ...]:
        """Ids of effects that are not tried: lost ones, and those of photon counters where the instrument says that it is none."""
        counts_none = self.twin.instrument.counting is False
        return (*self.lost, *(effect.id for effect in EFFECTS.values() if counts_none and "counting" in effect.needs))


def calibrated_twin(
    acquisition: AcquisitionFile, *, rng: np.random.Generator, progress: Callable[[str], None] | None = None
) -> Twin:
    """The twin from the series that calibrate (see `calibrating_names`); single-frame flats have their noise from the rest."""
    names = calibrating_names(acquisition.series)
    part = replace(acquisition, series=tuple(item for item in acquisition.series if item.name in names))
    rest = tuple(item for item in acquisition.series if item.name not in names)
    return calibrate_twin(part, rng=rng, progress=progress, repeated=rest)


def prepare_session(
    acquisition: AcquisitionFile,
    *,
    twin: Twin | None,
    rng: np.random.Generator,
    contradicted: tuple[Finding, ...] = (),
    progress: Callable[[str], None] | None = None,
) -> PreparedSession:
    """Check a session's labels, take out what cannot be used, and calibrate its twin where none was given.

    Frames of more than LARGEST_PIXELS are binned, and a given twin with them. Where series whose labels are contradicted cannot
    calibrate, they are left out. twin: calibrated elsewhere; contradicted: labels whose series are left out.

    Raises:
        InputError: nothing can be calibrated or compared; the message says what is missing and what would do.
    """
    tell = progress or (lambda stage: None)
    measured, given = acquisition, twin
    all_pixels, left_out = _of_one_shape(acquisition, twin)
    all_pixels, cut_off = without_cut_off_darks(all_pixels)
    left_out += cut_off
    wrong = {name for item in contradicted for name in item.names}
    left_out += [f"{item.name}: {_CONTRADICTED}" for item in all_pixels.series if item.name in wrong]
    every = all_pixels.series
    all_pixels = replace(all_pixels, series=tuple(item for item in every if item.name not in wrong))
    if not all_pixels.series:
        raise _nothing_left(acquisition, left_out, contradicted)
    factor = bin_factor(all_pixels.series[0].shape)
    twin = None if twin is None else binned_twin(twin, factor)
    acquisition = binned(all_pixels, factor)
    found = _checked_labels(acquisition, twin, progress=progress)
    left_out += [f"{name}: {reason}" for name, reason in found.unusable.items()]
    kept = tuple(item for item in acquisition.series if item.name not in found.unusable)
    if not kept:
        raise _nothing_left(acquisition, left_out, contradicted)
    exposed = tuple(
        item
        for item in every
        if item.name in found.saturated or (item.name in wrong and item.kind in ("flat", "object"))
    )
    acquisition = replace(acquisition, series=kept)
    elsewhere = twin is not None and not made_of(twin, kept)
    notes: tuple[str, ...] = () if elsewhere or twin is None else (_OF_THIS_SESSION,)
    other_findings = found.stops
    if twin is None:
        tell("calibration")
        try:
            twin = calibrated_twin(acquisition, rng=rng, progress=progress)
        except (InputError, FitError) as error:
            if found.findings:
                wrong_labels = (*contradicted, *found.findings)
                return prepare_session(measured, twin=given, rng=rng, contradicted=wrong_labels, progress=progress)
            raise _not_calibrated(acquisition, contradicted, left_out, error) from error
        other_findings += _without_spectrum(acquisition, twin)
        notes += _taken_in(twin, factor)
    return PreparedSession(
        acquisition=acquisition,
        exposed=exposed,
        twin=twin,
        calibrated_elsewhere=elsewhere,
        contradicted=contradicted,
        findings=found.findings,
        other_findings=other_findings,
        left_out=tuple(left_out),
        notes=notes,
        factor=factor,
        ends_at_zero=frozenset(
            item.name for item in all_pixels.series if item.kind in ("flat", "object") and share_of_zeros(item) > 0.0
        ),
        spectral_point=_spectral_point(acquisition, twin, rng=rng, progress=progress),
        all_pixels=replace(
            all_pixels, series=tuple(item for item in all_pixels.series if item.name not in found.unusable)
        ),
    )


def _taken_in(twin: Twin, factor: int) -> tuple[str, ...]:
    """What calibration took in that the catalogue has as an effect: a tail whose interval does not go down to none."""
    spread = twin.noise.spread
    known = spread.intervals.get("tail_share")
    if spread.value.tail_share == 0.0 or (known is not None and known.low <= 0.0):
        return ()
    within = "" if known is None else f" (95 %: {100.0 * known.low:.2g} to {100.0 * known.high:.2g})"
    light, reach_px = 100.0 * spread.value.tail_share, factor * spread.value.tail_px
    return (
        f"calibration found {light:.2g} %{within} of the light in a tail with a reach of some {reach_px:.2g} px; the twin has it,"
        " so that it is no gap",
    )


def _checked_labels(
    acquisition: AcquisitionFile,
    twin: Twin | None,
    *,
    explained: Mapping[str, Explained] | None = None,
    progress: Callable[[str], None] | None = None,
) -> LabelCheck:
    """Labels of a session's series; twin: one from elsewhere, whose darks stand in for those that are not there."""
    return check_labels(
        acquisition,
        calibrating=calibrating_names(acquisition.series),
        dark_DN=None if twin is None else twin.maps.dark_at,
        explained=explained,
        progress=progress,
    )


def findings_left(session: PreparedSession, explained: Mapping[str, Explained]) -> tuple[Finding, ...]:
    """The session's findings on labels that stand once what an explanation does is subtracted from the frames."""
    given = session.twin if session.calibrated_elsewhere else None
    again = _checked_labels(session.acquisition, given, explained=explained).findings
    blamed = {name for item in again for name in item.names}
    return tuple(item for item in session.findings if not blamed.isdisjoint(item.names))


def _spectral_point(
    acquisition: AcquisitionFile, twin: Twin, *, rng: np.random.Generator, progress: Callable[[str], None] | None
) -> FloatArray | None:
    """The twin's spectral parameters (parameter,) as the session's flats show them, each beam's later ones; None: it knows all beams.

    What beams that did not calibrate show lies far along the spectrum's nuisances, where straight lines do not reach.
    """
    calibrating = calibrating_names(acquisition.series)
    flats = [
        item
        for item in acquisition.of_kind("flat")
        if item.setting is not None and not item.corrected & {"log", "gain"} and item.panel_rotation_deg % 360.0 == 0.0
    ]
    if twin.spectral is None or all(item.setting is None or twin.level_at(item.setting) for item in flats):
        return None
    later = {beam_of(item) for item in flats if item.name not in calibrating}
    chosen = {item.name for item in flats if item.name not in calibrating or beam_of(item) not in later}
    chosen |= {item.name for item in acquisition.of_kind("dark")}
    series = tuple(
        replace(item, role="calibration" if item.name in chosen else "evaluation") for item in acquisition.series
    )
    try:
        found = calibrated_twin(replace(acquisition, series=series), rng=rng, progress=progress).spectral
    except (InputError, FitError):
        return None  # then the calibrated point has to do
    if found is None:
        return None
    values = dict(zip(found.names, map(float, found.best), strict=True))
    best = zip(twin.spectral.names, map(float, twin.spectral.best), strict=True)
    return np.array([values.get(name, value) for name, value in best])


def mislabelled(acquisition: AcquisitionFile, contradicted: Sequence[Finding]) -> InputError:
    """The error for a session that cannot be worked with because of its labels."""
    return InputError(
        f"acquisition {acquisition.path}",
        received="; ".join(item.line for item in contradicted),
        expected="labels that the frames agree with",
        remedy="correct the labels of these series, or leave them out",
    )


def _without_spectrum(acquisition: AcquisitionFile, twin: Twin) -> tuple[Finding, ...]:
    """Flats that state kV and tube load, and yet fit no spectrum."""
    names = calibrating_names(acquisition.series)
    stated = [
        item.name
        for item in acquisition.of_kind("flat")
        if item.name in names and item.setting is not None and item.setting.tube_load_mAs is not None
    ]
    if twin.spectral is not None or not stated:
        return ()
    because = twin.evidence.get("no_spectrum")
    reason = "no spectral part" if because is None else f"no spectral part: {because}"
    first, *others = stated
    return (Finding(code=FindingCode.SPECTRUM, series=first, others=tuple(others), values={"what": reason}),)


def _of_one_shape(acquisition: AcquisitionFile, twin: Twin | None) -> tuple[AcquisitionFile, list[str]]:
    """The series whose frames have the twin's shape, or the commonest one; and which were left out."""
    commonest = commonest_shape(acquisition.series)
    if commonest is None:
        raise InputError(f"acquisition {acquisition.path}", received="no series", expected="darks and flats at least")
    shape = commonest if twin is None else twin.maps.shape
    if all(item.shape != shape for item in acquisition.series):
        rows, columns = commonest
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"frames of {rows} x {columns}",
            expected=f"the twin's detector of {shape[0]} x {shape[1]}",
            remedy="diagnose sessions of the detector that the twin was calibrated from, or leave --twin out",
        )
    other = None if twin is None else twin.instrument.unlike(acquisition.instrument)
    if other is not None:
        raise InputError(
            f"acquisition {acquisition.path}",
            received=other[0],
            expected=f"the twin's: {other[1]}",
            remedy="diagnose sessions of the line that the twin was calibrated from, or leave --twin out",
        )
    if min(shape) < LEAST_SIDE:
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"frames of {shape[0]} x {shape[1]}",
            expected=f"at least {LEAST_SIDE} rows and columns",
            remedy="put the lines of a line detector together to pictures",
        )
    left_out = [
        f"{item.name}: frames of {item.shape[0]} x {item.shape[1]}, not {shape[0]} x {shape[1]}"
        for item in acquisition.series
        if item.shape != shape
    ]
    kept = tuple(item for item in acquisition.series if item.shape == shape)
    return replace(acquisition, series=kept), left_out


def _nothing_left(acquisition: AcquisitionFile, left_out: Sequence[str], contradicted: Sequence[Finding]) -> InputError:
    if contradicted:
        return mislabelled(acquisition, contradicted)
    return InputError(
        f"acquisition {acquisition.path}", received="; ".join(left_out), expected="series with light and noise"
    )


def _not_calibrated(
    acquisition: AcquisitionFile, contradicted: Sequence[Finding], left_out: Sequence[str], error: RaytwinError
) -> InputError:
    """Why a session cannot calibrate its own twin, and what could be said with one from elsewhere."""
    if contradicted:
        return mislabelled(acquisition, contradicted)
    counted = Counter(item.kind for item in acquisition.series)
    several = sum(item.n_frames > 1 for item in acquisition.series)
    have = ", ".join(f"{number} {kind}" for kind, number in counted.items())
    remedy = (
        f"or give --twin, calibrated from another session of this line: with it this session ({have} series,"
        f" {several} of them of two frames or more) can be compared as far as it goes"
    )
    others = f" and {len(left_out) - 1} more" if len(left_out) > 1 else ""
    without = f" (not used: {left_out[0]}{others})" if left_out else ""
    if isinstance(error, InputError):
        return InputError(
            error.argument,
            received=f"{error.received}{without}",
            expected=error.expected,
            remedy=f"{error.remedy}; {remedy}" if error.remedy else remedy,
        )
    return InputError(
        f"acquisition {acquisition.path}",
        received=f"{error}{without}",
        expected="flats and darks that calibrate a twin",
        remedy=remedy,
    )
