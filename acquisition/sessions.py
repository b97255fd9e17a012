"""Several sessions of one detector as one acquisition, and one layer of a dual-layer panel's."""

from collections.abc import Sequence
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

from ..errors import InputError
from .acquisition_io import AcquisitionFile, Series
from .instrument import Instrument
from .scenes import Scene

LATER_S = 3600.0  # from the end of a session to what was measured later


class _Several:
    """Files that are closed together."""

    def __init__(self, files: Sequence[Any]) -> None:
        self._files = files

    def close(self) -> None:
        for file in self._files:
            file.close()


def merge_sessions(acquisitions: Sequence[AcquisitionFile]) -> AcquisitionFile:
    """Sessions of one line, in the order given, as one acquisition; closing it closes them all.

    Series keep their order in time within a session and know its number. Where a name of a series or scene comes again, the
    later one is called `2.NAME`, after its session.

    Raises:
        InputError: no session, or instruments that contradict each other; what one leaves open the others may tell.
    """
    if not acquisitions:
        raise InputError("sessions", received="none", expected="at least one acquisition")
    if len(acquisitions) == 1:
        return acquisitions[0]
    series: list[Series] = []
    scenes: dict[str, Scene] = {}
    taken: set[str] = set()
    instrument = acquisitions[0].instrument
    for number, acquisition in enumerate(acquisitions):
        instrument = _joined(instrument, acquisition.instrument, acquisition.path)
        renamed = {name: _free(name, number, scenes) for name in acquisition.scenes}
        scenes |= {renamed[name]: replace(scene, name=renamed[name]) for name, scene in acquisition.scenes.items()}
        first = len(series)
        for place, item in enumerate(acquisition.series):
            name = _free(item.name, number, taken)
            taken.add(name)
            scene = renamed.get(item.scene, item.scene)
            series.append(replace(item, name=name, index=first + place, scene=scene, session=number))
    paths = tuple(acquisition.path for acquisition in acquisitions)
    return AcquisitionFile(
        path=" + ".join(paths),
        paths=paths,
        instrument=instrument,
        series=tuple(series),
        scenes=scenes,
        attributes=MappingProxyType({}),
        missing=tuple(dict.fromkeys(line for acquisition in acquisitions for line in acquisition.missing)),
        _file=_Several([acquisition._file for acquisition in acquisitions]),
    )


def continued_session(sessions: Sequence[AcquisitionFile], *, layer: str | None = None) -> AcquisitionFile:
    """A session with what was measured later on the same line behind it in time, which calibrates nothing.

    Each file has a clock of its own: a later one begins LATER_S after the end of the one before it.

    Args:
        sessions: the session first, then the later ones in order.
        layer: as `one_layer`.

    Raises:
        InputError: as `merge_sessions` and `one_layer`.
    """
    merged = one_layer(merge_sessions(sessions), layer)
    if len(sessions) == 1:
        return merged
    series: list[Series] = []
    begins_s, last_s, session = 0.0, 0.0, 0
    for item in merged.series:
        if item.session != session:
            session, begins_s = item.session, last_s + LATER_S
        time_s = None if item.time_s is None else item.time_s + begins_s
        if time_s is not None:
            last_s = max(last_s, float(time_s[-1]))
        role = item.role if item.session == 0 else "evaluation"
        series.append(replace(item, time_s=time_s, role=role))
    return replace(merged, series=tuple(series))


def select_layer(acquisition: AcquisitionFile, layer: str) -> AcquisitionFile:
    """The series of one layer of a dual-layer panel, with the instrument as that layer sees it.

    Series that do not name their layer are the front's.

    Raises:
        InputError: no such layer was declared, or it has no series.
    """
    instrument = acquisition.instrument.of_layer(layer)
    chosen = tuple(item for item in acquisition.series if (item.layer or "front") == layer)
    if not chosen:
        raise InputError(
            "layer",
            received=layer,
            expected="a layer that series of the acquisition name",
            remedy="give the series of the back image the attribute layer = back",
        )
    return replace(acquisition, instrument=instrument, series=chosen)


def one_layer(acquisition: AcquisitionFile, layer: str | None = None) -> AcquisitionFile:
    """The series of the layer that is asked for; None: of the front one where there are several, else all as they are.

    Raises:
        InputError: as `select_layer`.
    """
    if layer is None and all(item.layer != "back" for item in acquisition.series):
        return acquisition
    return select_layer(acquisition, layer or "front")


def layer_for(of_twin: str | None, asked: str | None) -> str | None:
    """The layer to compare with a twin: the one that is asked for, else the twin's.

    Args:
        of_twin: the layer that the twin was calibrated from; None: not known, or no dual-layer panel.
        asked: `front`, `back` or None.

    Raises:
        InputError: another layer than the twin's.
    """
    if of_twin is None or asked in (None, of_twin):
        return of_twin or asked
    raise InputError(
        "layer",
        received=asked,
        expected=f"{of_twin}, which the twin was calibrated from",
        remedy="leave the option out, or calibrate a twin of that layer",
    )


def _free(name: str, number: int, taken: set[str] | dict[str, Scene]) -> str:
    return f"{number + 1}.{name}" if name in taken else name


def _joined(first: Instrument, second: Instrument, path: str) -> Instrument:
    """What either tells of the instrument."""
    told: dict[str, Any] = {}
    for field in fields(Instrument):
        one, other = getattr(first, field.name), getattr(second, field.name)
        if one is not None and other is not None and one != other:
            raise InputError(
                f"{path}, instrument {field.name}",
                received=_shown(other),
                expected=f"{_shown(one)} as in the sessions before it",
                remedy="calibrate sessions of different lines one by one",
            )
        told[field.name] = one if one is not None else other
    return Instrument(**told)


def _shown(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, tuple) else str(value)
