"""The twin of a line: calibrated from measured series, read from a file, asked for flatfields, compared with measured ones."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ._given import PathLike, as_any_twin, as_twin, distinct_sha256, generator_of, opened, seed_number
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import numpy as np

    from ..acquisition.acquisition_io import AcquisitionFile
    from ..acquisition.instrument import Instrument
    from ..acquisition.setting import Setting
    from ..calibration.spectrum.output_table import OutputTable
    from ..calibration.spectrum.transmission_table import TransmissionTable
    from ..calibration.validate import Validation
    from ..generator.line.twin import Twin
    from ..generator.predictions.predict import Prediction, Predictions
    from ..generator.predictions.tube_twin import TubePrediction, TubeTwin
    from ..spectra import Spectrum

    Sessions = AcquisitionFile | PathLike | Sequence[AcquisitionFile | PathLike]


def read_twin(twin: "Twin | TubeTwin | PathLike") -> "Twin | TubeTwin":
    """A twin from its file (of a line or of a tube alone), or from the name of a shipped calibration (`virtual_lab`).

    Raises:
        FileFormatError: no such file, not a twin, damaged.

    Example:
        >>> twin = rt.read_twin("twin.h5")
        >>> twin.maps.shape
        (64, 64)
    """
    return as_any_twin(twin)


def open_acquisition(path: PathLike) -> "AcquisitionFile":
    """An acquisition file, open for reading; use it in a `with` block. Frames stay in the file until they are read.

    Args:
        path: of the file.

    Returns:
        Instrument, scenes and series; each series has its setting, and methods that read its frames (frame, row, column), DN.

    Raises:
        FileFormatError: no such file, not an acquisition, damaged; the message says where.

    Example:
        >>> with rt.open_acquisition("session.h5") as session:
        ...     kinds = {series.kind for series in session.series}
        >>> sorted(kinds)
        ['dark', 'flat']
    """
    from ..acquisition.acquisition_io import open_acquisition as open_file

    return open_file(path)


def calibrate(
    acquisition: "Sessions | None" = None,
    *,
    output_table: PathLike | None = None,
    transmission: PathLike | None = None,
    instrument: "Instrument | None" = None,
    spectra: "Mapping[float, PathLike] | Sequence[Spectrum]" = (),
    estimator: str = "pairs",
    layer: str | None = None,
    seed: "int | np.random.Generator" = 0,
    progress: Progress | bool | None = None,
) -> "Twin | TubeTwin":
    """A twin from measured flat and dark series, from what a dosimeter read, or from both.

    Works from any subset: without kV or instrument the twin has gain, noise and blur but no spectral part, and its warnings
    say so. Series whose role is `evaluation` are not looked at.

    Args:
        acquisition: a file, an open one, or several that are sessions of one line, each with its own darks; None: the tables
            calibrate the tube alone.
        output_table: what a dosimeter read (CSV, docs/dosimeter.md).
        transmission: what an absorber let through (CSV, docs/dosimeter.md).
        instrument: anode, angle and declared layers of a tube alone, a `raytwin.acquisition.instrument.Instrument`; None: W, 12
            degrees, none.
        spectra: measured spectra of the tube in place of the model's: kV -> file of two columns (keV, fluence per keV).
        estimator: variances from `pairs` of successive frames, or from the `stack` about its mean.
        layer: `front` or `back` of a dual-layer panel; None: front.
        seed: a whole number or a generator, of the posterior's draws.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        The twin; `repr` is a short table, `save` writes it, `predict` asks it.

    Raises:
        InputError, FileFormatError: nothing can be calibrated, or a file is no acquisition; the message says what is missing.

    Example:
        >>> twin = rt.calibrate("session.h5", seed=0)
        >>> twin.dark_DN.low < twin.dark_DN.value < twin.dark_DN.high
        True
    """
    from .. import __version__
    from ..acquisition.sessions import merge_sessions, one_layer
    from ..calibration.calibrate import calibrate_twin
    from ..calibration.spectrum.tube import calibrate_tube
    from ..files import sha256_of_file
    from ..spectra import spectrum_from_file

    if isinstance(spectra, Mapping):
        measured = [spectrum_from_file(path, kV=float(kV)) for kV, path in spectra.items()]
    else:
        measured = list(spectra)
    number = seed_number(seed)
    provenance = {"raytwin_version": __version__, "seed": "a generator" if number is None else number}
    for name, path in (("output_table", output_table), ("transmission", transmission)):
        if path is not None:
            with suppress(OSError):  # the table's reader says what is wrong with such a file
                provenance[f"{name}_sha256"] = sha256_of_file(path)
    if acquisition is None:
        if output_table is None and transmission is None:
            raise InputError(
                "acquisition",
                received="nothing",
                expected="an acquisition with flats and darks",
                remedy="or a dose table (output_table) for a tube alone",
            )
        if measured or layer is not None:
            raise InputError(
                "spectra" if measured else "layer", received="no acquisition", expected="an acquisition file too"
            )
        output, absorbed = _tables(output_table, transmission, instrument, has_detector=False)
        with Telling(progress) as telling:
            return calibrate_tube(
                rng=generator_of(seed),
                output=output,
                transmission=absorbed,
                instrument=instrument,
                progress=telling.stage,
                provenance=provenance,
            )
    if instrument is not None:
        raise InputError(
            "instrument", received="an acquisition too", expected="one statement of the tube: the acquisition's"
        )
    with opened(acquisition) as files, Telling(progress) as telling:
        hashes = distinct_sha256(files)
        output, absorbed = _tables(output_table, transmission, files[0].instrument, has_detector=True)
        return calibrate_twin(
            one_layer(merge_sessions(files), layer),
            rng=generator_of(seed),
            spectra=measured,
            estimator=estimator,
            progress=telling.stage,
            output_table=output,
            transmission_table=absorbed,
            provenance={"acquisition_sha256": "+".join(hashes), **provenance},
        )


def _tables(
    output_table: PathLike | None, transmission: PathLike | None, instrument: "Instrument | None", *, has_detector: bool
) -> "tuple[OutputTable | None, TransmissionTable | None]":
    from ..calibration.spectrum.output_table import read_output_table
    from ..calibration.spectrum.transmission_table import read_transmission_table

    anode = (None if instrument is None else instrument.anode) or "W"
    return (
        None if output_table is None else read_output_table(output_table, anode=anode),
        None if transmission is None else read_transmission_table(transmission, anode=anode, has_detector=has_detector),
    )


def predict(
    twin: "Twin | TubeTwin | PathLike",
    settings: "Setting | str | Sequence[Setting | str] | None" = None,
    /,
    **words: Any,
) -> "Prediction | Predictions | TubePrediction":
    """Flatfield of a twin at one setting or at many, measured or not, with 95 % intervals: `Twin.predict`.

    Args:
        twin: a twin, its file, or a shipped calibration's name.
        settings: see `Twin.predict`, as for all further words.

    Returns:
        A `Prediction`, or `Predictions` where many were asked for.

    Raises:
        InputError: an unknown word or material, no tube load, or a setting that the line cannot have.

    Example:
        >>> found = rt.predict("twin.h5", kV=60, power_W=30, exposure_ms=20, filter="Cu:0.1")
        >>> found.extrapolated
        True
        >>> found.mean_DN.value > 0
        True
    """
    found: Prediction | Predictions | TubePrediction = as_any_twin(twin).predict(settings, **words)  # type: ignore[arg-type]
    return found


def validate(
    twin: "Twin | PathLike",
    acquisition: "Sessions",
    *,
    layer: str | None = None,
    leave_one_out: bool = False,
    seed: "int | np.random.Generator" = 0,
    progress: Progress | bool | None = None,
) -> "Validation":
    """A twin's predictions beside measured flats and wedges, series by series.

    Series held back for evaluation are compared where there are any, else all flats. Intervals include the measured series'
    own sampling noise.

    Args:
        twin: a twin, its file, or a shipped calibration's name.
        acquisition: a file, an open one, or several sessions of one line.
        layer: `front` or `back` of a dual-layer panel; None: the twin's, front without one.
        leave_one_out: also each level of the twin predicted from its other levels.
        seed: a whole number or a generator, of the fits that leave a level out.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        Rows with measured and predicted values, their summary, and a plot of the errors.

    Raises:
        InputError, FileFormatError: no flat that can be compared, another detector or tube, no darks.

    Example:
        >>> found = rt.validate("session_twin.h5", "session.h5")
        >>> bool(found.to_dataframe()["inside_mean"].all())
        True
    """
    from ..acquisition.sessions import layer_for, merge_sessions, one_layer
    from ..calibration.validate import leave_one_out as predict_left_out
    from ..calibration.validate import validate_twin

    known = as_twin(twin)
    with Telling(progress, unit="level") as telling:
        with opened(acquisition) as files:
            distinct_sha256(files)
            session = one_layer(merge_sessions(files), layer_for(known.layer, layer))
            found = validate_twin(known, session, progress=telling.stage)
        if leave_one_out:
            telling.begin("leaving out", len(known.levels))
            rows = predict_left_out(known, rng=generator_of(seed), progress=lambda name: telling.advance())
            found = replace(found, left_out=rows)
    return found
