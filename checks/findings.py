"""What a check may find: one code, one severity and one sentence each. Sentences are made from a finding's values, last."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_NAMED = 3  # series that fit into a line


class Severity(enum.StrEnum):
    """How much a finding matters: `error` misleads a calibration or stops it, `warning` may, `note` is worth knowing."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class FindingCode(enum.StrEnum):
    """What was found; the value is what the JSON answer says."""

    DAMAGED = "damaged"
    UNKNOWN = "unknown_word"
    CORRECTED_FLATS = "corrected_flats"
    NO_DARK = "no_dark"
    NO_FLAT = "no_flat"
    SHAPES = "shapes_differ"
    SMALL = "frames_too_small"
    NO_KV = "no_kV"
    MISSING = "missing_information"
    SINGLE_FRAME = "single_frame"
    SCENE_CHANGES = "scene_changes"
    LEVEL_JUMP = "level_jump"
    COPIES = "copied_frames"
    SAME_AS = "copied_series"
    CONSTANT = "constant_frames"
    SATURATED = "saturated"
    CLIPPED = "clipped_at_zero"
    OFFSET_CORRECTED = "offset_corrected"
    FLAT_CORRECTED = "flat_corrected"
    LOGARITHMS = "logarithms"
    AVERAGED = "averaged"
    COMPRESSED = "compressed"
    CODE_STEP = "code_step"
    TURNED = "turned"
    SHIFTED = "shifted"
    ROWS_SWAPPED = "rows_swapped"
    NO_LIGHT = "no_light"
    DARK_WITH_LIGHT = "dark_with_light"
    SHADOW = "shadow_in_flat"
    MAPS = "maps_against_frames"
    LABEL = "label_against_frames"
    LOAD_LABEL = "load_against_level"
    SPECTRUM = "no_spectrum_fits"
    STOPS = "numbers_stop_early"
    CLOCK_STANDS = "clock_stands"
    CLOCK_GAP = "clock_gap"
    CLOCK_EXPOSURE = "clock_against_exposure"
    CLOCK_ORDER = "clock_against_index"
    TWIN_WARNING = "twin_warning"
    NO_SIDECAR = "no_sidecar"


# findings on series that contradict each other though every label may be right
NOT_OF_LABELS = (FindingCode.SPECTRUM, FindingCode.STOPS)


@dataclass(frozen=True, slots=True)
class _Entry:
    severity: Severity
    text: str


