"""Forty sessions broken on purpose: does `raytwin check` say what is wrong, of the right series, and nothing else?

A plain simulator of a panel (quanta that are spread, read noise, pixels of unlike response and dark, a beam with a shape)
makes one good session; each case breaks one thing in it, in the frames or in the labels. A case is right if a finding with
the expected code stands at the series that was broken (or, where two series contradict each other, at one of the two), and
if no other error or warning is told. `calibrate` is then asked too: it must refuse with one line, give no gain, or come out
with the gain that the frames have in its interval; otherwise the case counts as calibrated wrongly, warning or not.

    python validation/broken_sessions.py --json build/broken_sessions.json
    python validation/broken_sessions.py --only turned_flat copied_frames --show
"""

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter

from raytwin.acquisition import write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import filters_from_text
from raytwin.checks.check import check_acquisition
from raytwin.checks.findings import FindingCode as F
from raytwin.cli import main as raytwin

SHAPE = (96, 128)
DARK_DN, READ_DN, GAIN_DN, SPREAD_PX, FULL_DN = 400.0, 5.0, 2.0, 0.7, 65535
# DN a mAs of one pixel by kV and filter: any numbers that rise with kV and fall with filter
RATE = {(40.0, ""): 6000.0, (40.0, "Cu:0.1"): 1500.0, (90.0, ""): 30000.0, (90.0, "Cu:0.1"): 18000.0}
BITS = 16


@dataclass(frozen=True, kw_only=True)
class One:
    """A series to be: its labels and its frames."""

    name: str
    kind: str
    frames: NDArray[Any]
    labels: dict[str, Any] = field(default_factory=dict)
    time_s: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class Panel:
    """What stays the same in a session: response and dark of each pixel, shape of the beam."""

    gain: NDArray[np.float64]
    dark_DN: NDArray[np.float64]
    beam: NDArray[np.float64]
    rng: np.random.Generator

    def frames(
        self, level_DN: float | NDArray[np.float64], count: int, *, gain_DN: float = GAIN_DN
    ) -> NDArray[np.float64]:
        """Frames of a mean level above dark (DN, a number or a map), not yet rounded."""
        mean = level_DN * self.beam * self.gain
        made = []
        for _ in range(count):
            quanta = self.rng.poisson(np.maximum(mean, 0.0) / gain_DN) * gain_DN
            # the spread acts on what the quanta depart by; the beam and the pixels' response are not blurred
            light = mean + gaussian_filter(quanta - mean, SPREAD_PX, mode="wrap")
            made.append(light + self.dark_DN + READ_DN * self.rng.standard_normal(mean.shape))
        return np.array(made)


def rounded(frames: NDArray[np.float64], top: float = FULL_DN) -> NDArray[np.uint16]:
    """As the ADC writes them."""
    return np.clip(np.rint(frames), 0, top).astype(np.uint16)


