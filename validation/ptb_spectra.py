"""Tungsten spectra measured at PTB against the tube model with one fitted parameter, and what they cannot tell apart.

    python validation/ptb_spectra.py FOLDER [--json FILE]
    python validation/ptb_spectra.py --qualities [--json FILE]
    python validation/ptb_spectra.py --models [--json FILE]

FOLDER holds W_20kV.dat ... W_45kV.dat (Ketelhut and Bueermann, PTB, CC BY 4.0: germanium detector, 4 mm Be, 30 degrees,
1 m of air). The model is SpekPy's casim behind 4 mm Be and 1 m of air and one parameter more. It is fitted on two
tube voltages, every pair in turn, by least squares of the roots of the shapes above 13 keV (so that a bin weighs by its
photons); the other three say how well it does: total variation, half the sum of |model - measured| of the two shapes.

Two parameters fitted together have the correlation -cos(angle between their derivatives of those roots), taken where
tungsten alone fits best. Beyond 0.95 each is more than three times as uncertain as if the other were known: the data
know a combination of the two and not which it is.

`--qualities` takes PTB's catalogue of beam qualities (Ankerhold 2000, PTB-Dos-34, 30 to 150 kV, as SpekPy ships it): half-value
layers in Al and Cu and mean energies, and which hardness exponent or how much tungsten each wants of either of SpekPy's models.
The priors `hardness_exponent`, `hardness_tilt` and `anode_roughness_um` have their widths from both.

`--models` compares SpekPy's six models with casim: which hardness exponent and which exponent of 1 - E / kV turn casim's
bremsstrahlung into theirs. The prior `end_exponent` has its mean and width from these, and from what PTB's spectra want of it beside
tungsten (printed with FOLDER).
"""

import argparse
import itertools
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar

from raytwin.acquisition.setting import Filter
from raytwin.materials import material_from_name
from raytwin.spectra import (
    MODELS,
    Spectrum,
    half_value_layer_mm,
    mean_energy_keV,
    spectrum_from_file,
    tube_spectrum,
)

VOLTAGES_KV = (20, 25, 30, 35, 45)
ABOVE_KEV = 13.0
DECLARED = (Filter(material="Be", thickness_mm=4.0), Filter(material="air", thickness_mm=1000.0))
ANODE_ANGLE_DEG = 30.0
REFERENCE_KEV = 50.0
BOUND_TOGETHER = 0.95
BELOW_END = 0.95  # of the kV: nearer to it a spectrometer's resolution and the voltage's ripple show
SPEKPY_MODELS = ("kqp", "sim", "uni", "diff", "classical")
MODELS_AT_KV = (40, 60, 90, 120)

# name -> (size of a step, lowest, highest)
PARAMETERS: dict[str, tuple[float, float, float]] = {
    "tungsten_um": (1.0, 0.0, 20.0),
    "aluminium_mm": (0.1, 0.0, 5.0),
    "beryllium_mm": (10.0, 0.0, 100.0),
    "hardness_exponent": (0.4, -2.0, 2.0),
    "kV_error_percent": (1.0, -5.0, 5.0),
}
_LAYERS = {"tungsten_um": ("W", 1e-3), "aluminium_mm": ("Al", 1.0), "beryllium_mm": ("Be", 1.0)}


def shape(spectrum: Spectrum) -> NDArray[np.float64]:
    """Share of the photons above 13 keV in each bin (bin,)."""
    fluence = spectrum.fluence[spectrum.energies_keV > ABOVE_KEV]
    return np.asarray(fluence / fluence.sum())


def modelled_shape(
    measured: Spectrum, parameters: dict[str, float], *, anode_angle_deg: float = ANODE_ANGLE_DEG
) -> NDArray[np.float64]:
    """Shape of the model at the measured spectrum's kV, on its bins."""
    if measured.kV is None:
        raise ValueError("the file does not state its tube voltage")
    layers = tuple(
        Filter(material=material, thickness_mm=scale * parameters[name])
        for name, (material, scale) in _LAYERS.items()
        if parameters.get(name, 0.0) > 0
    )
    model = tube_spectrum(
        kV=measured.kV * (1.0 + 0.01 * parameters.get("kV_error_percent", 0.0)),
        anode_angle_deg=anode_angle_deg,
        filters=(*DECLARED, *layers),
        energies_keV=measured.energies_keV,
    )
    tilt = (model.energies_keV / REFERENCE_KEV) ** parameters.get("hardness_exponent", 0.0)
    photons = (model.fluence * tilt)[model.energies_keV > ABOVE_KEV]
    return np.asarray(photons / photons.sum())


