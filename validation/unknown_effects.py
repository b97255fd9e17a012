"""Diagnoses of sessions with an effect that is in no catalogue, on lines of `third_simulator.py`: what is it called?

The effect acts after the calibrating series, in light or in numbers. The answer should be an effect that is not in the catalogue, or
one of the same physics, which `accepted` names. Strengths are choices: each shows in the frames at a glance.

    python validation/unknown_effects.py
    python validation/unknown_effects.py --cases smear,compressed --seed 7 --keep build/unknown_effects
"""

import argparse
import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter, median_filter
from third_simulator import LINES, LineOf, Session, answer_text, diagnosis_of

from raytwin.errors import InputError

BLOCK = 8  # pixels along a side of what compression transforms


@dataclass(frozen=True, kw_only=True)
class Case:
    """An effect: on light, keV a pixel, or on numbers, DN; the line; what its planted companions are; names that may stand for it."""

    on_light: Callable[["WithEffect", np.ndarray], np.ndarray] | None = None
    on_numbers: Callable[["WithEffect", np.ndarray], np.ndarray] | None = None
    line: str = "A"
    beside: tuple[tuple[str, float], ...] = ()
    accepted: tuple[str, ...] = ()


class WithEffect(Session):
    """A session with an effect of no catalogue, whose randomness leaves the session's own as it is."""

    def __init__(self, of: LineOf, case: Case, rng: np.random.Generator, own_rng: np.random.Generator) -> None:
        super().__init__(of, dict(case.beside), rng)
        self.case, self.own_rng = case, own_rng
        self.down, self.right = np.indices(of.shape)
        self.first, self.phase, self.last = True, 0.0, np.zeros(of.shape)
        self.with_beam = False

    def add(self, name: str, kind: str, frames: int, shot, **more) -> None:
        """Frames of a series."""
        self.with_beam, self.first = kind in ("flat", "object"), True
        super().add(name, kind, frames, shot, **more)

    def _read(self, light: np.ndarray, exposure_ms: float, slow: np.ndarray, after: bool) -> np.ndarray:
        if after and self.with_beam and self.case.on_light is not None:
            light = self.case.on_light(self, light)
        numbers = super()._read(light, exposure_ms, slow, after)
        if after and self.case.on_numbers is not None:
            numbers = np.rint(self.case.on_numbers(self, numbers.astype(float)))
        self.first = False
        return np.clip(numbers, 0, 2**self.of.bits - 1).astype(np.uint16)


def backscatter(session: WithEffect, light: np.ndarray) -> np.ndarray:
    """Two per cent of the light comes back from a bar behind the panel."""
    across = session.right / session.of.shape[1]
    bar = ((across > 0.55) & (across < 0.72)).astype(float)
    return light + 0.02 * gaussian_filter(gaussian_filter(light, 3, mode="nearest") * bar, 2.5, mode="nearest")


def grid(session: WithEffect, light: np.ndarray) -> np.ndarray:
    """Lines of an anti-scatter grid that beat with the pixels, 1.5 %."""
    return light * (1 + 0.015 * np.sin(2 * np.pi * session.right / 3.37))


def rolling(session: WithEffect, light: np.ndarray) -> np.ndarray:
    """Rows are exposed one after the other under a tube that ripples by 1 %."""
    session.phase = session.own_rng.uniform(0, 2 * np.pi) if session.first else session.phase + 0.35
    return light * (1 + 0.01 * np.sin(2 * np.pi * session.down / 23.0 + session.phase))


def smear(session: WithEffect, light: np.ndarray) -> np.ndarray:
    """Each column's mean light lies all along it, 2 %: a frame that is moved out under the beam."""
    return 0.98 * light + 0.02 * light.mean(0, keepdims=True)


