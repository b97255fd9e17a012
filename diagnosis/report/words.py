"""How the answer calls probes, series, strengths and nuisances: in words of the field, not by the names of the code."""

import math
import re
from collections.abc import Sequence

from ...generator.effects import EFFECTS
from ..inference.inference import title_of
from ..judgement.answer import Cause, Place
from ..model.changes import EACH_SCENE

_SHAPED_LIKE = "like "  # templates of what effects would do
_KIND_WORDS = {"flat": "flats", "dark": "darks", "object": "objects", "afterglow": "frames after the beam"}
_AXIS_WORDS = {
    "level": "brightness",
    "noise": "noise",
    "sharpness": "sharpness at edges",
    "texture": "noise texture",
    "time": "change with time",
    "position": "pattern across the field",
    "energy": "change with tube voltage",
    "tails": "outlying pixels and codes",
}
# of statistics and of nuisances: a pattern of the whole name, and the words for it
_STATISTIC_WORDS = (
    (r"mean frame", ""),
    (r"log_variance (.+)", r"variance of the noise, \1"),
    (r"correlation (.+) \((-?\d+),(-?\d+)\)", r"correlation of the noise \2 rows and \3 columns apart, \1"),
    (r"row_ratio", "noise of row means"),
    (r"column_ratio", "noise of column means"),
    (r"block_ratio", "noise of block means"),
    (r"temporal_correlation (\d)", r"correlation of frames \1 apart"),
    (r"trend first frames", "change in the first frames"),
    (r"trend (.+)", r"\1 over the frames"),
    (r"kurtosis", "tails of the noise"),
    (r"frame_factor", "level from frame to frame"),
    (r"afterglow frames (\d+)-\1", r"frame \1 after the beam"),
    (r"afterglow frames (\d+)-(\d+)", r"frames \1 to \2 after the beam"),
    (r"fixed_pattern", "fixed pattern"),
    (r"fixed_pattern (.+)", r"fixed pattern of \1"),
)
_NUISANCE_WORDS = (
    (r"shape \d+ of (.+)", r"slow change of the field in \1"),
    (r"shape \d+ since the calibration", "slow change of the field since the calibration"),
    (r"gain of (.+)", r"photon-transfer gain at \1"),
    (r"dark of (.+)", r"dark level of \1"),
    (r"(open field of .+), [xy]", r"\1"),
    (r"(?:column|row) of (.+)", r"place of \1"),
    (r"rough edge \d+ of (.+)", r"rough edge of \1"),
    (r"(outline of .+) between points, .+", r"\1"),
    (r"(attenuation of .+) at .+ kV", r"\1"),
    (r"hardness at .+ behind (.+)", r"hardness of the beam behind \1"),
    (r"log_mu_(.+)", r"attenuation of \1"),
    (r"texture .+", "noise texture"),
    (r"read noise .+", "texture of the read noise"),
    (r"gain map .+", "gain map"),
    (r"tail of the spread, .+", "tail of the optical spread"),
    (r"optical spread as .+", "form of the optical spread"),
    (r"inherent_filtration_mm_Al", "inherent filtration"),
    (r"log_scintillator_thickness", "thickness of the scintillator"),
    (r"dead_layer_um", "dead layer of the scintillator"),
    (r"scintillator_table", "attenuation of the scintillator"),
    (r"kV_(?:error|tilt|variance)", "tube voltage"),
    (r"log_output|yield_exponent", "tube output"),
    (r"(?:end|hardness)_exponent|hardness_tilt|anode_roughness_um", "shape of the tube's spectrum"),
    (r"log_DN_per_keV", "DN a keV"),
    (r"log_swank|swank_exponent", "Swank factor of the light"),
    (r"light_(?:nonproportionality|exponent|depth_slope)", "light a keV"),
    (r"escape_scale", "K photons that escape"),
    (r"shared_charge", "charge that pixels share"),
    (r"cover_mm_(?:C|Al)", "cover of the detector"),
)


def _in_words(name: str, words: Sequence[tuple[str, str]]) -> str:
    """The words for a name; the name where none are known."""
    for pattern, text in words:
        found = re.fullmatch(pattern, name)
        if found:
            return found.expand(text)
    return name


def axis_text(axis: str) -> str:
    """An axis of the gap in words."""
    return _AXIS_WORDS.get(axis, axis)


def location_text(location: str) -> str:
    """Where within a series, in words; what effects would do is called by their titles."""
    if not location.startswith(_SHAPED_LIKE):
        return location
    return f"in the shape of: {title_of(location.removeprefix(_SHAPED_LIKE).split(' ')[0])}"


def statistic_text(statistic: str, location: str = "") -> str:
    """What a probe measures, and where."""
    return ", ".join(text for text in (_in_words(statistic, _STATISTIC_WORDS), location_text(location)) if text)


def place_text(place: Place) -> str:
    """A probe that departs, and how far."""
    return f"{axis_text(place.axis)} of {place.series} ({statistic_text(place.statistic, place.location)}, z {place.z:+.1f})"


def family_text(axis: str, kind: str, scene: str) -> str:
    """One axis of a kind of series, or of those of a scene."""
    return f"{axis_text(axis)} of {scene or _KIND_WORDS.get(kind, kind)}"


def nuisance_text(name: str) -> str:
    """What calibration or tables leave open; several numbers of one thing have the same words."""
    return _in_words(name, _NUISANCE_WORDS)


def strength_text(cause: Cause) -> str:
    """Strength with its 95 % interval and unit."""
    value, low, high = cause.strength
    digits = min(max(0, 2 - math.floor(math.log10(max(abs(value), 1e-9)))), 4)
    return f"{value:.{digits}f} {cause.unit} ({low:.{digits}f} to {high:.{digits}f})"


def meaning_text(effect: str) -> str:
    """What the strength of an effect is; empty where the catalogue does not hold it."""
    return EFFECTS[effect].strength.source.split(";")[0] if effect in EFFECTS else ""


def when_text(cause: Cause) -> str:
    """Since when, or in which series, a cause acts."""
    if cause.apart:
        return EACH_SCENE
    if cause.series:
        return f"in {', '.join(cause.series)} only"
    return "always there" if cause.since == "always" else "since the calibration"


def share_text(share: tuple[float, float, float] | None) -> str:
    """Share of the gap that an effect removes, in words where it removes none; empty where there was no gap to remove."""
    if share is None:
        return ""
    value = 100.0 * min(share[0], 1.0)
    return f"{value:.0f} %" if value >= 0.0 else f"grows by {-value:.0f} %"
