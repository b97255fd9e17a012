"""Which series of a session can be compared with the model, and what passes over their frames show."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile
from ...generator.frames.line_model import ExpectedSeries
from ..arrays import BoolArray, FloatArray, RealArray
from .even_maps import full_size, local_range, signal_map
from .session import SessionSeries
from .summaries import LEAST_NOISE_DN2, FirstLook, SeriesSummary, look_at_series, summarise_series

_ABOVE_NOISE = 4.0  # standard deviations of one exposure of one pixel
_LABEL_PIXELS = 150  # that a noise label needs
_MOST_SATURATED = 1e-3  # share of the pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenSeries:
    """A series that can be compared, and what a first pass over its frames shows."""

    session: SessionSeries
    expected: ExpectedSeries  # by the base twin
    look: FirstLook
    readable: BoolArray  # (row, column): pixels whose noise is not cut off at 0
    labels: NDArray[np.int64]  # (row, column): noise label of each pixel, -1: none
    label_names: tuple[str, ...]

    @property
    def name(self) -> str:
        """The series' name."""
        return self.session.name


def counted_copies(seen: Sequence[SeenSeries]) -> dict[str, tuple[int, int]]:
    """Frames that are copies of earlier ones of their series, and those that may be: of all series that calibrate, and of all others.

    Each pair by the name of the last of these series, which counts them. Series without any noise are left out.
    """
    found: dict[str, tuple[int, int]] = {}
    for calibrates in (True, False):
        members = [
            one for one in seen if one.session.calibrates == calibrates and np.any(one.look.stack_variance_DN2 > 0)
        ]
        if members:
            copies = sum(one.look.copies for one in members)
            found[members[-1].name] = copies, sum(one.session.series.n_frames - 1 for one in members)
    return found


def stated_series(
    session: Sequence[SessionSeries], acquisition: AcquisitionFile
) -> tuple[list[SessionSeries], list[str]]:
    """Series that say what the model must know, and why each of the others cannot be used."""
    reasons = {item.name: _why_not(item, acquisition) for item in session}
    skipped = [f"{name}: {reason}" for name, reason in reasons.items() if reason]
    return [item for item in session if not reasons[item.name]], skipped


def _why_not(item: SessionSeries, acquisition: AcquisitionFile) -> str:
    series = item.series
    if series.kind in ("dark", "afterglow"):
        if "log" in series.corrected:
            return f"logarithms of a series of kind {series.kind}"
        return "exposure unknown" if series.kind == "dark" and series.exposure_ms is None else ""
    load_stated = series.setting is not None and series.setting.tube_load_mAs is not None
    if not load_stated and item.request.open_signal_DN is None:
        return "kV, exposure or tube load unknown"
    if series.kind == "object":
        scene = acquisition.scenes.get(series.scene)
        if scene is None or not len(scene.thickness_mm):
            return "object of unknown thickness"
    return ""


def look_at_all(
    items: Sequence[SessionSeries],
    expected: Mapping[str, ExpectedSeries],
    *,
    good: BoolArray,
    bits: int | None,
    dark_at: Callable[[float | None], RealArray],
    side: int,
    tell: Callable[[str], None],
) -> tuple[list[SeenSeries], list[str]]:
    """First pass over the frames; and why series are left out: saturated ones, and those that are nearly all cut off at 0.

    expected: by name; good: pixels in use (row, column); bits: of the ADC, None: unknown; dark_at: dark (row, column) of an exposure
    time, ms; side: of the squares of the panel's pixels that stand for pixels.
    """
    saturation_DN = None if bits is None else 2.0**bits - 1
    seen: list[SeenSeries] = []
    left_out: list[str] = []
    for item in items:
        model = expected[item.name]
        signal = signal_map(model, good.shape)
        readable = np.ones(good.shape, dtype=bool)
        if item.ends_at_zero and item.request.beam_on:
            readable = _above_noise(item, model, signal, dark_at=dark_at, side=side)
            if (readable & good).sum() < min(_LABEL_PIXELS, good.sum() / 2):
                left_out.append(f"{item.name}: so dark that noise below 0 was cut off in nearly all pixels")
                continue
        labels, names = _labels(signal, item.series.kind, good & readable)
        tell(f"frames of {item.name}")
        look = look_at_series(
            item.series.iter_frames(),
            good=good,
            pattern=_pattern(item, signal, good),
            name=f"series {item.name}",
            saturation_DN=saturation_DN,
        )
        if look.saturated_share > _MOST_SATURATED and item.series.kind != "dark":
            left_out.append(f"{item.name}: saturated in {100 * look.saturated_share:.3g} % of the pixels")
            continue
        seen.append(
            SeenSeries(session=item, expected=model, look=look, readable=readable, labels=labels, label_names=names)
        )
    return seen, left_out


