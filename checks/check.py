"""What an acquisition, a folder of measurements or a twin allows, what is suspicious, and what to measure next.

Nothing is fitted: each series is read once, in pieces, and compared with its labels and with the others.
"""

import os
import tempfile
from pathlib import Path

from ..acquisition.acquisition_io import open_acquisition
from ..acquisition.import_any import draft_sidecar, import_folder, layout_of
from ..errors import FileFormatError, InputError
from ..files import given_path
from ..generator.predictions.tube_twin import NO_DETECTOR, NO_OUTPUT, TubeTwin
from ..generator.twins.twin_io import FORMAT as TWIN_FORMAT
from ..generator.twins.twin_io import read_any_twin
from .check_result import Allowed, CheckResult, SeriesRow
from .check_series import Progress, check_series, in_order, one_line
from .findings import Finding, FindingCode


def check_acquisition(path: str | os.PathLike[str], *, progress: Progress | None = None) -> CheckResult:
    """Check an acquisition file, a folder of measurements in a layout that can be imported, or a twin file.

    Args:
        path: the file or folder.
        progress: called with the name of each series.

    Returns:
        Series, findings, what is possible, what to measure next. Damage is a finding.

    Raises:
        InputError: no such file or folder.

    Example:
        >>> check_acquisition("session.h5").counts  # doctest: +SKIP
        {'error': 0, 'warning': 1, 'note': 2}
    """
    place = given_path(path, expected="an acquisition file, a folder of measurements or a twin")
    if not place.exists():
        raise InputError(
            str(path),
            received="no such file or folder",
            expected="an acquisition file, a folder of measurements or a twin",
        )
    if place.is_dir():
        return _checked_folder(place, progress)
    layout = layout_of(place)
    if layout is not None:
        return _checked_import(place, layout, progress)
    if _is_twin(place):
        return _checked_twin(place)
    return _checked_file(place, str(path), "acquisition", progress)


def _is_twin(path: Path) -> bool:
    from ..acquisition._hdf5 import open_hdf5, reading, text_attribute

    try:
        with open_hdf5(path, what="an acquisition file or a twin") as file, reading(str(path)):
            return text_attribute(file, "format", where=str(path)) == TWIN_FORMAT
    except FileFormatError:
        return False


def _broken(path: str, what: str, error: InputError, *, draft: str = "", place: Path | None = None) -> CheckResult:
    """Of what cannot be read at all."""
    code = FindingCode.NO_SIDECAR if draft else FindingCode.DAMAGED
    return CheckResult(
        path=path,
        what=what,
        series=(),
        findings=(Finding(code=code, values={"what": one_line(error, place, path)}),),
        allows=(),
        next_measurements=(),
        draft=draft,
    )


def _checked_folder(place: Path, progress: Progress | None) -> CheckResult:
    layout = layout_of(place)
    if layout is None:
        draft = draft_sidecar(place)
        error = InputError(
            str(place),
            received="a folder that is in no layout known here",
            expected="images with a raytwin.toml, an EMVA 1288 set, a NeXus file, or the layout of the paper's data",
        )
        return _broken(str(place), "folder", error, draft=draft)
    return _checked_import(place, layout, progress)


def _checked_import(place: Path, layout: str, progress: Progress | None) -> CheckResult:
    """Import into a file that is thrown away, and check that."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "imported.h5"
        try:
            report = import_folder(place, written, layout=layout)
        except InputError as error:
            return _broken(str(place), layout, error)
        if report.format != "acquisition":
            return CheckResult(
                path=str(place),
                what=f"{layout} ({report.format})",
                series=(),
                findings=(),
                allows=(Allowed(what="networks and detection", possible=True, why=f"{report.frames} images"),),
                next_measurements=(),
            )
        return _checked_file(written, str(place), layout, progress)


def _checked_twin(place: Path) -> CheckResult:
    try:
        twin = read_any_twin(place)
    except InputError as error:
        return _broken(str(place), "twin", error)
    if isinstance(twin, TubeTwin):
        return _checked_tube(place, twin)
    rows = tuple(
        SeriesRow(
            name=", ".join(level.series),
            kind="level",
            setting=level.name,
            frames=0,
            averaged=1,
            shape=twin.maps.shape,
            level_DN=None,
            noise_DN=None,
            serves_for=("gain and noise at this beam",),
        )
        for level in twin.levels
    )
    spectral = twin.spectral
    voltages = sorted({level.kV for level in twin.levels if level.kV is not None})
    allows = [
        Allowed(
            what="noise and level at the calibrated beams",
            possible=bool(twin.levels),
            why=", ".join(level.name for level in twin.levels) or "no level",
        ),
        Allowed(
            what="other kV and filters",
            possible=spectral is not None,
            why="no spectral part: flats with kV, current and distance would give one"
            if spectral is None
            else f"calibrated at {', '.join(f'{kV:g}' for kV in voltages)} kV",
        ),
    ]
    suggested = twin.evidence.get("next_measurement")
    text = suggested.get("text") if isinstance(suggested, dict) else None
    return CheckResult(
        path=str(place),
        what="twin",
        series=rows,
        findings=tuple(Finding(code=FindingCode.TWIN_WARNING, values={"what": line}) for line in twin.warnings),
        allows=tuple(allows),
        next_measurements=(text,) if text else (),
    )


def _checked_tube(place: Path, twin: TubeTwin) -> CheckResult:
    low, high = twin.spectral.calibrated_kV
    return CheckResult(
        path=str(place),
        what="twin of a tube",
        series=(),
        findings=tuple(Finding(code=FindingCode.TWIN_WARNING, values={"what": line}) for line in twin.warnings),
        allows=(
            Allowed(
                what="spectrum, attenuation and contrast at any kV and filter",
                possible=True,
                why=f"calibrated at {low:g} to {high:g} kV",
            ),
            Allowed(
                what="air kerma",
                possible=twin.output_known,
                why="a dosimeter read it" if twin.output_known else NO_OUTPUT,
            ),
            Allowed(what="noise and level", possible=False, why=NO_DETECTOR),
        ),
        next_measurements=("flats and darks of the detector",),
    )


def _checked_file(place: Path, told: str, what: str, progress: Progress | None) -> CheckResult:
    damage: list[FileFormatError] = []
    try:
        acquisition = open_acquisition(place, damage=damage)
    except InputError as error:
        return _broken(told, what, error, place=place)
    with acquisition:
        checked = check_series(acquisition, progress=progress)
    damaged = [Finding(code=FindingCode.DAMAGED, values={"what": one_line(error, place, told)}) for error in damage]
    return CheckResult(
        path=told,
        what=what,
        series=checked.series,
        findings=in_order([*damaged, *checked.findings]),
        allows=checked.allows,
        next_measurements=checked.next_measurements,
    )
