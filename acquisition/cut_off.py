"""Frames that end at 0: what a camera that subtracts its own dark writes as unsigned numbers.

Where the level lies within a few standard deviations of 0, noise below 0 is gone: the mean is too high (by 0.4 standard deviations
of a dark), the variance too low (0.34 of it). Darks of such a camera tell neither offset nor read noise; what light leaves in deep
shadow is not the mean of its photons. A panel that counts photons has zeros, too, and loses nothing by it.
"""

from dataclasses import replace

import numpy as np

from .acquisition_io import AcquisitionFile, Series

_FRAMES = 4
_CUT_OFF = 0.25  # share of zeros: the level is less than about half a standard deviation above 0
_SILENT = 0.97  # share of zeros beyond which a dark has no noise to be cut off: a panel that counts
_SHOWN = 4  # names in a line


def share_of_zeros(series: Series) -> float:
    """Share of exact zeros in the last frames of a series; 0 where any number is negative, as these were not cut off."""
    frames = series.read_frames(max(0, series.n_frames - _FRAMES), series.n_frames)
    if frames.size == 0 or not bool(np.all(frames >= 0)):
        return 0.0
    return float(np.count_nonzero(frames == 0)) / frames.size


def without_cut_off_darks(acquisition: AcquisitionFile) -> tuple[AcquisitionFile, tuple[str, ...]]:
    """An acquisition less the darks and afterglows whose noise was cut off at 0, and what is to be said of it.

    Where no dark is left of those that calibrate (all darks, where none says so), the camera subtracted them from all frames: the
    other series are marked as corrected for `offset`.

    Args:
        acquisition: open file; the result reads from it.
    """
    shares = {item.name: share_of_zeros(item) for item in acquisition.series if item.kind in ("dark", "afterglow")}
    cut = {name: share for name, share in shares.items() if _CUT_OFF < share < _SILENT}
    if not cut:
        return acquisition, ()
    kept = tuple(item for item in acquisition.series if item.name not in cut)
    said = _said(cut)
    raw = [item.name for item in kept if "offset" not in item.corrected]
    darks = acquisition.of_kind("dark")
    calibrating = [item for item in darks if item.role == "calibration"] or darks
    if raw and calibrating and all(item.name in cut for item in calibrating):
        kept = tuple(replace(item, corrected=item.corrected | {"offset"}) for item in kept)
        said += "; no other dark is left: frames count as `corrected` for `offset`, as by a camera that subtracts its own dark"
    return replace(acquisition, series=kept), (said,)


def _said(cut: dict[str, float]) -> str:
    """Which series were cut off, by name and share of zeros."""
    low, high = (f"{100.0 * share:.0f}" for share in (min(cut.values()), max(cut.values())))
    share = low if low == high else f"{low} to {high}"
    if len(cut) == 1:
        return f"{next(iter(cut))}: {share} % of its numbers are 0: noise below 0 was cut off, and it tells neither offset nor noise"
    shown = ", ".join(list(cut)[:_SHOWN]) + (f" and {len(cut) - _SHOWN} more" if len(cut) > _SHOWN else "")
    return (
        f"{shown}: {share} % of their numbers are 0: noise below 0 was cut off, and they tell neither offset nor noise"
    )
