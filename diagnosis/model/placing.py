"""Where scenes lie against their thickness maps, and what the model expects once they are drawn there."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.series_request import SeriesRequest
from ..arrays import BoolArray, FloatArray, RealArray
from ..probes.probes import ALONG_COLUMNS, ALONG_ROWS, Scalar
from ..probes.registration import (
    ANYWHERE_SD_PX,
    LARGEST_PX,
    SEEN_PX,
    Placement,
    left_over,
    register,
    register_drawn,
    without_border,
)
from ..probes.straight_edge import covered_scene
from ..session.even_maps import full_size, signal_map
from ..session.session import SessionSeries
from ..session.usable import SeenSeries
from . import changes as scales

SHARP_SCENES = ("edge", "disc")  # drawn true to their outline; steps of wedges and products only to their maps' pixels
_Blur = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
_PLACEMENTS = 2  # rounds in which a scene is drawn where it was found to lie
_CLOSER = 0.5  # of the displacement: what a round may add to it
# an edge that is smeared over many pixels: lengths of boxes along the belt, and standard deviations, px; a wedge that moved by 15 px
# was found 1.5 px from where it lies with a box of that length
_BOXES_PX = (5, 7, 9, 11, 13, 15, 17, 21, 25, 31, 37)
_GAUSSIANS_PX = (2.0, 3.0, 4.0, 6.0)
_SMEARED, _SMEARED_SIZES = 0.7, 3  # share of what is left that one of so many blurs must leave for others to be tried


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedSeries:
    """Series with their scenes drawn where they were found."""

    seen: tuple[SeenSeries, ...]  # in order of time, requests displaced
    placements: Mapping[str, Placement]  # of series whose scene was found, by name
    telling: Mapping[str, SeriesRequest]  # of each of these, the one of its place that tells the displacement


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredScenes:
    """What scenes are placed by."""

    pictures: Mapping[str, FloatArray]  # corrected mean frames (row, column), DN, by name of series
    clean: BoolArray  # (row, column): pixels in use that do not stand out
    sharp: bool  # pixels see no farther than themselves
    expect: Callable[[SeriesRequest], ExpectedSeries]  # asks the base twin

    def of(self, members: Sequence[SeenSeries]) -> list[FloatArray]:
        """Measured pictures of some series."""
        return [self.pictures[one.name] for one in members]

    def drawn(self, members: Sequence[SeenSeries], at: tuple[float, float]) -> list[FloatArray]:
        """Their pictures by the base twin with the scene displaced along rows and columns, px."""
        asked = [replace(one.session.request, displacement_px=at) for one in members]
        return [signal_map(self.expect(request), self.clean.shape) for request in asked]


def place_scenes(seen: Sequence[SeenSeries], measured: MeasuredScenes) -> PlacedSeries:
    """Registers every scene, all series of a place together."""
    placed = {one.name: one for one in seen}
    placements: dict[str, Placement] = {}
    telling: dict[str, SeriesRequest] = {}
    places: dict[tuple[str, float], list[SeenSeries]] = {}
    for one in seen:
        if one.session.series.kind == "object":
            places.setdefault(one.session.place, []).append(one)
    for stated in places.values():
        members, placement = _as_drawn(stated, measured)
        if placement is None:
            continue
        lies_px = placement.row_px, placement.column_px
        for one in members:
            placements[one.name] = placement
            request = replace(one.session.request, displacement_px=lies_px)
            placed[one.name] = replace(_asking(one, request), expected=measured.expect(request))
        # the series with the most light says most of where the scene lies
        tells = max(stated, key=_light_DN)
        telling |= {one.name: placed[tells.name].session.request for one in members}
    return PlacedSeries(seen=tuple(placed.values()), placements=placements, telling=telling)


def _asking(one: SeenSeries, request: SeriesRequest) -> SeenSeries:
    """A series with another request to the forward model."""
    return replace(one, session=replace(one.session, request=request))


def _light_DN(one: SeenSeries) -> float:
    """Light of all exposures of a series, mean over the pixels."""
    exposures = one.session.series.n_frames * one.session.request.exposures_per_frame
    return exposures * float(np.mean(one.expected.signal_DN))


def _as_drawn(members: Sequence[SeenSeries], measured: MeasuredScenes) -> tuple[Sequence[SeenSeries], Placement | None]:
    """Series of one place with the maps that show their scene more truly, and where it lies.

    A map of few points a pixel has stairs along a straight or round border; a pixel that sees its whole square has none.
    """
    placement = _placement(members, measured)
    asked = members[0].session.request
    covered = covered_scene(asked.scene_kind, asked.thickness_mm or {})
    if placement is None or covered is None:
        return members, placement
    others = [_asking(one, replace(one.session.request, thickness_mm=covered)) for one in members]

    def left(drawn: Sequence[SeenSeries]) -> float:
        at = (placement.row_px, placement.column_px)
        here = replace(placement, row_px=0.0, column_px=0.0)
        return left_over(measured.of(drawn), measured.drawn(drawn, at), measured.clean, here)

    if left(others) >= left(members):
        return members, placement
    others = [replace(one, expected=measured.expect(one.session.request)) for one in others]
    return others, _placement(others, measured)


def _placement(members: Sequence[SeenSeries], measured: MeasuredScenes) -> Placement | None:
    """Where the scene of series of one place lies; None: nothing shows it, or it is nowhere near its maps."""
    clean, sharp = measured.clean, measured.sharp
    shape, seen = clean.shape, measured.of(members)
    noises = [
        full_size(one.expected.quantum_variance_DN2 + one.expected.white_variance_DN2, shape)
        / one.session.series.n_frames
        for one in members
    ]
    pictured = [signal_map(one.expected, shape) for one in members]
    found = register(seen, pictured, noises, clean)
    if not found.found:
        return None

    def drawn(at: tuple[float, float]) -> list[FloatArray]:
        return measured.drawn(members, at)

    # drawn where it lies, an edge shows what is left of its displacement more truly than any resampled picture
    if sharp or members[0].session.request.scene_kind in SHARP_SCENES:
        found = register_drawn(seen, drawn, noises, clean, found, whole_cells=sharp)
    else:
        # steps of many heights: their places are told by slopes, not by what is left, which other things make as well
        found, blur = _smeared([one.session for one in members], seen, pictured, noises, clean, found)
        for _ in range(_PLACEMENTS):
            rest = register(seen, blur(drawn((found.row_px, found.column_px))), noises, clean)
            if math.hypot(rest.row_px, rest.column_px) > _CLOSER * math.hypot(found.row_px, found.column_px):
                break  # it leads away: something else is seen than a displacement
            found = replace(rest, row_px=found.row_px + rest.row_px, column_px=found.column_px + rest.column_px)
    # nowhere near its maps: compared as it is, and the gap says so
    return found if math.hypot(found.row_px, found.column_px) <= LARGEST_PX else None


def _smeared(
    members: Sequence[SessionSeries],
    seen: Sequence[FloatArray],
    pictured: Sequence[FloatArray],
    noises: Sequence[RealArray],
    clean: BoolArray,
    found: Placement,
) -> tuple[Placement, _Blur]:
    """Where a scene lies whose pictures are smeared by more than slopes show, and the blur that leaves least of them."""
    from scipy.ndimage import gaussian_filter, uniform_filter1d

    exposures_ms = [item.request.exposure_ms for item in members]
    # where no series says how long it was all count as equally long
    shares = [one / max(exposures_ms) if max(exposures_ms) > 0.0 else 1.0 for one in exposures_ms]
    axis = 1 if members[0].request.belt_axis == "column" else 0

    def box(length_px: float) -> _Blur:
        def blur(pictures: Sequence[FloatArray]) -> list[FloatArray]:
            # odd: an even box would move them by half a pixel
            lengths = [max(2 * round((length_px * share - 1.0) / 2.0) + 1, 1) for share in shares]
            return [uniform_filter1d(one, at, axis=axis) for one, at in zip(pictures, lengths, strict=True)]

        return blur

    def gaussian(sd_px: float) -> _Blur:
        return lambda pictures: [gaussian_filter(one, sd_px) for one in pictures]

    # smeared, it may be found far from where it lies
    unmoved = replace(found, row_px=0.0, column_px=0.0)
    best: tuple[Placement, _Blur, float] = found, lambda pictures: pictures, left_over(seen, pictured, clean, found)
    for make, sizes in ((box, _BOXES_PX), (gaussian, _GAUSSIANS_PX)):
        here = best[2]
        tried = [make(size)(pictured) for size in sizes[:_SMEARED_SIZES]]
        if min(left_over(seen, one, clean, at) for one in tried for at in (found, unmoved)) > _SMEARED * here:
            continue
        for size in sizes:
            blur = make(size)
            blurred = blur(pictured)
            placed = register(seen, blurred, noises, clean)
            rest = left_over(seen, blurred, clean, placed)
            if rest > here:
                break
            here = rest
            if here < best[2]:
                best = placed, blur, here
    return best[0], best[1]


def inside(mask: BoolArray, placement: Placement) -> BoolArray:
    """The mask (row, column) less the border that a displaced picture does not cover."""
    return without_border(mask, 2 + math.ceil(max(abs(placement.row_px), abs(placement.column_px))))


def displacement_probes(placement: Placement, *, between_points: bool) -> list[Scalar]:
    """The displacement as probes, px, along the axes where it is seen.

    between_points: the scene's borders lie anywhere between the points of its maps, along lines of pixels.
    """
    stated_px = math.hypot(scales.POSITION_SD_PX, ANYWHERE_SD_PX if between_points else 0.0)
    return [
        Scalar(axis="sharpness", name=name, unit="px", value=value, sd=math.hypot(sd, stated_px), sampling_sd=sd)
        for name, value, sd in (
            (ALONG_ROWS, placement.row_px, placement.row_sd_px),
            (ALONG_COLUMNS, placement.column_px, placement.column_sd_px),
        )
        if sd < SEEN_PX
    ]
