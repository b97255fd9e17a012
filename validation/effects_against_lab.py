"""Each effect of the catalogue against the virtual lab's own: is the strength that was planted found again?

    python validation/effects_against_lab.py [--seeds 1] [--first-seed 7001] [--size 64] [--effects ID ...] [--json FILE]

The lab plants effects by laws of other shapes (photons followed one by one, traps of five kinds, a charging capacitor, a
moving object) and shares no code with the twin. For each effect: one full session with a strength in the middle of its
plausible range, a twin calibrated from its calibration series, then a least-squares fit of the effect's parameters to
simple statistics of all series (means of 8 x 8 pixels, variance, neighbour and frame correlations, first frame, common
factor, row noise, fixed pattern, outliers, step), with tube voltage, filtration, hardness, level, Swank factor and
optical spread free beside them. The column `misfit` is the sum of squares (robust) without the effect, with it, and the
number of statistics. This checks the forward model; naming effects is the diagnosis' work. Least squares does not follow
the random course of `output_drift` nor weigh its correlation, and few outliers make `bad_pixels` coarse: their strengths
are rough here.
"""

import argparse
import json
import math
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.diagnosis.session.session import read_session
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.frames.conditions import session_conditions, with_conditions
from raytwin.generator.frames.line_model import ExpectedSeries, LineModel
from raytwin.generator.frames.model_cache import ModelCache
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.line.twin import Estimate, Twin
from raytwin.lab import EffectRequest, run_protocol

BLOCK = 8
NUISANCES = {
    "kV_error": 0.005,
    "inherent_filtration_mm_Al": 0.05,
    "log_DN_per_keV": 0.02,
    "log_swank": 0.03,
    "hardness_exponent": 0.02,
}
SPREAD_SD = 0.05  # of the optical spread
MODEL_SD = 0.002  # of a block's mean: what wedges and slabs are known to
EDGE_SD = 0.02  # of the range within a block

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """One series: mean frame (row, column), and numbers over its good pixels."""

    request: SeriesRequest
    mean_DN: Array
    variance_DN2: float
    neighbours: float
    frames_in_row: float
    first_DN: float
    common_DN: float
    row_DN2: float
    step_DN: float