def panel_of(seed: int) -> Panel:
    """A panel drawn by a seed."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    return Panel(
        gain=1.0 + 0.01 * rng.standard_normal(SHAPE),
        dark_DN=DARK_DN + 4.0 * rng.standard_normal(SHAPE),
        beam=1.0 - 0.08 * (x + 0.2) ** 2 - 0.05 * y**2,
        rng=rng,
    )


def good_session(panel: Panel, *, frames: int = 8) -> list[One]:
    """Darks at two exposures, flats at two kV, with and without filter, at several currents, and flats to validate on."""
    series = [
        One(
            name=f"dark_{ms}", kind="dark", frames=rounded(panel.frames(0.0, frames)), labels={"exposure_ms": float(ms)}
        )
        for ms in (50, 100)
    ]
    for (kV, filter_text), rate in RATE.items():
        for mA in (1.0, 2.0, 4.0):
            for ms in (50, 100) if mA == 2.0 else (100,):
                if rate * mA * ms / 1000 > 14000:
                    continue
                name = f"flat_{kV:g}_{filter_text.replace(':', '') or 'open'}_{mA:g}mA_{ms}ms"
                labels = {
                    "kV": kV,
                    "current_mA": mA,
                    "exposure_ms": float(ms),
                    "filters": filters_from_text(filter_text),
                }
                series.append(
                    One(
                        name=name,
                        kind="flat",
                        frames=rounded(panel.frames(rate * mA * ms / 1000, frames)),
                        labels=labels,
                    )
                )
    start = 0.0
    timed = []
    for one in series:
        step = one.labels["exposure_ms"] / 1000.0 + 0.02
        timed.append(replace(one, time_s=start + step * np.arange(1, len(one.frames) + 1)))
        start += step * len(one.frames) + 5.0
    return timed


def write(path: Path, series: Sequence[One], **instrument: Any) -> None:
    """Write a session."""
    known: dict[str, Any] = {
        "bits": BITS,
        "pixel_mm": 0.15,
        "source_detector_mm": 1000.0,
        "source_object_mm": 900.0,
        "anode": "W",
        "scintillator": filters_from_text("CsI:0.5"),
    }
    with write_acquisition(path, Instrument(**(known | instrument))) as writer:
        for one in series:
            writer.add_series(one.name, kind=one.kind, frames=one.frames, time_s=one.time_s, **one.labels)


Session = list[One]
BRIGHT = "flat_90_Cu0.1_4mA_100ms"
VICTIM, OTHER, DARK = "flat_40_open_2mA_100ms", "flat_40_open_4mA_100ms", "dark_100"


@dataclass(frozen=True, kw_only=True)
class Case:
    """One broken session.

    Fields: code: what must be found (None: a reader's refusal); series: one of these must be named (empty: the file); make:
    breaks the session; also: further codes that follow from the same fault; instrument: changed words of it; gain_DN: least
    and most that the frames have over the field.
    """

    code: F
    series: tuple[str, ...]
    make: Callable[[Session, Panel], Session]
    also: tuple[F, ...] = ()
    instrument: dict[str, Any] = field(default_factory=dict)
    on_disk: Callable[[Path], None] | None = None
    gain_DN: Callable[[Panel], tuple[float, float]] = lambda panel: (GAIN_DN, GAIN_DN)


def edit(name: str, change: Callable[[One, Panel], One | None]) -> Callable[[Session, Panel], Session]:
    """Change one series, or take it out where the change gives nothing."""

    def make(session: Session, panel: Panel) -> Session:
        changed = [change(one, panel) if one.name == name else one for one in session]
        return [one for one in changed if one is not None]

    return make


def of_frames(name: str, change: Callable[[NDArray[Any], Panel], NDArray[Any]]) -> Callable[[Session, Panel], Session]:
    """Change the frames of one series."""
    return edit(name, lambda one, panel: replace(one, frames=change(one.frames, panel), time_s=None))


def of_labels(name: str, **labels: Any) -> Callable[[Session, Panel], Session]:
    """Change labels of one series."""
    return edit(name, lambda one, panel: replace(one, labels=one.labels | labels))


def all_frames(change: Callable[[One, Panel], NDArray[Any]]) -> Callable[[Session, Panel], Session]:
    """Change the frames of every series."""
    return lambda session, panel: [replace(one, frames=change(one, panel)) for one in session]


def disc(panel: Panel, row: float, column: float) -> NDArray[np.float64]:
    """Transmission of a dense disc."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return gaussian_filter(np.where(np.hypot(y - row, x - column) < 15, 0.4, 1.0), 0.8)


def turning(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """An object that moves on a little from frame to frame."""
    moved = [panel.frames(1200.0 * disc(panel, 48 + 3 * k, 60 - 2 * k), 1)[0] for k in range(len(frames))]
    return rounded(np.array(moved))


def nudged(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """A step wedge in the beam whose table moves by a pixel in the middle of the series."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    step = gaussian_filter(np.where(x + 0.15 * y < 60, 1.0, 0.3), 0.6)
    return rounded(np.array([panel.frames(1200.0 * np.roll(step, k // 4, axis=1), 1)[0] for k in range(len(frames))]))


def shuttered(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """A shutter covers half of the field from frame 4 on."""
    cover = np.ones(SHAPE)
    cover[40:] = 0.02
    return rounded(np.concatenate([panel.frames(1200.0, 4), panel.frames(1200.0 * cover, 4)]))


def beam_off(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """The tube shuts down after five frames."""
    return rounded(np.concatenate([panel.frames(1200.0, 5), panel.frames(0.0, 3)]))


def jpeg(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """Lossy compression of 8 x 8 blocks: small coefficients are rounded away."""
    rows, columns = SHAPE
    blocks = frames.astype(np.float64).reshape(len(frames), rows // 8, 8, columns // 8, 8)
    coefficients = dctn(blocks, axes=(2, 4), norm="ortho")
    wide = 40.0 * (1.0 + np.hypot(np.arange(8)[:, None, None], np.arange(8)[None, None, :]) / 3.0)
    coefficients = np.rint(coefficients / wide) * wide
    return rounded(idctn(coefficients, axes=(2, 4), norm="ortho").reshape(frames.shape))


def bad_chunk(path: Path) -> None:
    """Overwrite what lies in the middle of a series' numbers' place in the file, so that it is found not to be there."""
    with h5py.File(path, "r+") as file:
        group = file[f"series/{VICTIM}"]
        values = group["frames"][()].astype(np.float32)
        values[3, 10, 10] = np.nan
        del group["frames"]
        group["frames"] = values


def set_attribute(name: str, key: str, value: Any) -> Callable[[Path], None]:
    """Write an attribute as it stands."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file[f"series/{name}"].attrs[key] = value

    return change


def falling_times(path: Path) -> None:
    """The clock jumps back within a series."""
    with h5py.File(path, "r+") as file:
        file[f"series/{VICTIM}/time_s"][4:] -= 3.0


def cut(path: Path) -> None:
    """The copy of the file broke off."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])


def swap_frames(first: str, second: str) -> Callable[[Session, Panel], Session]:
    """The frames of two series stand under each other's names."""

    def make(session: Session, panel: Panel) -> Session:
        frames = {one.name: one.frames for one in session}
        other = {first: second, second: first}
        return [replace(one, frames=frames[other.get(one.name, one.name)]) for one in session]

    return make


def averaged(count: int) -> Callable[[NDArray[Any], Panel], NDArray[Any]]:
    """Each frame is the rounded mean of several exposures."""
    return lambda frames, panel: rounded(
        np.array([panel.frames(RATE[(40.0, "")] * 0.2, count).mean(axis=0) for _ in range(len(frames))])
    )


def mean_of_whole(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """Means of ten whole-numbered frames, kept as fractions."""
    made = [rounded(panel.frames(RATE[(40.0, "")] * 0.2, 10)).mean(axis=0) for _ in range(len(frames))]
    return np.array(made, dtype=np.float32)


def rows_exchanged(frames: NDArray[Any], panel: Panel) -> NDArray[Any]:
    """Two rows are read out in each other's place."""
    frames = frames.copy()
    frames[:, [30, 57]] = frames[:, [57, 30]]
    return frames


def corrected_flat(one: One, panel: Panel) -> NDArray[Any]:
    """Dark taken off, divided by response and beam, a pedestal put back."""
    if one.kind == "dark":
        return rounded(DARK_DN + READ_DN * panel.rng.standard_normal(one.frames.shape))
    return rounded((one.frames - panel.dark_DN) / (panel.gain * panel.beam) + DARK_DN)


CASES: dict[str, Case] = {
    "turning_object_in_one_series": Case(code=F.SCENE_CHANGES, series=(VICTIM,), make=of_frames(VICTIM, turning)),
    "moved_table": Case(code=F.SCENE_CHANGES, series=(VICTIM,), make=of_frames(VICTIM, nudged)),
    "shutter_half_way": Case(code=F.SCENE_CHANGES, series=(VICTIM,), make=of_frames(VICTIM, shuttered)),
    "beam_off_half_way": Case(code=F.SCENE_CHANGES, series=(VICTIM,), make=of_frames(VICTIM, beam_off)),
    "object_removed_half_way": Case(
        code=F.SCENE_CHANGES,
        series=(VICTIM,),
        make=of_frames(
            VICTIM, lambda x, p: rounded(np.concatenate([p.frames(1200.0 * disc(p, 50, 60), 3), p.frames(1200.0, 5)]))
        ),
    ),
    "level_jump": Case(
        code=F.LEVEL_JUMP,
        series=(VICTIM,),
        make=of_frames(VICTIM, lambda x, p: rounded(np.concatenate([p.frames(1200.0, 4), p.frames(1296.0, 4)]))),
    ),
    "frame_repeated_by_the_grabber": Case(
        code=F.COPIES, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: x[[0, 1, 2, 2, 2, 5, 6, 7]])
    ),
    "ring_buffer": Case(
        code=F.COPIES, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: x[[0, 1, 2, 3, 0, 1, 2, 3]])
    ),
    "same_files_twice": Case(
        code=F.SAME_AS,
        series=(VICTIM, "flat_again"),
        make=lambda session, panel: [
            *session,
            *(replace(one, name="flat_again", time_s=None) for one in session if one.name == VICTIM),
        ],
    ),
    "dark_under_a_flat_s_name": Case(
        code=F.SAME_AS,
        series=(VICTIM, DARK),
        make=lambda session, panel: [
            replace(one, frames=session[1].frames) if one.name == VICTIM else one for one in session
        ],
        also=(F.NO_LIGHT,),
    ),
    "averaged_rounded": Case(code=F.AVERAGED, series=(VICTIM,), make=of_frames(VICTIM, averaged(10))),
    "averaged_two": Case(code=F.AVERAGED, series=(VICTIM,), make=of_frames(VICTIM, averaged(3))),
    "averaged_fractions": Case(code=F.AVERAGED, series=(VICTIM,), make=of_frames(VICTIM, mean_of_whole)),
    "offset_corrected": Case(
        code=F.OFFSET_CORRECTED,
        series=("dark_50", DARK),
        make=all_frames(lambda one, panel: (one.frames - np.rint(panel.dark_DN)).astype(np.float32)),
    ),
    "dark_subtracted_and_cut_at_0": Case(
        code=F.CLIPPED,
        series=("dark_50", DARK),
        make=all_frames(lambda one, panel: rounded(one.frames - np.rint(panel.dark_DN))),
    ),
    "flat_corrected": Case(
        code=F.FLAT_CORRECTED,
        series=(OTHER,),
        make=all_frames(corrected_flat),
        also=(F.FLAT_CORRECTED,),
        # division by the beam divides the variance by its square
        gain_DN=lambda panel: (GAIN_DN / float(panel.beam.max()), GAIN_DN / float(panel.beam.min())),
    ),
    "transmission_images": Case(
        code=F.LOGARITHMS,
        series=(VICTIM,),
        make=of_frames(VICTIM, lambda x, p: ((x - p.dark_DN) / 1200.0).astype(np.float32)),
    ),
    "log_images": Case(
        code=F.LOGARITHMS,
        series=(VICTIM,),
        make=of_frames(VICTIM, lambda x, p: -np.log((x - p.dark_DN) / 1200.0).astype(np.float32)),
    ),
    "lossy_compression": Case(
        code=F.COMPRESSED, series=(VICTIM,), make=of_frames(VICTIM, jpeg), also=(F.AVERAGED, F.SCENE_CHANGES)
    ),
    "turned_by_180": Case(code=F.TURNED, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: x[:, ::-1, ::-1])),
    "mirrored_left_to_right": Case(code=F.TURNED, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: x[:, :, ::-1])),
    "mirrored_top_to_bottom": Case(code=F.TURNED, series=(OTHER,), make=of_frames(OTHER, lambda x, p: x[:, ::-1])),
    "another_region_read_out": Case(
        code=F.SHIFTED, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: np.roll(x, (2, -5), axis=(1, 2)))
    ),
    "two_rows_swapped": Case(code=F.ROWS_SWAPPED, series=(BRIGHT,), make=of_frames(BRIGHT, rows_exchanged)),
    "turned_by_90": Case(
        code=F.SHAPES,
        series=(VICTIM,),
        make=of_frames(VICTIM, lambda x, p: np.rot90(x, axes=(1, 2))),
        also=(F.TURNED,),
    ),
    "saturated": Case(
        code=F.SATURATED, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: rounded(p.frames(70000.0, 8)))
    ),
    "saturated_below_full_scale": Case(
        code=F.SATURATED,
        series=(VICTIM,),
        make=of_frames(VICTIM, lambda x, p: rounded(p.frames(1200.0, 8), 1620)),
    ),
    "constant_frames": Case(
        code=F.CONSTANT, series=(VICTIM,), make=of_frames(VICTIM, lambda x, p: np.full_like(x, 77))
    ),
    "dark_with_the_beam_on": Case(
        code=F.DARK_WITH_LIGHT,
        series=("dark_50",),
        make=of_frames("dark_50", lambda x, p: rounded(p.frames(2400.0, 8))),
    ),
    "kinds_mixed_up": Case(
        code=F.NO_LIGHT,
        series=(VICTIM,),
        make=swap_frames(VICTIM, "dark_50"),
        also=(F.DARK_WITH_LIGHT,),
    ),
    "wrong_current": Case(code=F.LABEL, series=(VICTIM,), make=of_labels(VICTIM, current_mA=3.0)),
    "wrong_exposure": Case(code=F.LOAD_LABEL, series=(VICTIM,), make=of_labels(VICTIM, exposure_ms=50.0)),
    "wrong_kV": Case(
        code=F.LABEL, series=("flat_90_Cu0.1_2mA_100ms",), make=of_labels("flat_90_Cu0.1_2mA_100ms", kV=40.0)
    ),
    "kV_of_two_beams_exchanged": Case(
        code=F.LABEL,
        series=tuple(
            f"flat_{kV}_open_{rest}" for kV in (40, 90) for rest in ("1mA_100ms", "2mA_100ms", "2mA_50ms", "4mA_100ms")
        ),
        make=lambda session, panel: [
            replace(one, labels=one.labels | {"kV": 130.0 - one.labels["kV"]})
            if one.kind == "flat" and not one.labels["filters"]
            else one
            for one in session
        ],
    ),
    "filter_left_out_of_the_label": Case(
        code=F.LABEL,
        series=("flat_40_Cu0.1_2mA_100ms",),
        make=of_labels("flat_40_Cu0.1_2mA_100ms", filters=()),
    ),
    "clock_in_milliseconds": Case(
        code=F.CLOCK_EXPOSURE,
        series=(VICTIM,),
        make=edit(VICTIM, lambda one, p: replace(one, time_s=one.time_s[0] + (one.time_s - one.time_s[0]) / 1000)),
    ),
    "frames_dropped_by_the_clock": Case(
        code=F.CLOCK_GAP,
        series=(VICTIM,),
        make=edit(VICTIM, lambda one, p: replace(one, time_s=one.time_s + np.where(np.arange(8) > 4, 0.5, 0.0))),
    ),
    "order_against_the_clock": Case(
        code=F.CLOCK_ORDER,
        series=(VICTIM, OTHER),
        make=lambda session, panel: [
            *session[:4],
            *(replace(one, time_s=one.time_s - 12.0) if one.name == OTHER else one for one in session[4:]),
        ],
    ),
    "no_darks": Case(
        code=F.NO_DARK, series=("",), make=lambda session, panel: [one for one in session if one.kind != "dark"]
    ),
    "value_that_is_no_number": Case(code=F.DAMAGED, series=(VICTIM,), make=lambda s, p: s, on_disk=bad_chunk),
    "clock_falls": Case(code=F.DAMAGED, series=("",), make=lambda s, p: s, on_disk=falling_times),
    "label_that_is_no_number": Case(
        code=F.DAMAGED, series=("",), make=lambda s, p: s, on_disk=set_attribute(VICTIM, "exposure_ms", "long")
    ),
    "file_cut_off": Case(code=F.DAMAGED, series=("",), make=lambda s, p: s, on_disk=cut),
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one case: told rightly; other errors and warnings told; what calibrate did."""

    right: bool
    others: list[str]
    line: str
    calibrate: str
    seconds: float


def calibrated(path: Path, folder: Path, gain_DN: tuple[float, float]) -> str:
    """`refused`, `right`, `no gain given`, `wrong, warned`, `wrong in silence` or `crashed`.

    Labels of the beam are taken out first: gain and noise do not need them, and the fit of a spectrum takes its time.
    """
    with contextlib.suppress(OSError), h5py.File(path, "r+") as file:
        for group in file["series"].values():
            for name in ("kV", "current_mA", "filter"):
                group.attrs.pop(name, None)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = raytwin(["calibrate", str(path), "-o", str(folder / "twin.h5"), "--json"])
    if code:
        lines = err.getvalue().splitlines()
        return "refused" if code == 2 and len(lines) == 1 else "crashed"
    levels = json.loads(out.getvalue())["levels"]
    if not levels or levels[0]["gain_DN"] is None:
        return "no gain given"
    if levels[0]["gain_DN_low"] <= gain_DN[1] and gain_DN[0] <= levels[0]["gain_DN_high"]:
        return "right"
    return "wrong, warned" if "warning" in err.getvalue() else "wrong in silence"


def run_case(name: str, *, seed: int = 1, calibrate: bool = True) -> Outcome:
    """Make, check and calibrate one broken session."""
    case = CASES[name]
    panel = panel_of(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        write(path, case.make(good_session(panel), panel), **case.instrument)
        if case.on_disk is not None:
            case.on_disk(path)
        start = time.perf_counter()
        result = check_acquisition(path)
        seconds = time.perf_counter() - start
        told = [item for item in result.findings if item.severity != "note"]
        hits = [item for item in told if item.code is case.code and item.series in case.series]
        others = [
            f"{item.code} {item.series}" for item in told if item.code is not case.code and item.code not in case.also
        ]
        elsewhere = [
            f"{item.code} {item.series}" for item in told if item.code is case.code and item.series not in case.series
        ]
        if case.code is F.FLAT_CORRECTED:
            elsewhere = []
        came = calibrated(path, Path(folder), case.gain_DN(panel)) if calibrate else ""
    line = f"{hits[0].series}: {hits[0].text}" if hits else ""
    return Outcome(right=bool(hits), others=[*others, *elsewhere], line=line, calibrate=came, seconds=seconds)


def good_outcome(seed: int) -> list[str]:
    """What is told of the good session: nothing must be."""
    panel = panel_of(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        write(path, good_session(panel))
        return [f"{item.code} {item.series}" for item in check_acquisition(path).findings if item.severity != "note"]


def main() -> None:
    """Run the cases and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--no-calibrate", action="store_true")
    parser.add_argument("--good", type=int, default=10, help="good sessions to check for false alarms")
    parser.add_argument("--show", action="store_true", help="print each line that was told")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    outcomes = {}
    for name in options.only:
        found = outcomes[name] = run_case(name, seed=options.seed, calibrate=not options.no_calibrate)
        print(
            f"{'right' if found.right else 'MISSED':7s}{name:34s}{found.calibrate:18s}{found.seconds:5.1f} s"
            f"  {'; '.join(found.others)}",
            flush=True,
        )
        if options.show and found.line:
            print(f"        {found.line}")
    alarms = [good_outcome(options.seed + 100 + number) for number in range(options.good)]
    right = sum(item.right for item in outcomes.values())
    alone = sum(item.right and not item.others for item in outcomes.values())
    silent = [
        name for name, item in outcomes.items() if item.calibrate in ("wrong in silence", "wrong, warned", "crashed")
    ]
    print(
        f"{right} of {len(outcomes)} told, {alone} of them and nothing else; good sessions with an alarm:"
        f" {sum(bool(item) for item in alarms)} of {len(alarms)} {[one for item in alarms for one in item]};"
        f" calibrated wrongly or crashed: {len(silent)} {silent}"
    )
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        rows = {
            name: {"right": item.right, "others": item.others, "line": item.line, "calibrate": item.calibrate}
            for name, item in outcomes.items()
        }
        options.json.write_text(json.dumps({"seed": options.seed, "cases": rows, "alarms": alarms}, indent=1) + "\n")


if __name__ == "__main__":
    main()
