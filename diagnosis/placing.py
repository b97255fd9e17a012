"""Where scenes lie against their thickness maps, and what the model expects once they are drawn there."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..generator.series import ExpectedSeries, SeriesRequest
from . import changes as scales
from .even_maps import full_size, signal_map
from .probes import Scalar
from .registration import LARGEST_PX, Placement, register, register_drawn
from .session import SessionSeries

ALONG_ROWS, ALONG_COLUMNS = "displacement along rows", "displacement along columns"
SHARP_SCENES = ("edge", "disc")  # drawn true to their outline; steps of wedges and products only to their maps' pixels
_PLACEMENTS = 2  # rounds in which a scene is drawn where it was found to lie
_CLOSER = 0.5  # of the displacement: what a round may add to it
_SEEN_PX = 0.3  # standard deviation below which a displacement is a probe


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedSeries:
    """Series with their scenes drawn where they were found.

    Fields: kept, in order of time, requests displaced; expected: of these, by name; placements: of series whose scene was
    found, by name; telling: names of the series, one a place, that tell the displacement.
    """

    kept: tuple[SessionSeries, ...]
    expected: Mapping[str, ExpectedSeries]
    placements: Mapping[str, Placement]
    telling: frozenset[str]


def place_scenes(
    kept: Sequence[SessionSeries],
    expected: Mapping[str, ExpectedSeries],
    pictures: Mapping[str, NDArray[np.float64]],
    *,
    clean: NDArray[np.bool_],
    sharp: bool,
    expect: Callable[[SeriesRequest], ExpectedSeries],
) -> PlacedSeries:
    """Registers every scene, all series of a place together.

    Args:
        kept: series that can be compared.
        expected: by the base twin, scenes where their maps have them, by name.
        pictures: corrected mean frames (row, column), DN, by name.
        clean: pixels in use that do not stand out (row, column).
        sharp: pixels see no farther than themselves.
        expect: asks the base twin.
    """
    requests: dict[str, SeriesRequest] = {}
    drawn = dict(expected)
    placements: dict[str, Placement] = {}
    telling: set[str] = set()
    for members in _places(kept).values():
        placement = _placement(members, expected, pictures, clean=clean, sharp=sharp, expect=expect)
        if placement is None:
            continue
        telling.add(members[0].name)
        for item in members:
            placements[item.name] = placement
            requests[item.name] = replace(item.request, displacement_px=(placement.row_px, placement.column_px))
            drawn[item.name] = expect(requests[item.name])
    return PlacedSeries(
        kept=tuple(replace(item, request=requests.get(item.name, item.request)) for item in kept),
        expected=drawn,
        placements=placements,
        telling=frozenset(telling),
    )


def _places(kept: Sequence[SessionSeries]) -> dict[tuple[str, float], list[SessionSeries]]:
    """Object series by where their scene stood."""
    places: dict[tuple[str, float], list[SessionSeries]] = {}
    for item in kept:
        if item.series.kind == "object":
            places.setdefault((item.series.scene, item.request.source_object_mm or 0.0), []).append(item)
    return places


def _placement(
    members: Sequence[SessionSeries],
    expected: Mapping[str, ExpectedSeries],
    pictures: Mapping[str, NDArray[np.float64]],
    *,
    clean: NDArray[np.bool_],
    sharp: bool,
    expect: Callable[[SeriesRequest], ExpectedSeries],
) -> Placement | None:
    """Where the scene of series of one place lies; None: nothing shows it, or it is nowhere near its maps."""
    shape = clean.shape
    seen = [pictures[item.name] for item in members]
    noises = [
        full_size(expected[item.name].quantum_variance_DN2 + expected[item.name].white_variance_DN2, shape)
        / item.series.n_frames
        for item in members
    ]
    found = register(seen, [signal_map(expected[item.name], shape) for item in members], noises, clean)
    if not found.found:
        return None

    def drawn(at: tuple[float, float]) -> list[NDArray[np.float64]]:
        return [signal_map(expect(replace(item.request, displacement_px=at)), shape) for item in members]

    # drawn where it lies, an edge shows what is left of its displacement more truly than any resampled picture
    if sharp or members[0].request.scene_kind in SHARP_SCENES:
        found = register_drawn(seen, drawn, noises, clean, found, whole_cells=sharp)
    else:
        # steps of many heights: their places are told by slopes, not by what is left, which other things make as well
        for _ in range(_PLACEMENTS):
            rest = register(seen, drawn((found.row_px, found.column_px)), noises, clean)
            if math.hypot(rest.row_px, rest.column_px) > _CLOSER * math.hypot(found.row_px, found.column_px):
                break  # it leads away: something else is seen than a displacement
            found = replace(rest, row_px=found.row_px + rest.row_px, column_px=found.column_px + rest.column_px)
    # nowhere near its maps: compared as it is, and the gap says so
    return found if math.hypot(found.row_px, found.column_px) <= LARGEST_PX else None


def inside(mask: NDArray[np.bool_], placement: Placement) -> NDArray[np.bool_]:
    """The mask (row, column) less the border that a displaced picture does not cover."""
    margin = 2 + math.ceil(max(abs(placement.row_px), abs(placement.column_px)))
    covered = np.zeros_like(mask)
    covered[margin:-margin, margin:-margin] = mask[margin:-margin, margin:-margin]
    return covered


def displacement_probes(placement: Placement) -> list[Scalar]:
    """The displacement as probes, px, along the axes where it is seen."""
    return [
        Scalar(
            axis="sharpness",
            name=name,
            unit="px",
            value=value,
            sd=math.hypot(sd, scales.POSITION_SD_PX),
            sampling_sd=sd,
        )
        for name, value, sd in (
            (ALONG_ROWS, placement.row_px, placement.row_sd_px),
            (ALONG_COLUMNS, placement.column_px, placement.column_sd_px),
        )
        if sd < _SEEN_PX
    ]
