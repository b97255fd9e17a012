"""What every real line does a little without anything being wrong: sizes, and their course through one session.

Nothing of it is announced anywhere. Level and smooth shape of the open field change from series to series, output and
dark wander with 1/f noise, rows and columns have a little noise of their own, dust moves once, a few pixels turn bad.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Map = NDArray[np.float32]

# Largest sizes; EFFECTS table of the project's catalogue: beyond them they are effects of their own.
LARGEST_LEVEL_PERCENT = 0.10  # standard deviation; cut at 1.5 of them, so that two series differ by 0.3 % at most
LARGEST_SHAPE_PERCENT = 0.05 / math.sqrt(2.0)  # rms about the mean shape, so that two series differ by 0.05 % rms
LARGEST_OUTPUT_PERCENT = 0.05
LARGEST_DARK_DN = 0.5
LARGEST_LINE_NOISE = 0.1
SMALLEST_DUST_PERCENT, LARGEST_DUST_PERCENT = 0.1, 1.0
MOST_SPECKS = 5
MOST_NEW_BAD_SHARE = 1e-4  # of the pixels; two are possible on any panel
_LEVEL_CUT = 1.5
# 1/f: equal power in every octave of period, from an hour down to two frames of 25 ms
_LONGEST_S, _OCTAVES, _WAVES_AN_OCTAVE = 3600.0, 16, 3
_SHAPE_PARTS = 6
_SERIES_PERIODS = (5.0, 60.0)  # series in which a part of the shape comes back
USUAL_SERIES = 40  # in a session of unknown length
_COURSE, _LEVELS, _ROWS = 71, 72, 73  # random streams


@dataclass(frozen=True, slots=True, kw_only=True)
class Unkindness:
    """Sizes of what a line does a little all the time; all 0 (the default) is a line without any of it.

    Fields:
        level_percent: standard deviation of the output from series to series.
        shape_percent: rms over the field of the smooth departure from the mean shape of the open field.
        output_percent: rms of the output's 1/f drift, over an hour.
        dark_DN: largest departure of the dark level (DN) by 1/f drift; its rms is half of that.
        row_noise_sigma, column_noise_sigma: rms of offsets of rows and columns, new in every exposure, over the read noise.
        dust_specks: specks of 2 to 4 px that lie elsewhere from some series on; dust_percent: light that the darkest takes.
        new_bad_share: share of the pixels that turn bad during a session (a number of pixels is drawn from it).
    """

    level_percent: float = 0.0
    shape_percent: float = 0.0
    output_percent: float = 0.0
    dark_DN: float = 0.0
    row_noise_sigma: float = 0.0
    column_noise_sigma: float = 0.0
    dust_specks: int = 0
    dust_percent: float = 0.0
    new_bad_share: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"unkindness {item.name}", received=value, expected="a finite number of 0 or more")


NONE = Unkindness()


def sample_unkindness(rng: np.random.Generator) -> Unkindness:
    """Sizes of a hidden system: each uniform from 0 to its largest, 0 to 5 specks of dust of 0.1 to 1 %."""
    return Unkindness(
        level_percent=rng.uniform(0.0, LARGEST_LEVEL_PERCENT),
        shape_percent=rng.uniform(0.0, LARGEST_SHAPE_PERCENT),
        output_percent=rng.uniform(0.0, LARGEST_OUTPUT_PERCENT),
        dark_DN=rng.uniform(0.0, LARGEST_DARK_DN),
        row_noise_sigma=rng.uniform(0.0, LARGEST_LINE_NOISE),
        column_noise_sigma=rng.uniform(0.0, LARGEST_LINE_NOISE),
        dust_specks=int(rng.integers(0, MOST_SPECKS + 1)),
        dust_percent=math.exp(rng.uniform(math.log(SMALLEST_DUST_PERCENT), math.log(LARGEST_DUST_PERCENT))),
        new_bad_share=rng.uniform(0.0, MOST_NEW_BAD_SHARE),
    )


def one_over_f(rng: np.random.Generator, *, rms: float) -> Callable[[float], float]:
    """A random function of time (s) with equal power in each octave of period, from an hour to 55 ms."""
    count = _OCTAVES * _WAVES_AN_OCTAVE
    periods_s = _LONGEST_S * 2.0 ** -((np.arange(count) + rng.uniform(size=count)) / _WAVES_AN_OCTAVE)
    phases = rng.uniform(0.0, 2.0 * math.pi, size=count)
    sizes = rng.standard_normal(count) * rms * math.sqrt(2.0 / count)

    def value(time_s: float) -> float:
        return float(np.sum(sizes * np.cos(2.0 * math.pi * time_s / periods_s + phases)))

    return value


def smooth_field(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A smooth map over the field, mean 0 and rms 1: slopes, curvatures and one broad hump."""
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, length) for length in shape), indexing="ij")
    terms = (y, x, y * x, y * y, x * x)
    total = sum((rng.standard_normal() * term for term in terms), np.zeros(shape))
    centre_y, centre_x = rng.uniform(-0.8, 0.8, size=2)
    width = rng.uniform(0.5, 1.0)
    total += rng.standard_normal() * np.exp(-((y - centre_y) ** 2 + (x - centre_x) ** 2) / (2.0 * width**2))
    total -= total.mean()
    return np.asarray(total / max(float(total.std()), 1e-12))


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What happens once in a session.

    Fields: series: number of the first series that shows it; places: (row, column, size in px, light taken) of dust
    before (`dust_before`) and from then on (`dust_after`); `new_bad`: (row, column, kind).
    """

    dust_series: int = 0
    dust_before: tuple[tuple[float, float, float, float], ...] = ()
    dust_after: tuple[tuple[float, float, float, float], ...] = ()
    bad_series: int = 0
    new_bad: tuple[tuple[int, int, str], ...] = ()


@dataclass(slots=True)
class SessionCourse:
    """How a line's little unkindnesses go through one session; the same key gives the same course."""

    sizes: Unkindness
    shape: tuple[int, int]
    key: int
    series_count: int
    change: Change = field(init=False)
    _output: Callable[[float], float] = field(init=False, repr=False)
    _dark: Callable[[float], float] = field(init=False, repr=False)
    _parts: list[tuple[NDArray[np.float64], float, float]] = field(init=False, repr=False)
    _kept: dict[int, Map] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.key, _COURSE])
        self._output = one_over_f(rng, rms=self.sizes.output_percent / 100.0)
        self._dark = one_over_f(rng, rms=0.5 * self.sizes.dark_DN)
        longest, shortest = math.log(_SERIES_PERIODS[1]), math.log(_SERIES_PERIODS[0])
        self._parts = [
            (
                smooth_field(rng, self.shape),
                2.0 * math.pi / math.exp(rng.uniform(shortest, longest)),
                rng.uniform(0.0, 2.0 * math.pi),
            )
            for _ in range(_SHAPE_PARTS)
        ]
        self.change = self._drawn_change(rng)

    def _drawn_change(self, rng: np.random.Generator) -> Change:
        rows, columns = self.shape

        def specks() -> tuple[tuple[float, float, float, float], ...]:
            # the darkest takes `dust_percent`, others less
            shares = self.sizes.dust_percent / 100.0 * rng.uniform(0.3, 1.0, size=self.sizes.dust_specks)
            return tuple(
                (
                    float(rng.uniform(1.0, rows - 2.0)),
                    float(rng.uniform(1.0, columns - 2.0)),
                    float(rng.uniform(2.0, 4.0)),
                    float(share),
                )
                for share in shares
            )

        before, after = specks(), specks()
        count = min(int(rng.poisson(self.sizes.new_bad_share * rows * columns)), max(2, round(2e-4 * rows * columns)))
        bad = tuple(
            (int(rng.integers(rows)), int(rng.integers(columns)), str(rng.choice(["dead", "hot", "weak"])))
            for _ in range(count)
        )
        first, second = (int(rng.uniform(0.1, 0.9) * self.series_count) for _ in range(2))
        return Change(dust_series=first, dust_before=before, dust_after=after, bad_series=second, new_bad=bad)

    def level(self, series: int) -> float:
        """Output of a series over the usual one."""
        rng = np.random.default_rng([self.key, _LEVELS, series])
        size = self.sizes.level_percent / 100.0
        return 1.0 + size * float(np.clip(rng.standard_normal(), -_LEVEL_CUT, _LEVEL_CUT))

    def output(self, time_s: float) -> float:
        """Output at a time over the usual one."""
        return 1.0 + self._output(time_s)

    def dark_DN(self, time_s: float) -> float:
        """Departure of the dark level (DN) at a time, of all pixels together."""
        largest = self.sizes.dark_DN
        return min(max(self._dark(time_s), -largest), largest)

    def shading(self, series: int) -> Map:
        """What of the light each pixel (row, column) gets in a series, over the usual."""
        if series not in self._kept:
            departure = np.zeros(self.shape)
            for part, step, phase in self._parts:
                departure += part * math.cos(step * series + phase)
            # each cosine has a mean square of a half
            light = 1.0 + self.sizes.shape_percent / 100.0 * math.sqrt(2.0 / _SHAPE_PARTS) * departure
            dust = self.change.dust_after if series >= self.change.dust_series else self.change.dust_before
            taken = np.zeros(self.shape)
            for row, column, size_px, share in dust:
                taken = np.maximum(taken, share * _speck(self.shape, row, column, size_px))
            light *= 1.0 - taken
            self._kept = {series: light.astype(np.float32)}
        return self._kept[series]

    def line_noise(self, frame: int, summed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offsets of rows (row,) and columns (column,) of a frame, in read noises."""
        rng = np.random.default_rng([self.key, _ROWS, frame])
        rows, columns = (rng.standard_normal(length) / math.sqrt(summed) for length in self.shape)
        return self.sizes.row_noise_sigma * rows, self.sizes.column_noise_sigma * columns

    def turned_bad(self, series: int) -> tuple[tuple[int, int, str], ...]:
        """Pixels (row, column, kind) that are bad in a series and were not when the panel was made."""
        return self.change.new_bad if series >= self.change.bad_series else ()

    def told(self) -> dict[str, Any]:
        """Sizes and what happened once, for the truth."""
        return {**asdict(self.sizes), "once": asdict(self.change)}


def course_of(system: Any, key: np.uint64, series_count: int) -> SessionCourse | None:
    """The course of a system's unkindness through a session of a key; None where it has none of it."""
    if system.unkindness == NONE:
        return None
    return SessionCourse(system.unkindness, (system.rows, system.columns), int(key), series_count)


def _speck(shape: tuple[int, int], row: float, column: float, size_px: float) -> NDArray[np.float64]:
    """1 within a disc of diameter `size_px`, falling to 0 over a pixel."""
    y, x = np.ogrid[0 : shape[0], 0 : shape[1]]
    distance = np.hypot(y - row, x - column)
    return np.asarray(np.clip(0.5 * size_px + 0.5 - distance, 0.0, 1.0))


def with_bad_pixels(maps: Any, places: tuple[tuple[int, int, str], ...]) -> Any:
    """The detector's maps with pixels that turned `dead`, `hot` (1 DN/ms, five times the noise) or `weak` (half the signal)."""
    if not places:
        return maps
    conversion, current = maps.DN_per_electron.copy(), maps.dark_current_DN_per_ms.copy()
    noise = maps.read_noise_DN.copy()
    for row, column, kind in places:
        if kind == "hot":
            current[row, column] += 1.0
            noise[row, column] *= 5.0
        else:
            conversion[row, column] *= 0.0 if kind == "dead" else 0.5
    return replace(maps, DN_per_electron=conversion, dark_current_DN_per_ms=current, read_noise_DN=noise)