_ENTRIES: dict[FindingCode, _Entry] = {
    FindingCode.DAMAGED: _Entry(Severity.ERROR, "{what}"),
    FindingCode.UNKNOWN: _Entry(Severity.ERROR, "{what}"),
    FindingCode.CORRECTED_FLATS: _Entry(
        Severity.ERROR,
        "all flats are divided by a gain map or are logarithms, so they hold neither level nor noise: export them raw, or with"
        " the offset alone subtracted",
    ),
    FindingCode.NO_DARK: _Entry(
        Severity.ERROR,
        "no dark series and frames that are not offset-corrected: measure darks (beam off, same exposure), or declare"
        " counting = true for a detector that counts photons",
    ),
    FindingCode.NO_FLAT: _Entry(
        Severity.ERROR, "no flat series: there is nothing to calibrate gain, noise or blur from"
    ),
    FindingCode.SHAPES: _Entry(
        Severity.ERROR, "{shape} pixels, where {other} has {other_shape}: darks and flats need one shape"
    ),
    FindingCode.SMALL: _Entry(
        Severity.ERROR,
        "frames of {shape} pixels, where gain and spread need 8 x 8 or more: stack lines of a line camera, a hundred or more a frame",
    ),
    FindingCode.NO_KV: _Entry(
        Severity.WARNING,
        "{count} flats state a current or power and no kV: flats of several voltages cannot be distinguished, and nothing is known of"
        " the spectrum; write the kV of every flat",
    ),
    FindingCode.MISSING: _Entry(Severity.NOTE, "{what}"),
    FindingCode.SINGLE_FRAME: _Entry(
        Severity.WARNING,
        "one frame alone has no noise: take two or more, ten are better (keep single frames unaveraged)",
    ),
    FindingCode.SCENE_CHANGES: _Entry(
        Severity.ERROR,
        "frame {frame} does not show what the frames before it show ({how}): these are no repeats and hold no noise;"
        " declare one series a scene (a turning object: one series a projection)",
    ),
    FindingCode.LEVEL_JUMP: _Entry(
        Severity.WARNING,
        "the level jumps by {percent:+.2g} % from frame {frame} on: split the series there, or leave it out",
    ),
    FindingCode.COPIES: _Entry(
        Severity.WARNING,
        "{count} of {frames} frames are copies of earlier ones (first: frame {first}, of frame {origin}): dropped frames that"
        " the grabber repeated; each is counted once",
    ),
    FindingCode.SAME_AS: _Entry(
        Severity.ERROR, "{count} frames are copies of frames of series {other}: the same files under two names"
    ),
    FindingCode.CONSTANT: _Entry(Severity.ERROR, "every value is {value:g} DN: no picture was taken"),
    FindingCode.SATURATED: _Entry(
        Severity.ERROR,
        "{percent:.3g} % of the values stand at {top:g} DN: saturated; lower the current or the exposure",
    ),
    FindingCode.CLIPPED: _Entry(
        Severity.WARNING,
        "{percent:.2g} % of the values are 0: noise below zero is cut off, so dark level and read noise are not to be had;"
        " turn the camera's own dark subtraction off, or raise its offset",
    ),
    FindingCode.OFFSET_CORRECTED: _Entry(
        Severity.ERROR,
        "the dark level is {level:.3g} DN and values are negative: the dark is subtracted already; declare"
        ' corrected = "offset"',
    ),
    FindingCode.FLAT_CORRECTED: _Entry(
        Severity.WARNING,
        "pixels respond alike within {percent:.2g} %: the frames look flat-corrected; if they are, declare"
        ' corrected = "offset+gain" and calibrate from raw frames',
    ),
    FindingCode.LOGARITHMS: _Entry(
        Severity.ERROR,
        "values from {low:.3g} to {high:.3g} are no detector numbers: fractions of the open beam or their logarithm; export"
        " raw frames",
    ),
    FindingCode.AVERAGED: _Entry(
        Severity.ERROR,
        "each frame looks like the mean of {count} ({how}), not of {declared}: declare averaged = {count}",
    ),
    FindingCode.COMPRESSED: _Entry(
        Severity.ERROR,
        "noise stops at the borders of 8 x 8 pixels: the frames went through lossy compression, their noise is not the"
        " detector's; export uncompressed",
    ),
    FindingCode.CODE_STEP: _Entry(
        Severity.NOTE,
        "numbers go in steps of {step:g} DN: lost low bits or left-aligned ones; gains are scaled with them",
    ),
    FindingCode.TURNED: _Entry(
        Severity.ERROR, "the pixels' pattern is that of {other} {how}: one of the two was stored turned or mirrored"
    ),
    FindingCode.SHIFTED: _Entry(
        Severity.ERROR,
        "the pixels' pattern is that of {other} moved by {rows} rows and {columns} columns: another region was read out",
    ),
    FindingCode.ROWS_SWAPPED: _Entry(
        Severity.ERROR, "rows {first} and {second} have changed places against {other}: repair the reading-out of one"
    ),
    FindingCode.NO_LIGHT: _Entry(
        Severity.ERROR,
        "a flat that shows no beam ({signal:.3g} DN above the dark): the beam was off or too weak to show, or it is a dark",
    ),
    FindingCode.DARK_WITH_LIGHT: _Entry(
        Severity.ERROR,
        "a dark of {level:.4g} DN, where the other darks let expect {dark:.4g} DN: the beam was on, or it is a flat",
    ),
    FindingCode.SHADOW: _Entry(
        Severity.ERROR,
        "a flat whose brightness varies by {percent:.0f} % over the field, as no other flat's does: something stood in the beam",
    ),
    FindingCode.MAPS: _Entry(Severity.ERROR, "{what}"),
    FindingCode.LABEL: _Entry(Severity.ERROR, "{what}: correct the label, or leave the series out"),
    FindingCode.LOAD_LABEL: _Entry(
        Severity.ERROR,
        "its level is {percent:+.0f} % off what {quantity} says by the other flats of this beam; it fits {fits:.4g} {unit}"
        " rather than {declared:.4g} {unit}",
    ),
    FindingCode.SPECTRUM: _Entry(
        Severity.ERROR,
        "levels and noise of the flats fit no tube and scintillator at the kV, filters and load they state ({what})",
    ),
    FindingCode.STOPS: _Entry(
        Severity.ERROR,
        "numbers stop at {top:.0f} DN, whatever the beam, and go on to {reached:.0f} DN in {other}: something cuts them off that"
        " was not there always",
    ),
    FindingCode.CLOCK_STANDS: _Entry(
        Severity.WARNING, "{count} frames have the time of the frame before: the clock is coarser than the frame rate"
    ),
    FindingCode.CLOCK_GAP: _Entry(
        Severity.WARNING,
        "{count} gaps in time_s, the longest before frame {frame} ({gap:.3g} s, else {usual:.3g} s): frames were dropped",
    ),
    FindingCode.CLOCK_EXPOSURE: _Entry(
        Severity.ERROR,
        "a frame every {interval_ms:.4g} ms cannot have been exposed for {exposure_ms:.4g} ms: look at"
        " exposure_ms, or time_s is not in seconds",
    ),
    FindingCode.CLOCK_ORDER: _Entry(
        Severity.WARNING,
        "it begins before {other} by time_s but comes after it by index: drift would be read backwards",
    ),
    FindingCode.TWIN_WARNING: _Entry(Severity.WARNING, "{what}"),
    FindingCode.NO_SIDECAR: _Entry(
        Severity.ERROR, "images without a raytwin.toml that says what they are: write one, a draft stands below"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a check found.

    Fields: code; series (its name, empty: of the whole file); others (further series that it concerns); values (what the sentence
    is made of).
    """

    code: FindingCode
    series: str = ""
    others: tuple[str, ...] = ()
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all series that it concerns."""
        return (self.series, *self.others) if self.series else ()

    @property
    def line(self) -> str:
        """The sentence after the series that it is about."""
        named = ", ".join(self.names[:_NAMED]) + (
            f" and {len(self.names) - _NAMED} more" if len(self.names) > _NAMED else ""
        )
        return f"{named}: {self.text}" if named else self.text

    @property
    def severity(self) -> Severity:
        """How much it matters."""
        return _ENTRIES[self.code].severity

    @property
    def text(self) -> str:
        """One sentence: what was seen and what to do."""
        return _ENTRIES[self.code].text.format(**self.values)

    def to_dict(self) -> dict[str, str]:
        """`code`, `series`, `text`, `severity`."""
        return {
            "code": str(self.code),
            "series": self.series,
            "text": self.text,
            "severity": str(self.severity),
        }
