"""Frames that were lost between detector and disk: in their place the frame before stands once more.

Of the frames of a series a share s, drawn by chance, equal the one before them in every pixel. Level and noise of each are those of
any other; there are fewer exposures than frames. A lost frame that nothing stands for leaves no trace in the frames that are there.
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, InImages, Parameter, Reading, Shows


def _repeat_frames(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    return replace(state, repeated_share=min(parameters["strength"] / 100.0, 1.0))


DROPPED_FRAMES = Effect(
    id="dropped_frames",
    title="frames are lost, and the one before stands in their place",
    law=r"y_n \to y_{n-1}\ \text{with probability}\ s",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=30.0,
            default=5.0,
            source="share of the stored frames that are copies: a grabber or disk that cannot keep up; one in 200 to one in three",
            log=True,
            most=100.0,
        ),
    ),
    stage="readout",
    reference="lost frames are gaps in the frame identifiers that grabbers hand on: GenICam GenTL standard, BUFFER_INFO_FRAMEID",
    after_calibration=False,
    change=_repeat_frames,
    isolated_by="a long series whose frames carry numbers or times",
    shows=Shows(series=EVERY_SERIES, axis="time", flats=False),
    either_onset=True,
    absorbed="nothing",
    reading=Reading(probes=("repeated frames",), sd=0.0),  # copies are counted: chance alone is left
    # numbers of copies go as a root, which takes more strengths to follow than a line
    grid=Grid(shares=(0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    images=InImages(left_out="a copy among images is seen in no single one"),
)