def total_variation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Half the sum of differences of two shapes: the share of photons that would have to move."""
    return 0.5 * float(np.sum(np.abs(first - second)))


def fit_one(name: str, spectra: list[Spectrum]) -> float:
    """The value of one parameter that brings the roots of the shapes closest."""
    step, low, high = PARAMETERS[name]
    roots = np.concatenate([np.sqrt(shape(spectrum)) for spectrum in spectra])

    def misfit(x: NDArray[np.float64]) -> NDArray[np.float64]:
        model = [modelled_shape(spectrum, {name: float(x[0]) * step}) for spectrum in spectra]
        return np.asarray(np.sqrt(np.concatenate(model)) - roots)

    answer = least_squares(misfit, [0.3], bounds=([low / step], [high / step]), diff_step=1e-3)
    return float(answer.x[0]) * step


def fit_angle(spectra: list[Spectrum]) -> float:
    """The effective anode angle, degrees, to a tenth: self-absorption is steep towards small angles."""

    def misfit(angle: float) -> float:
        angle = round(angle, 1)
        return sum(
            float(np.sum((np.sqrt(modelled_shape(s, {}, anode_angle_deg=angle)) - np.sqrt(shape(s))) ** 2))
            for s in spectra
        )

    return round(float(minimize_scalar(misfit, bounds=(3.0, 30.0), method="bounded", options={"xatol": 0.1}).x), 1)


def derivatives(spectra: list[Spectrum], at: dict[str, float]) -> dict[str, NDArray[np.float64]]:
    """Derivative of the roots of all shapes by each parameter, in any unit of it."""
    found = {}
    for name, (step, low, _) in PARAMETERS.items():
        here = at.get(name, 0.0)
        below, above = max(low, here - 0.05 * step), here + 0.05 * step
        sides = [
            np.sqrt(np.concatenate([modelled_shape(spectrum, {**at, name: value}) for spectrum in spectra]))
            for value in (below, above)
        ]
        found[name] = np.asarray((sides[1] - sides[0]) / ((above - below) / step))
    smaller, declared = (
        np.sqrt(np.concatenate([modelled_shape(spectrum, at, anode_angle_deg=angle) for spectrum in spectra]))
        for angle in (ANODE_ANGLE_DEG - 2.0, ANODE_ANGLE_DEG)
    )
    found["anode_angle_deg"] = np.asarray(declared - smaller)
    return found


def correlations(columns: dict[str, NDArray[np.float64]]) -> dict[tuple[str, str], float]:
    """Correlation of each two parameters in a fit of the two."""
    unit = {name: column / np.linalg.norm(column) for name, column in columns.items()}
    return {(a, b): -float(unit[a] @ unit[b]) for a, b in itertools.combinations(unit, 2)}


def compare(measured: dict[int, Spectrum]) -> dict[str, Any]:
    """Shape errors of every parameter over every pair of fitted voltages, and the correlations."""
    rows: dict[str, Any] = {
        "none": {"error_each_kV": {kV: total_variation(modelled_shape(s, {}), shape(s)) for kV, s in measured.items()}}
    }
    names = (*PARAMETERS, "anode_angle_deg")
    for name in names:
        values, errors = [], []
        # an effective angle takes new tube spectra at every trial: three pairs are enough to see what it does
        pairs = list(itertools.combinations(measured, 2))
        for pair in pairs if name in PARAMETERS else [(20, 45), (25, 45), (30, 45)]:
            fitted_on = [measured[kV] for kV in pair]
            others = [spectrum for kV, spectrum in measured.items() if kV not in pair]
            if name in PARAMETERS:
                value = fit_one(name, fitted_on)
                models = [modelled_shape(spectrum, {name: value}) for spectrum in others]
            else:
                value = fit_angle(fitted_on)
                models = [modelled_shape(spectrum, {}, anode_angle_deg=value) for spectrum in others]
            values.append(value)
            errors.append(np.mean([total_variation(model, shape(s)) for model, s in zip(models, others, strict=True)]))
        rows[name] = {
            "pairs": len(values),
            "value": [float(np.min(values)), float(np.median(values)), float(np.max(values))],
            "error_other_kV": {"median": float(np.median(errors)), "worst": float(np.max(errors))},
        }
    spectra = list(measured.values())
    found = correlations(derivatives(spectra, {"tungsten_um": fit_one("tungsten_um", spectra)}))
    return {
        "rows": rows,
        "correlation": {f"{a} and {b}": value for (a, b), value in found.items()},
        "not_told_apart": [f"{a} and {b}" for (a, b), value in found.items() if abs(value) > BOUND_TOGETHER],
    }


def end_exponents(measured: dict[int, Spectrum]) -> dict[int, dict[str, float]]:
    """Tungsten (um) and exponent of 1 - E / kV that bring the roots of each spectrum's shape closest, below its end."""
    found = {}
    for kV, spectrum in measured.items():
        energies = spectrum.energies_keV[spectrum.energies_keV > ABOVE_KEV]
        below = energies < BELOW_END * kV

        def misfit(
            x: NDArray[np.float64],
            spectrum: Spectrum = spectrum,
            energies: Any = energies,
            below: Any = below,
            kV: int = kV,
        ) -> NDArray[np.float64]:
            model = modelled_shape(spectrum, {"tungsten_um": max(float(x[0]), 1e-6)}) * (
                np.maximum(1.0 - energies / kV, 1e-3) ** float(x[1])
            )
            return np.asarray((np.sqrt(model / model.sum()) - np.sqrt(shape(spectrum)))[below])

        answer = least_squares(misfit, [0.3, 0.0], diff_step=1e-3)
        found[kV] = {"tungsten_um": float(answer.x[0]), "end_exponent": float(answer.x[1])}
    return found


