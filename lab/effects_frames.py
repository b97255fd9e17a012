"""Effects from frame to frame: frames that are lost."""

from typing import Any

from numpy.typing import NDArray

from .chain import FrameContext, Stage
from .effect import Asked, EffectLaw, Site, planted
from .effects_detector import frame_rng
from .line import Planted

# --- frames that are lost ---------------------------------------------------------------------------------------------

_MEAN_STALL = 1.5  # frames


def _dropped_frames(request: Asked, site: Site) -> Planted:
    """A grabber that stalls now and then, for one frame or more: the last frame in its buffer is stored again."""
    share = request.strength / 100.0
    # stalls begin after a good frame; their length is geometric
    stays = 1.0 - 1.0 / _MEAN_STALL
    begins = min(share / (1.0 - share) / _MEAN_STALL, 1.0)

    def grab(numbers: NDArray[Any], context: FrameContext) -> NDArray[Any]:
        series, stalled, buffer = context.memory.get("dropped_frames", (None, False, None))
        chance = stays if stalled else begins
        stalled = series == context.series and frame_rng(context, 16).random() < chance
        stored: NDArray[Any] = buffer if stalled else numbers
        context.memory["dropped_frames"] = context.series, stalled, stored
        return stored.copy()

    return planted(
        request,
        "a grabber that stalls for 1.5 frames on average and stores its last frame again",
        {"stalls_a_frame": begins, "mean_stall_frames": _MEAN_STALL},
        stages=(("digitise", Stage(name="dropped_frames", apply=grab, additive=False)),),
    )


FRAME_LAWS: tuple[EffectLaw, ...] = (
    EffectLaw(
        id="dropped_frames",
        title="frames that are lost and repeated",
        unit="%",
        low=0.5,
        high=30.0,
        since="always",
        build=_dropped_frames,
    ),
)
