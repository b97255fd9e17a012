"""A result as one self-contained page."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileFormatError, InputError
from ..files import given_path
from ._given import PathLike, as_any_twin, dataset_of
from .curves import PodCurve, fit_pod, is_response
from .images import GeneratedPairs

if TYPE_CHECKING:
    from ..acquisition import Dataset
    from ..calibration.validate import Validation
    from ..diagnosis.judgement.answer import Diagnosis
    from ..generator.line.twin import Twin
    from ..generator.predictions.tube_twin import TubeTwin

_EXPECTED = "a twin, a validation, a POD curve, generated pairs, a dataset, a diagnosis, or the file of a twin, a dataset or hits"

_ANSWER = "diagnosis.json"


def report(
    result: "Twin | TubeTwin | Validation | PodCurve | GeneratedPairs | Dataset | Diagnosis | PathLike",
    output: PathLike,
    *,
    interactive: bool | None = None,
) -> Path:
    """Write a result as one self-contained HTML page that needs no network; returns its path.

    The page has the answer first, then the figures that show it and what to do next. The numbers of every figure are on it as
    CSV.

    Args:
        result: what a function of raytwin returned, or the file of a twin, a dataset or a table of hits (HITS.csv), or a shipped
            calibration's name. A table of hits is fitted as `fit_pod` does by default.
        output: the page, a name that ends in .html.
        interactive: figures that answer to the pointer, which adds 1.3 MB; None: where Bokeh is installed (extra `explore`).

    Raises:
        InputError: a result without a page, another ending, or a place where nothing can be written.

    Example:
        >>> rt.report("twin.h5", "twin.html").name
        'twin.html'
    """
    from .. import __version__
    from ..reports import write_result_page

    path = checked_page(output)
    from ..diagnosis.judgement.answer import Diagnosis

    if isinstance(result, Diagnosis):
        from ..campaign.task_page import detection_of
        from ..diagnosis.report.report import write_report

        detection = detection_of(result.task)
        return write_report(
            result, result.to_dict(), path, version=__version__, detection=detection, interactive=interactive
        )
    return write_result_page(path, _page_of(result), version=__version__, interactive=interactive)


def checked_page(output: PathLike, *, argument: str = "output") -> Path:
    """The page's path.

    Raises:
        InputError: another ending than .html.
    """
    path = given_path(output, expected="a page", argument=argument)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(argument, received=path.name, expected="a name that ends in .html")
    return path


def _page_of(result: Any) -> Any:
    from ..acquisition import dataset_io
    from ..acquisition._hdf5 import format_of_file
    from ..calibration.validate import Validation
    from ..generator.line.twin import Twin
    from ..generator.predictions.tube_twin import TubeTwin
    from ..generator.twins.twin_io import FORMAT as TWIN_FORMAT

    if isinstance(result, PodCurve):
        return _pod_page(result)
    if isinstance(result, Validation):
        from ..campaign.twin_page import validation_page

        return validation_page(result)
    if isinstance(result, GeneratedPairs):
        return _pairs_page(result)
    is_file = isinstance(result, str | os.PathLike)
    if is_file:
        _refuse_diagnosis(Path(result))
    if is_file and Path(result).suffix.lower() == ".csv":
        return _pod_page(_curve_of_hits(result))
    kind = format_of_file(result) if is_file else None
    if is_file and kind not in (TWIN_FORMAT, dataset_io.FORMAT) and Path(result).is_file():
        raise FileFormatError(
            str(result),
            received="a file that cannot be read as HDF5, or without a format" if kind is None else f"format {kind!r}",
            expected=_EXPECTED,
            remedy="a damaged file has to be copied or made again" if kind is None else "",
        )
    if isinstance(result, dataset_io.Dataset) or kind == dataset_io.FORMAT:
        from ..campaign.dataset_page import dataset_page

        with dataset_of(result) as dataset:
            return dataset_page(dataset)
    if isinstance(result, Twin | TubeTwin) or is_file:
        from ..campaign.twin_page import twin_page

        return twin_page(as_any_twin(result))
    raise InputError("result", received=type(result).__name__, expected=_EXPECTED)


def _refuse_diagnosis(place: Path) -> None:
    """A diagnosis on disk has its page beside it; the answer alone does not hold what the page shows."""
    answer = place / _ANSWER if place.is_dir() else place
    if answer.name == _ANSWER and answer.is_file():
        raise InputError(
            str(place),
            received="an answer of `raytwin diagnose`",
            expected=_EXPECTED,
            remedy=f"`raytwin diagnose` wrote its page already: {answer.with_name('report.html')}",
        )


def _curve_of_hits(path: PathLike) -> PodCurve:
    try:
        return fit_pod(path)
    except FileFormatError:
        raise
    except InputError as error:
        raise InputError(
            error.argument,
            received=error.received,
            expected=error.expected,
            remedy="a page of another column, of counts of hits or of a response: `raytwin pod TABLE.csv --report PAGE.html`",
        ) from None


def _pod_page(curve: PodCurve) -> Any:
    from ..campaign.pod_page import pod_page

    answer = curve.to_dict()
    if is_response(curve.fit):
        columns = (curve.table.size, curve.table.response)
        return pod_page(curve.fit, None, answer, response=columns if columns[1] is not None else None)  # type: ignore[arg-type]
    return pod_page(curve.fit, curve.trials, answer)


def _pairs_page(pairs: GeneratedPairs) -> Any:
    import tempfile

    from ..campaign.dataset_page import dataset_page

    with tempfile.TemporaryDirectory() as folder:
        path = pairs.path if pairs.path is not None else pairs.save(Path(folder) / "pairs.h5")
        with dataset_of(str(path)) as dataset:
            return dataset_page(dataset, warnings=pairs.warnings)