def compare_models() -> list[dict[str, Any]]:
    """Exponents of E and of 1 - E / kV that turn casim's bremsstrahlung into another model's, from 0.3 to 0.97 of the kV."""
    import spekpy

    rows = []
    for model in SPEKPY_MODELS:
        for kV in MODELS_AT_KV:
            both = [
                spekpy.Spek(kvp=kV, th=12, dk=0.5, physics=name, targ="W").get_spectrum(char=False)
                for name in ("casim", model)
            ]
            share = both[0][0] / kV
            seen = (share > 0.3) & (share < 0.97)
            terms = np.stack([np.ones(seen.sum()), np.log(share[seen]), np.log(1.0 - share[seen])], axis=1)
            ratio = np.log(both[1][1] / both[0][1])[seen]
            solved = np.linalg.lstsq(terms, ratio, rcond=None)[0]
            left = float(np.sqrt(np.mean((ratio - terms @ solved) ** 2)))
            rows.append(
                {"model": model, "kV": kV, "hardness": float(solved[1]), "end": float(solved[2]), "left_rms": left}
            )
    return rows


def compare_qualities(model: str) -> list[dict[str, Any]]:
    """What PTB's beam qualities want of a tube model, by quantity and range of kV: rms error, hardness, tungsten.

    hardness: least-squares exponent of (E / 50 keV) and the scatter of single qualities' exponents about it; tungsten_um: the
    same fit by micrometres of tungsten.
    """
    import spekpy

    quantities: dict[str, Callable[[Spectrum], float]] = {
        "hvl_1_al": partial(half_value_layer_mm, material=material_from_name("Al")),
        "hvl_1_cu": partial(half_value_layer_mm, material=material_from_name("Cu")),
        "e_mean": mean_energy_keV,
    }
    names = {"Air Dry (Near Sea Level)": "air"}
    found: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in quantities}
    for path in sorted((Path(spekpy.__file__).parent / "data" / "state_def").glob("PTB_*.state")):
        state = json.loads(path.read_text(encoding="utf-8"))
        tube, published = state["model_parameters"], state["reference_values"]
        if tube["kvp"] > 150:
            continue
        layers = [Filter(material=names.get(name, name), thickness_mm=mm) for name, mm in state["filters"]]
        beams = [
            tube_spectrum(kV=tube["kvp"], anode_angle_deg=tube["th"], filters=[*layers, *extra], model=model)
            for extra in ((), (Filter(material="W", thickness_mm=1e-3),))
        ]
        harder = replace(beams[0], fluence=beams[0].fluence * (beams[0].energies_keV / REFERENCE_KEV) ** 0.1)
        for name, quantity in quantities.items():
            if published[name]:
                ours = quantity(beams[0])
                found[name].append(
                    (
                        tube["kvp"],
                        float(np.log(published[name] / ours)),
                        float(np.log(quantity(harder) / ours)) / 0.1,
                        float(np.log(quantity(beams[1]) / ours)),
                    )
                )
    rows = []
    for name, values in found.items():
        kV, error, by_hardness, by_tungsten = np.array(values).T
        for low, high in ((30, 60), (60, 100), (100, 151), (30, 151)):
            chosen = (kV >= low) & (kV < high)
            y, hardness, tungsten = error[chosen], by_hardness[chosen], by_tungsten[chosen]
            rows.append(
                {
                    "model": model,
                    "quantity": name,
                    "kV": [low, min(high, 150)],
                    "qualities": int(chosen.sum()),
                    "rms_percent": 100 * float(np.sqrt(np.mean(y**2))),
                    "hardness": float(hardness @ y / (hardness @ hardness)),
                    "hardness_scatter": float(np.std(y / hardness)),
                    "tungsten_um": float(tungsten @ y / (tungsten @ tungsten)),
                }
            )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folder", type=Path, nargs="?", help="folder with W_20kV.dat, W_25kV.dat, W_30kV.dat, W_35kV.dat, W_45kV.dat"
    )
    parser.add_argument("--json", type=Path, help="also write the answer here")
    parser.add_argument("--qualities", action="store_true", help="PTB's beam qualities instead, which come with SpekPy")
    parser.add_argument("--models", action="store_true", help="SpekPy's models beside casim instead")
    arguments = parser.parse_args()
    if arguments.models:
        rows = compare_models()
        for row in rows:
            print(
                f"{row['model']:9s} {row['kV']:>3} kV: hardness {row['hardness']:+.3f}, end {row['end']:+.3f}, left"
                f" {100 * row['left_rms']:.1f} % rms"
            )
        ends = [0.0, *(np.mean([row["end"] for row in rows if row["model"] == name]) for name in SPEKPY_MODELS)]
        print(
            f"exponents of 1 - E / kV of the six: mean {np.mean(ends):.3f}, standard deviation {np.std(ends, ddof=1):.3f}"
        )
        changes = [0.0, *(np.var([row["end"] for row in rows if row["model"] == name]) for name in SPEKPY_MODELS)]
        print(f"their change from voltage to voltage: standard deviation {np.sqrt(np.mean(changes)):.3f}")
        if arguments.json is not None:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
        return 0
    if arguments.qualities:
        table = [row for model in MODELS for row in compare_qualities(model)]
        for row in table:
            print(
                f"{row['model']:6s} {row['quantity']:9s} {row['kV'][0]:>3}-{row['kV'][1]} kV {row['qualities']:>3} qualities: rms"
                f" {row['rms_percent']:.2f} %, hardness {row['hardness']:+.3f} (single ones scatter by"
                f" {row['hardness_scatter']:.2f}), tungsten {row['tungsten_um']:+.2f} um"
            )
        if arguments.json is not None:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(json.dumps(table, indent=1), encoding="utf-8")
        return 0
    if arguments.folder is None:
        parser.error("name the folder of PTB's spectra, or --qualities")
    files = {kV: arguments.folder / f"W_{kV}kV.dat" for kV in VOLTAGES_KV}
    missing = [path.name for path in files.values() if not path.is_file()]
    if missing:
        print(f"skipped: {', '.join(missing)} not in {arguments.folder}", file=sys.stderr)
        return 0
    measured = {kV: spectrum_from_file(path) for kV, path in files.items()}
    answer = compare(measured) | {"end_exponents": end_exponents(measured)}
    rows = answer["rows"]
    bare = rows["none"]["error_each_kV"]
    print("nothing fitted: " + ", ".join(f"{kV} kV {error:.3f}" for kV, error in bare.items()))
    for name, row in rows.items():
        if name != "none":
            low, middle, high = row["value"]
            error = row["error_other_kV"]
            print(
                f"{name:18s} {middle:8.3g} ({low:.3g} to {high:.3g} over {row['pairs']} pairs), error at the other kV: "
                f"median {error['median']:.4f}, worst pair {error['worst']:.4f}"
            )
    for kV, found in answer["end_exponents"].items():
        print(
            f"{kV} kV: {found['tungsten_um']:.2f} um of tungsten and an exponent of 1 - E / kV of {found['end_exponent']:+.3f}"
        )
    print("correlation when two are fitted together:")
    for pair, value in answer["correlation"].items():
        print(f"  {pair}: {value:+.3f}" + ("   known only together" if pair in answer["not_told_apart"] else ""))
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(answer, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
