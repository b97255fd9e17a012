"""What the forward model of a series knows of the line, from the beam to the ADC; effects change it stage by stage.

The stages follow the order in which a real line works:

    beam         tube voltage, filtration, compositions: before anything is projected
    arrivals     the field that reaches the scintillator: heel, displaced objects, scatter
    object_blur  focal spot, motion: they blur what stands in the beam, not the noise
    quanta       statistics of the photons
    optics       spread of light: blurs the picture and correlates the noise
    exposure     one factor for a whole frame
    lag          charge trapped and released later
    response     nonlinearity, per-pixel gain
    electronics  offsets and noise of the readout
    readout      ADC and bad pixels
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ..spread._fine_picture import FineCells
    from .series_request import SeriesRequest
    from .spectral_signal import SpectralModel
    from .twin import Twin

STAGES = (
    "beam",
    "arrivals",
    "object_blur",
    "quanta",
    "optics",
    "exposure",
    "lag",
    "response",
    "electronics",
    "readout",
)

FloatArray = NDArray[np.float64]
# (cycles per pixel along rows (n, 1), along columns (1, m)) -> factor that broadcasts to (n, m); even in both
Transfer = Callable[[FloatArray, FloatArray], FloatArray]
# the same of a blur that may go to one side: complex then, of -f the conjugate
SidedTransfer = Callable[[FloatArray, FloatArray], NDArray[np.inexact]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LagLaw:
    """Traps: of each exposure the shares `trapped` (trap,) go into traps that empty with `time_s` (trap,).

    pause_share: of what is released in a pause between series, the share that the next series' first exposure reads. idle_s: length
    of the pauses that a session does not state. before_share: of what exposures before the lag set in would have left, the share that
    is there.
    """

    trapped: tuple[float, ...]
    time_s: tuple[float, ...]
    pause_share: float
    idle_s: float
    before_share: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GainMemory:
    """A gain that is larger by the share `most` where all traps q are full: each DN of light fills `filled_per_DN` of the empty ones.

    They empty with `fade_s`: dq = filled_per_DN (1 - q) dx - q dt / fade_s; but for `lasting_share` of them, which stay full.
    """

    most: float
    filled_per_DN: float
    fade_s: float
    lasting_share: float = 0.0

    @property
    def kinds(self) -> tuple[tuple[float, float], ...]:
        """Kinds of traps: share, and time in which they empty, s."""
        kinds = (1.0 - self.lasting_share, self.fade_s), (self.lasting_share, math.inf)
        return tuple(kind for kind in kinds if kind[0] > 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedPattern:
    """A fixed relative pattern over the pixels, normal, drawn from `seed`.

    Fields: rms; correlation_px: pixels d apart are alike by exp(-d^2 / (2 correlation_px^2)); 0: each has its own; of_columns: whole
    columns have one value each.
    """

    rms: float
    seed: int
    correlation_px: float = 0.0
    of_columns: bool = False

    def correlation(self, apart_px: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Of pixels so far apart in line."""
        apart = np.asarray(apart_px, dtype=np.float64)
        if self.correlation_px <= 0.0:
            return np.asarray(apart == 0.0, dtype=np.float64)
        return np.asarray(np.exp(-0.5 * (apart / self.correlation_px) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Seams:
    """Where tiles meet along one axis: first_px before the first seam, side_px from seam to seam; side_px 0: nowhere."""

    side_px: float = 0.0
    first_px: float = 0.0

    def tile_of(self, length: int) -> NDArray[np.intp]:
        """Number of the tile that each of `length` pixels in line lies in (pixel,)."""
        if self.side_px <= 0.0:
            return np.zeros(length, dtype=np.intp)
        number = np.floor((np.arange(length) + 0.5 - self.first_px) / self.side_px).astype(np.intp)
        return np.asarray(number - number[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class TilePattern:
    """Relative gains of tiles beside each other, normal, drawn from `seed`.

    Fields: rms; rows, columns: how they meet along each axis.
    """

    rms: float
    rows: Seams
    columns: Seams
    seed: int

    @classmethod
    def of(cls, parameters: Mapping[str, float], *, rms: float) -> "TilePattern":
        """The one that parameters describe: `rows_px` and `first_rows_px`, the same of columns, `pattern_seed`."""
        rows, columns = (
            Seams(side_px=parameters[f"{axis}_px"], first_px=parameters[f"first_{axis}_px"])
            for axis in ("rows", "columns")
        )
        return cls(rms=rms, rows=rows, columns=columns, seed=int(parameters["pattern_seed"]))


EACH_LINE = 0.1  # lines over which what is common to a line fades where every line has its own: next ones share 5e-5


def between_lines(lines: int, together_lines: float) -> float:
    """Correlation of what is common to two lines so far apart, exp(-|lines| / together_lines)."""
    return math.exp(-abs(lines) / together_lines)


@dataclass(frozen=True, slots=True, kw_only=True)
class LineFlicker:
    """Factors common to the rows and columns of one exposure, new in each.

    Fields: rms; column_share of the variance; together_lines: over so many lines their correlation falls to 1/e.
    """

    rms: float
    column_share: float
    together_lines: float

    def correlation(self, lines: int) -> float:
        """Of two lines so far apart."""
        return between_lines(lines, self.together_lines)


@dataclass(frozen=True, slots=True, kw_only=True)
class TelegraphPixels:
    """A share of the pixels, drawn from `seed`, whose level jumps up by `amplitude_reads` read noises and down again.

    stay_exposures: mean stay in a level; differ: ratio of the largest to the smallest height, and of the longest to the shortest
    stay, of pixels that are even in the logarithm between them; heights and stays given are the middle ones.
    """

    share: float
    amplitude_reads: float
    stay_exposures: float
    seed: int = 0
    differ: float = 1.0

    def of_pixels(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Heights, read noises, and mean stays, exposures, of so many pixels (pixel,)."""
        if self.differ == 1.0:
            return np.full(count, self.amplitude_reads), np.full(count, self.stay_exposures)
        height, stay = self.differ ** (rng.random((2, count)) - 0.5)
        return self.amplitude_reads * height, np.maximum(self.stay_exposures * stay, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FinePicture:
    """A picture with sharp borders: cells finer than pixels, see `_fine_picture`.

    Fields: fine; scale: DN a unit of it; signal_DN (row, column): its pixel means.
    """

    fine: "FineCells"
    scale: float
    signal_DN: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LineState:
    """One series on its way through the line; maps are (row, column), or (1, 1) where all pixels are alike.

    Fields:
        parameters: (parameter,) of the spectral model, or None where the twin has none.
        attenuation_scale: material of the scene -> factor on its attenuation.
        signal_DN, variance_DN2: mean and quantum variance (secondary quanta in it) of one exposure, above dark, under
            even illumination, before any spread.
        secondary_DN: of the variance, what secondary quanta add for each DN of signal.
        picture: the signal as it was projected, finer than pixels, where it has sharp borders; what effects have made of
            `signal_DN` since is their difference.
        shift_px: of the object against its thickness maps, along rows and columns.
        course_px: where it stands in turn along rows and along columns, from there, equally long; empty: it stays.
        distortion_px: rms displacement of an enlargement and of a counter-clockwise turn of the picture.
        object_transfers: blur of what stands in the beam, to one side perhaps.
        optical_transfers: spread of light beyond the calibrated one, as factors on the picture's transfer function.
        tails: (weight, transfer) of light that takes another spread in place of the calibrated one.
        power_transfers: factors on the noise power that are not the square of a transfer function.
        flat_factor: change of the illumination against the calibrated flat, map or (1, 1).
        output_rms, output_correlation_s, output_jitter_share: common random factor of each exposure, its rms, correlation
            time, and the share of its variance that is new in every exposure.
        flicker: factors of the lines of an exposure, or None.
        lag: traps, or None.
        blind_per_DN: pile-up k of z = x / (1 + k x), x above dark, before the nonlinearity.
        gain_memory: of the light before, or None.
        bends: (b, p) of each term of the nonlinearity y = x (1 - sum b x^p), x above dark, DN.
        gain_pattern, tile_pattern: fixed patterns of the gain that calibration does not know, of pixels and of tiles.
        offsets: (DN, profile over the time in the session in s) added with or without beam.
        row_variance_DN2, column_variance_DN2: noise common to a row or column of one exposure; offsets_together_lines: over so many
            lines its correlation falls to 1/e.
        read_variance_taken_DN2: of the calibrated electronic variance, what effects that the calibration saw account for.
        step_DN: of the ADC; 0: none.
        bad_share, bad_hot_share: share of pixels that calibration does not know to be bad, and of these the hot ones, the
            rest being dead; bad_seed draws them.
        telegraph: pixels that jump, or None.
        repeated_share: chance of a stored frame to be a copy of the one before it in its series.
    """

    parameters: FloatArray | None
    attenuation_scale: Mapping[str, float] = field(default_factory=dict)
    signal_DN: FloatArray
    variance_DN2: FloatArray
    secondary_DN: float = 0.0
    picture: FinePicture | None = None
    shift_px: tuple[float, float] = (0.0, 0.0)
    course_px: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    distortion_px: tuple[float, float] = (0.0, 0.0)
    object_transfers: tuple[SidedTransfer, ...] = ()
    optical_transfers: tuple[Transfer, ...] = ()
    tails: tuple[tuple[float, Transfer], ...] = ()
    power_transfers: tuple[Transfer, ...] = ()
    flat_factor: FloatArray
    output_rms: float = 0.0
    output_correlation_s: float = 0.0
    output_jitter_share: float = 0.0
    flicker: LineFlicker | None = None
    lag: LagLaw | None = None
    gain_memory: GainMemory | None = None
    bends: tuple[tuple[float, float], ...] = ()
    blind_per_DN: float = 0.0
    gain_pattern: FixedPattern | None = None
    tile_pattern: TilePattern | None = None
    offsets: tuple[tuple[float, Callable[[FloatArray], FloatArray]], ...] = ()
    row_variance_DN2: float = 0.0
    column_variance_DN2: float = 0.0
    offsets_together_lines: float = EACH_LINE
    read_variance_taken_DN2: float = 0.0
    step_DN: float = 0.0
    bad_share: float = 0.0
    bad_hot_share: float = 0.5
    bad_seed: int = 0
    telegraph: TelegraphPixels | None = None
    repeated_share: float = 0.0


def _made_anew(owner: object, name: object, make: Callable[[], Any]) -> Any:
    """Where nothing is kept."""
    return make()


@dataclass(frozen=True, slots=True, kw_only=True)
class LineContext:
    """What an effect may know besides the state.

    Fields: twin; request; model (spectral, or None); since (`always` or `calibration`); weights (2, energy): what each
    energy of the open beam adds to signal and to quantum variance, any scale; energies_keV (energy,); project:
    (name, weights (k, energy)) -> maps (k, row, column) behind the scene, or (k, 1, 1) in the open field; open_signal_DN
    of one exposure; options of the effect that are words; made_of: (thing, name, make) -> what is made of a thing once, kept under
    the name for as long as others ask for it (small results alone).
    """

    twin: "Twin"
    request: "SeriesRequest"
    model: "SpectralModel | None"
    since: str
    weights: FloatArray | None
    energies_keV: FloatArray | None
    project: Callable[[str, FloatArray], FloatArray] | None
    open_signal_DN: float
    options: Mapping[str, str]
    made_of: Callable[[object, object, Callable[[], Any]], Any] = _made_anew

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the detector."""
        return self.twin.maps.shape

    @property
    def source_detector_mm(self) -> float | None:
        """Distance from source to detector in this series, or None."""
        return self.request.distances_mm(self.twin.instrument)[1]

    @property
    def source_object_mm(self) -> float | None:
        """Distance from source to object in this series, or None."""
        return self.request.distances_mm(self.twin.instrument)[0]

    @property
    def has_scene(self) -> bool:
        """Whether something of known thickness stands in the beam."""
        return bool(self.request.thickness_mm)


def needed(value: float | None, name: str, effect: str) -> float:
    """The value, or an InputError that says which effect needs it."""
    from ...errors import InputError

    if value is None:
        raise InputError(
            name,
            received="unknown",
            expected=f"a number, because the effect {effect} depends on it",
            remedy="state it in the acquisition's instrument or series",
        )
    return float(value)


Change = Callable[[LineState, Mapping[str, float], LineContext], LineState]