def blocks(image: Array, good: NDArray[np.bool_]) -> Array:
    """Means of the good pixels of squares."""
    rows, columns = image.shape
    shape = (rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    count = np.maximum(good.reshape(shape).sum(axis=(1, 3)), 1)
    return np.asarray(np.where(good, image, 0.0).reshape(shape).sum(axis=(1, 3)) / count)


def measure(path: Path, twin: Twin) -> list[Measured]:
    """Statistics of all series of a session; each knows the four before it."""
    good = twin.maps.bad_pixels == 0
    beside = good[:, 1:] & good[:, :-1]
    result = []
    earlier: list[SeriesRequest] = []
    with open_acquisition(path) as acquisition:
        for item in read_session(acquisition):
            frames = item.series.read_frames().astype(np.float64)
            count = len(frames)
            mean = frames.mean(axis=0)
            noise = frames - mean
            common = noise[:, good].mean(axis=1)
            noise = noise - common[:, None, None]
            variance = float((noise**2).sum(axis=0)[good].mean() / (count - 1))
            right = float((noise[:, :, 1:] * noise[:, :, :-1]).sum(axis=0)[beside].mean() / (count - 1))
            after = float((noise[1:] * noise[:-1]).mean(axis=0)[good].mean())
            lines = np.where(good, noise, 0.0).sum(axis=2) / good.sum(axis=1)
            codes = np.unique(frames[: min(count, 10)])
            result.append(
                Measured(
                    request=replace(item.request, previous=tuple(earlier[-4:])),
                    mean_DN=mean,
                    variance_DN2=variance,
                    neighbours=right / variance,
                    frames_in_row=after / variance + 1.0 / count,
                    first_DN=float(np.median(frames[0][good]) - np.median(mean[good])),
                    common_DN=float(common.std(ddof=1)),
                    row_DN2=float((lines**2).sum(axis=0).mean() / (count - 1)),
                    step_DN=float(np.median(np.diff(codes))) if codes.size > 1 else 1.0,
                )
            )
            earlier.append(replace(item.request, previous=()))
    return result


def residuals(seen: Measured, known: ExpectedSeries, good: NDArray[np.bool_]) -> Array:
    """Standardised differences between a series and its expectation."""
    request, count = seen.request, known.frames
    image = request.thickness_mm is not None
    variance = known.quantum_variance_DN2 + known.white_variance_DN2
    typical = float(variance[good].mean())
    level = float(np.median(known.signal_DN))
    departure = seen.mean_DN - known.mean_DN
    error = np.hypot(MODEL_SD * blocks(known.signal_DN, good), math.sqrt(3.0 * typical / count) / BLOCK + 0.1)
    if image:
        rows, columns = good.shape
        cut = known.mean_DN.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
        error = np.hypot(error, EDGE_SD * np.ptp(cut, axis=(1, 3)))
    found = [np.ravel(blocks(departure, good) / error)]
    if count >= 8:
        pixels = float(good.sum())
        lines = known.row_variance_DN2 + known.column_variance_DN2
        sd = math.sqrt(8.0 / count / pixels)
        found.append(np.array([math.log(seen.variance_DN2 / (typical + lines)) / math.hypot(sd, 0.004)]))
        quantum = float(known.quantum_variance_DN2[good].mean())
        in_row = known.temporal_correlation[0] * quantum / (typical + lines)
        found.append(np.array([(seen.frames_in_row - in_row) / math.hypot(sd, 0.002)]))
        if not image:
            right = (known.noise_autocovariance[0, 1] * quantum + known.row_variance_DN2) / (typical + lines)
            found.append(np.array([(seen.neighbours - right) / math.hypot(sd, 0.005)]))
        first = sum((float(np.median(part)) * course[0] for part, course in known.trend_DN or ()), 0.0)
        drift = math.hypot(known.frame_factor_rms * level, math.sqrt(3.0 * typical / pixels))
        found.append(np.array([(seen.first_DN - first) / math.hypot(drift, 0.0005 * level)]))
        found.append(np.array([math.log(seen.common_DN / drift) / math.sqrt(1.0 / count + 0.02)]))
        whole = typical / good.shape[1] * 2.0 + known.row_variance_DN2
        found.append(np.array([math.log(seen.row_DN2 / whole) / 0.5]))
    if request.kind == "flat" and request.after_calibration and count >= 8:
        relative = departure[good] / known.signal_DN[good]
        own = float(np.median(variance[good] / known.signal_DN[good] ** 2)) / count
        spread = 1.4826 * float(np.median(np.abs(relative - np.median(relative))))
        pattern = math.sqrt(max(spread**2 - own, 0.0))
        found.append(
            np.array([(pattern - getattr(known.gain_pattern, "rms", 0.0)) / math.hypot(0.3 * math.sqrt(own), 2e-4)])
        )
        far = float(np.mean(np.abs(relative - np.median(relative)) > 8.0 * max(spread, 0.004)))
        share = known.bad_pixel_share
        found.append(np.array([(far - share) / (0.3 * share + 1.0 / good.sum())]))
    if request.kind == "dark":
        found.append(np.array([(seen.step_DN - max(known.quantisation_step_DN, 1.0)) / 0.2]))
    return np.concatenate(found)


def fit_effect(name: str, measured: list[Measured], twin: Twin) -> dict[str, Any]:
    """Strength and misfit of one effect, its inner parameters and the nuisances fitted beside it."""
    from scipy.optimize import least_squares

    effect = EFFECTS[name]
    good = twin.maps.bad_pixels == 0
    cache = ModelCache()
    conditions = session_conditions([item.request for item in measured])
    fitted = [item for item in effect.parameters if item.fitted]
    assert twin.spectral is not None
    names = twin.spectral.names
    since = "calibration" if effect.after_calibration else "always"

    def inner(values: Array) -> dict[str, float]:
        return {
            item.name: math.exp(value) if item.log else float(value)
            for item, value in zip(fitted, values, strict=False)
        }

    def applied(own: Array) -> AppliedEffect:
        return with_conditions(AppliedEffect(id=name, parameters=inner(own), since=since), conditions)

    def misfit(values: Array, *, present: bool) -> Array:
        own = values[: len(fitted)] if present else values[:0]
        rest = values[len(own) :]
        parameters = np.array(twin.spectral.best)  # type: ignore[union-attr]
        for (nuisance, sd), value in zip(NUISANCES.items(), rest, strict=False):
            parameters[names.index(nuisance)] += sd * value
        sigma = twin.noise.spread.value.sigma_px * (1.0 + SPREAD_SD * float(rest[-1]))
        changed = replace(twin, noise=replace(twin.noise, psf_sigma_px=Estimate(value=sigma, low=0.0, high=9.0)))
        effects = (applied(own),) if present else ()
        parts = [
            residuals(
                item,
                LineModel(changed, effects=effects, parameters=parameters, cache=cache).expect(item.request),
                good,
            )
            for item in measured
        ]
        return np.concatenate([*parts, rest])

    nothing = least_squares(
        lambda values: misfit(values, present=False),
        np.zeros(len(NUISANCES) + 1),
        loss="soft_l1",
        diff_step=1e-2,
        bounds=(-6.0, 6.0),
        max_nfev=8,
    )
    low = [math.log(item.low / 4) if item.log else -2 * item.high if item.signed else item.low for item in fitted]
    high = [math.log(item.high * 2) if item.log else item.high for item in fitted]
    high[0] = high[0] if fitted[0].log else 2 * fitted[0].high
    low[0] = low[0] if fitted[0].log or fitted[0].signed else 0.0
    scale = [0.3 if item.log else 0.2 * (item.high - item.low) for item in fitted]
    ends = np.array([*low, *[-8.0] * nothing.x.size]), np.array([*high, *[8.0] * nothing.x.size])
    directions = (20.0, 110.0, 200.0, 290.0) if any(item.name == "direction_deg" for item in fitted) else (0.0,)
    starts = []
    for direction in directions:
        start = [
            0.5 * (math.log(item.low) + math.log(item.high))
            if item.log
            else direction
            if item.name == "direction_deg"
            else 0.3 * item.high
            for item in fitted
        ]
        starts.append(np.clip([*start, *(0.5 * nothing.x)], ends[0] + 1e-6, ends[1] - 1e-6))
    # a direction is looked for from the quarter that starts best
    starts.sort(key=lambda values: float(np.sum(np.log1p(misfit(values, present=True) ** 2))))
    best = least_squares(
        lambda values: misfit(values, present=True),
        starts[0],
        loss="soft_l1",
        diff_step=5e-3,
        bounds=ends,
        x_scale=[*scale, *[1.0] * nothing.x.size],
        max_nfev=20,
    )
    return {
        "found": inner(best.x),
        "misfit_without": 2.0 * float(nothing.cost),
        "misfit_with": 2.0 * float(best.cost),
        "statistics": int(best.fun.size),
    }


def middle(name: str) -> float:
    """A strength in the upper middle of the plausible range."""
    strength = EFFECTS[name].strength
    return float(f"{strength.low**0.35 * strength.high**0.65:.2g}")


def run_one(name: str, seed: int, *, size: int, frames: int, folder: Path) -> dict[str, Any]:
    """One session with one effect, and what is found of it."""
    planted = middle(name)
    path = folder / f"{name}_{seed}.h5"
    run_protocol(
        path,
        protocol="full",
        seed=seed,
        rows=size,
        columns=size,
        frames=frames,
        effects=[EffectRequest(id=name, strength=planted)],
    )
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(seed))
    result = fit_effect(name, measure(path, twin), twin)
    path.unlink()
    return {"effect": name, "seed": seed, "unit": EFFECTS[name].strength.unit, "planted": planted, **result}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=7001)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--effects", nargs="*", default=list(EFFECTS))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        cases = [(name, arguments.first_seed + k) for k in range(arguments.seeds) for name in arguments.effects]
        print(f"{'effect':20s}{'planted':>10s}{'found':>10s}  {'unit':18s}{'misfit':>26s}  inner", flush=True)
        for name, seed in tqdm(cases, disable=None):
            row = run_one(name, seed, size=arguments.size, frames=arguments.frames, folder=Path(folder))
            results.append(row)
            found = dict(row["found"])
            inner = ", ".join(f"{key} {value:.3g}" for key, value in found.items() if key != "strength")
            misfit = f"{row['misfit_without']:.0f} {row['misfit_with']:.0f} of {row['statistics']}"
            print(
                f"{name:20s}{row['planted']:10.3g}{found['strength']:10.3g}  {row['unit']:18s}{misfit:>26s}  {inner}",
                flush=True,
            )
            if arguments.json:
                arguments.json.parent.mkdir(parents=True, exist_ok=True)
                arguments.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