def summarise_all(
    seen: Sequence[SeenSeries], clean: BoolArray, *, tell: Callable[[str], None]
) -> dict[str, SeriesSummary]:
    """What the frames' noise says in pixels that do not stand out (`clean`, (row, column)), by name of series."""
    summaries: dict[str, SeriesSummary] = {}
    for one in seen:
        tell(f"frames of {one.name} without outliers")
        good = clean & one.readable
        summaries[one.name] = summarise_series(
            one.session.series.iter_frames(),
            good=good,
            labels=one.labels,
            pattern=_pattern(one.session, signal_map(one.expected, good.shape), good),
            name=f"series {one.name}",
        )
    return summaries


def _above_noise(
    item: SessionSeries,
    expected: ExpectedSeries,
    signal_DN: FloatArray,
    *,
    dark_at: Callable[[float | None], RealArray],
    side: int,
) -> BoolArray:
    """Pixels (row, column) whose numbers lie so far above 0 that no noise was cut off there."""
    subtracted = item.shares or "offset" in item.series.corrected
    number_DN = signal_DN if subtracted else signal_DN + dark_at(item.series.exposure_ms)
    variance = full_size(expected.quantum_variance_DN2, signal_DN.shape) + full_size(
        expected.white_variance_DN2, signal_DN.shape
    )
    # it was cut off before pixels or exposures were averaged
    one_DN = side * np.sqrt(item.request.exposures_per_frame * np.maximum(variance, LEAST_NOISE_DN2))
    return np.asarray(number_DN > _ABOVE_NOISE * one_DN)


def _pattern(item: SessionSeries, signal: FloatArray, usable: BoolArray) -> FloatArray | None:
    """How one unit of a frame's common factor looks."""
    mean = float(signal[usable].mean()) if item.request.beam_on and usable.any() else 0.0
    return signal / mean if mean > 0 else None


def _labels(signal: FloatArray, kind: str, good: BoolArray) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Noise labels: the whole field, or quartiles of signal away from edges."""
    if kind != "object":
        return np.where(good, 0, -1).astype(np.int64), ("field",)
    open_DN = float(signal.max())
    flatness = local_range(signal, 2) / np.maximum(signal, 1e-9)
    usable = good & (flatness < 0.15) & (signal > 0.01 * open_DN)
    if usable.sum() < 64:
        usable = good
    covered = usable & (signal < 0.97 * open_DN)
    labels = np.full(signal.shape, -1, dtype=np.int64)
    names: list[str] = []
    if (usable & ~covered).sum() >= 64:
        labels[usable & ~covered] = 0
        names.append("open field")
    if covered.sum() >= 3 * _LABEL_PIXELS:
        edges = np.quantile(signal[covered], [0.0, 1 / 3, 2 / 3, 1.0])
        for low, high, name in zip(edges[:-1], edges[1:], ("dark third", "middle third", "bright third"), strict=True):
            inside = covered & (signal >= low) & (signal <= high) & (labels < 0)
            if inside.sum() >= _LABEL_PIXELS:
                labels[inside] = len(names)
                names.append(name)
    if not names:
        return np.where(good, 0, -1).astype(np.int64), ("field",)
    return labels, tuple(names)