def droop(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """Bright rows pull their own zero down, 2 %."""
    return numbers - 0.02 * (numbers - session.dark_DN.mean()).mean(1, keepdims=True)


def hum(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """Mains in the readout: rows' offsets whose phase drifts, as large as the read noise."""
    session.phase += 1.9 + 0.1 * session.own_rng.normal()
    return numbers + session.of.read_DN * np.sin(2 * np.pi * session.down / 9.3 + session.phase)


def recursive(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """A noise filter that keeps 0.4 of the last frame."""
    session.last = numbers if session.first else 0.6 * numbers + 0.4 * session.last
    return session.last


def compressed(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """Blocks of 8 x 8 pixels whose cosine transform is rounded to steps of 60 DN and more."""
    rows, columns = (side // BLOCK * BLOCK for side in numbers.shape)
    blocks = numbers[:rows, :columns].reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    steps = (60.0 * (1 + 0.6 * np.add.outer(np.arange(BLOCK), np.arange(BLOCK))))[None, :, None, :]
    rounded = np.round(dctn(blocks, axes=(1, 3), norm="ortho") / steps) * steps
    result = numbers.copy()
    result[:rows, :columns] = idctn(rounded, axes=(1, 3), norm="ortho").reshape(rows, columns)
    return result


def gain_by_frame(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """Each lit frame is brought part of the way (3 %) to one maximum."""
    return (
        numbers * (0.8 * session.brightest_DN / np.percentile(numbers, 99.5)) ** 0.03 if session.with_beam else numbers
    )


def table(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """A look-up table with the power 0.98."""
    full = 2.0**session.of.bits - 1
    return full * (numbers / full) ** 0.98


def clipped(session: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """Numbers stop at 0.88 of the brightest flat's, far below the converter's end."""
    return np.minimum(numbers, 0.88 * session.brightest_DN + session.dark_DN.mean())


def filtered(_: WithEffect, numbers: np.ndarray) -> np.ndarray:
    """A median filter of 3 x 3 pixels."""
    return median_filter(numbers, 3, mode="nearest")


LAG = (("image_lag", 1.0),)
CASES = {
    "backscatter": Case(on_light=backscatter, accepted=("gain_map_error",)),
    "grid": Case(on_light=grid, accepted=("gain_map_error",)),
    "rolling": Case(on_light=rolling, accepted=("line_flicker",)),
    "smear": Case(on_light=smear),
    "droop": Case(on_numbers=droop),
    "hum": Case(on_numbers=hum, accepted=("row_noise",)),
    "recursive": Case(on_numbers=recursive),
    "compressed": Case(on_numbers=compressed),
    "gain_by_frame": Case(on_numbers=gain_by_frame, line="B"),
    "table": Case(on_numbers=table, line="B"),
    "clipped": Case(on_numbers=clipped),
    "filtered": Case(on_numbers=filtered),
    "backscatter+lag": Case(on_light=backscatter, beside=LAG, accepted=("gain_map_error",)),
    "smear+lag": Case(on_light=smear, beside=LAG, line="B"),
}


def judged(name: str, seed: int, folder: Path) -> tuple[bool, str]:
    """Whether nothing wrong is named, and the answer in words."""
    case = CASES[name]
    session = WithEffect(LINES[case.line], case, np.random.default_rng(seed), np.random.default_rng(seed + 1000))
    try:
        found = diagnosis_of(session, folder / f"{name}_{seed}.h5", seed)
    except InputError as error:
        return False, f"refused: {error}"
    companions = {effect for effect, _ in case.beside}
    right = found.verdict != "no_gap" and set(found.named) <= companions | set(case.accepted)
    return right, answer_text(found)


def run() -> None:
    """A line a case on the terminal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="joined by commas (default all)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the sessions (default: a temporary one)")
    options = parser.parse_args()
    rights = []
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        for name in options.cases.split(","):
            if name not in CASES:
                parser.error(f"{name}: there are {', '.join(CASES)}")
            right, words = judged(name, options.seed, folder)
            rights.append(right)
            print(f"{name:18s} {'right' if right else 'WRONG'}  {words}", flush=True)
    print(f"{sum(rights)} of {len(rights)} right: no wrong name, and no session without a gap")


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()
