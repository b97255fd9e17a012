"""A twin in the form that other simulators read: spectra at the detector, its response, optical spread, noise.

The most probable parameter set of the posterior is written; its intervals stay with the twin. With n(E) the photons of a bin (a
mAs and mm2 at 1 m) and R(E) the signal of a photon (DN), the open signal of a setting is sum(n R) mAs (1 m / d)^2 a^2.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting, text_from_filters
from ...errors import InputError
from ...files import whole_file, write_json
from ...materials import material_from_name, mu_per_mm
from ..line.spectral_signal import OpenBeam
from ..line.twin import BAD_PIXEL_MAP, SpectralPosterior, Twin
from ..line.twin_spectrum import spectral_model_of
from ..predictions.predict_settings import as_setting, predict_setting
from ..spread.psf import optical_kernel_1d
from .twin_answer import spread_answer

FloatArray = NDArray[np.float64]

_CELLS = 256  # pixels over which a spread with tails is transformed


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """A twin as tables: energies_keV (energy,); signal_DN, variance_DN2, absorbed of a photon (energy,); photons of each
    setting (setting, energy) a mAs and mm2 at 1 m."""

    twin: Twin
    posterior: SpectralPosterior
    settings: tuple[Setting, ...]
    energies_keV: FloatArray
    signal_DN: FloatArray
    variance_DN2: FloatArray
    absorbed: FloatArray
    photons: FloatArray

    @property
    def DN_per_keV(self) -> float:
        """DN of a keV absorbed."""
        posterior = self.posterior
        return math.exp(float(posterior.best[posterior.names.index("log_DN_per_keV")]))

    @property
    def kernel(self) -> FloatArray:
        """Line spread function along a row, an odd number of pixels, sum 1."""
        spread = self.twin.noise.spread.value
        if spread.separable:
            return optical_kernel_1d(spread.model, spread.sigma_px)
        frequency = np.asarray(np.fft.fftfreq(_CELLS), dtype=np.float64)
        whole = spread.transfer(np.zeros(_CELLS), frequency)
        if spread.model == "aperture":  # averaged over positions in a pixel, as `optical_kernel_1d`
            whole = whole * np.sinc(frequency)
        reach = min(spread.reach_px, _CELLS // 2 - 1)
        line = np.fft.fftshift(np.fft.ifft(whole).real)[_CELLS // 2 - reach : _CELLS // 2 + reach + 1]
        return np.asarray(line / line.sum())

    def load_mAs(self, number: int) -> float:
        """Charge of one frame of a setting."""
        return self.settings[number].stated_load_mAs()


def export_twin(
    twin: Twin, folder: Path, *, to: str, settings: Setting | str | Sequence[Setting | str] | None = None
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write a twin's files for another simulator into a folder.

    Args:
        twin: with a spectral part.
        folder: where to write.
        to: one of FORMATS.
        settings: that the spectra are written for; None: the measured kV and filters at 1 mAs.

    Returns:
        File name -> what it holds, and warnings.

    Raises:
        InputError: another simulator, no spectral part, a setting without tube load or that the line cannot have.
    """
    if to not in FORMATS:
        raise InputError("to", received=repr(to), expected="one of " + ", ".join(FORMATS))
    line = _line_of(twin, _settings_of(twin, settings))
    for setting in line.settings:
        setting.stated_load_mAs()  # said before anything is written
    warnings = []
    if twin.effects:
        warnings.append("effects of the twin are left out: " + ", ".join(item.id for item in twin.effects))
    files, more = FORMATS[to](line, folder)
    return files, (*warnings, *more)


def _settings_of(twin: Twin, settings: Setting | str | Sequence[Setting | str] | None) -> tuple[Setting, ...]:
    if isinstance(settings, Setting | str):
        return (as_setting(settings),)
    if settings is not None:
        return tuple(as_setting(item) for item in settings)
    return tuple(
        Setting(kV=level.kV, current_mA=1.0, exposure_ms=1000.0, filters=level.filters)
        for level in twin.levels
        if level.kV is not None
    )


def _line_of(twin: Twin, settings: tuple[Setting, ...]) -> _Line:
    if not settings:
        raise InputError("settings", received="none", expected="at least one, or a twin with levels of known kV")
    highest_kV = max(setting.kV for setting in settings)
    model = spectral_model_of(twin, highest_kV=highest_kV)  # raises where there is no spectral part
    posterior = twin.spectral
    if posterior is None:
        raise InputError("twin", received="a twin without spectral part", expected="one calibrated from flats with kV")
    bare = OpenBeam(kV=highest_kV, filters=())
    incident = model.weights(posterior.best[None, :], bare)[0]
    moments = model.moment_weights(posterior.best, bare)
    used = incident > 1e-30 * incident.max()
    energies = model.energies_keV[: len(incident)][used]
    signal, variance, absorbed = moments[:, used] / incident[used]
    photons = np.zeros((len(settings), len(energies)))
    for number, setting in enumerate(settings):
        beam = OpenBeam(kV=setting.kV, filters=setting.filters)
        found = model.weights(posterior.best[None, :], beam)[0]
        whole = np.zeros(len(incident))
        whole[: min(len(found), len(whole))] = found[: len(whole)]
        photons[number] = whole[used]
    return _Line(
        twin=twin,
        posterior=posterior,
        settings=settings,
        energies_keV=energies,
        signal_DN=signal,
        variance_DN2=variance,
        absorbed=absorbed,
        photons=photons,
    )


def _write_table(path: Path, columns: Mapping[str, Sequence[Any] | FloatArray]) -> None:
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _detector_of(line: _Line) -> dict[str, Any]:
    """What every simulator needs of geometry and noise, by name with units."""
    twin, instrument = line.twin, line.twin.instrument
    rows, columns = twin.maps.shape
    return {
        "rows": rows,
        "columns": columns,
        "pixel_mm": instrument.pixel_mm,
        "source_object_mm": instrument.source_object_mm,
        "source_detector_mm": instrument.source_detector_mm,
        "bits": instrument.bits,
        "counting": line.posterior.counting,
        "scintillator": text_from_filters(line.posterior.scintillator),
        "DN_per_keV": line.DN_per_keV,
        "dark_DN": twin.dark_DN.as_dict(),
        "read_noise_DN": twin.noise.read_noise_DN.as_dict(),
        "spread": spread_answer(twin.noise.spread),
        "white_fraction": twin.noise.white_fraction,
        BAD_PIXEL_MAP: int(np.count_nonzero(twin.maps.bad_pixels)),
    }


def _to_csv(line: _Line, folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    files = {
        "spectra.csv": "photons a bin, mAs and mm2 at 1 m, a column a setting (numbers of settings.csv)",
        "response.csv": "of one photon: signal (DN), quantum variance before the spread (DN2), probability of absorption",
        "settings.csv": "settings with the twin's predictions and intervals",
        "spread.csv": "optical spread along one axis, sum 1",
        "levels.csv": "gains as measured",
        "noise.json": "detector, dark, electronic noise",
    }
    spectra = {f"setting_{number}": line.photons[number].tolist() for number in range(len(line.settings))}
    _write_table(folder / "spectra.csv", {"energy_keV": line.energies_keV.tolist(), **spectra})
    _write_table(
        folder / "response.csv",
        {
            "energy_keV": line.energies_keV.tolist(),
            "signal_DN": line.signal_DN.tolist(),
            "variance_DN2": line.variance_DN2.tolist(),
            "absorbed": line.absorbed.tolist(),
        },
    )
    rows = []
    for number, setting in enumerate(line.settings):
        found = predict_setting(line.twin, setting).to_dict()
        row = {"number": number, "setting": str(setting), "load_mAs": line.load_mAs(number)}
        for name in ("mean_DN", "sd_DN", "gain_DN"):
            value = found[name] or {}
            row |= {name: value.get("value"), f"{name}_low": value.get("low"), f"{name}_high": value.get("high")}
        rows.append(row)
    _write_table(folder / "settings.csv", {name: [row[name] for row in rows] for name in rows[0]})
    reach = len(line.kernel) // 2
    _write_table(folder / "spread.csv", {"offset_px": list(range(-reach, reach + 1)), "weight": line.kernel.tolist()})
    levels = line.twin.levels
    _write_table(
        folder / "levels.csv",
        {
            "kV": [level.kV for level in levels],
            "filter": [text_from_filters(level.filters) for level in levels],
            "gain_DN": [level.gain_DN.value for level in levels],
            "gain_DN_low": [level.gain_DN.low for level in levels],
            "gain_DN_high": [level.gain_DN.high for level in levels],
        },
    )
    write_json(folder / "noise.json", _detector_of(line))
    return files, ()


def _to_gvxr(line: _Line, folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """JSON of gVirtualXray 2 (`json2gvxr`): photons a cm2 at 1 m, energy response as a table of keV, line spread function."""
    detector = _detector_of(line)
    distance, pixel = detector["source_detector_mm"] or 1000.0, detector["pixel_mm"] or 1.0
    files = {
        "noise.json": "detector, dark, electronic noise; an image of gVirtualXray (MeV) times 1000 DN_per_keV is in DN above dark"
    }
    response = np.stack((line.energies_keV, line.signal_DN / line.DN_per_keV), axis=1)
    for number, setting in enumerate(line.settings):
        name = f"gvxr_{number}.json"
        counts = 100.0 * line.photons[number] * line.load_mAs(number)  # mm2 to cm2
        seen = counts > 1e-9 * counts.max()
        page = {
            "WindowSize": [detector["columns"], detector["rows"]],  # `initGVXR` asks for it, with a window or without
            "Source": {
                "Position": [0.0, -distance, 0.0, "mm"],
                "Shape": "PointSource",
                "Beam": [
                    {"Energy": energy, "Unit": "keV", "PhotonCount": count}
                    for energy, count in zip(line.energies_keV[seen].tolist(), counts[seen].tolist(), strict=True)
                ],
            },
            "Detector": {
                "Position": [0.0, 0.0, 0.0, "mm"],
                "UpVector": [0, 0, -1],
                "RightVector": [-1, 0, 0],
                "NumberOfPixels": [detector["columns"], detector["rows"]],
                "Spacing": [pixel, pixel, "mm"],
                "Energy response": {"LUT": response.tolist(), "Unit": "keV"},
                "LSF": line.kernel.tolist(),
            },
            "Samples": [],
            "raytwin": {"setting": str(setting)},
        }
        write_json(folder / name, page)
        files[name] = f"source and detector at {setting}"
    write_json(folder / "noise.json", detector)
    missing = tuple(
        f"{name} is unknown: {usual} stands in its place"
        for name, usual in (("source_detector_mm", "1 m"), ("pixel_mm", "1 mm"))
        if detector[name] is None
    )
    return files, missing


def _to_xcist(line: _Line, folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Spectrum and configuration files of gecatsim: photons / s / mm2 / mA at 1 m; its detector is a slab of one material."""
    detector = _detector_of(line)
    layer = line.posterior.scintillator[0]
    material = {"CsI": "CsI", "Gd2O2S": "GOS"}.get(layer.material.partition("@")[0], layer.material)
    log_thickness = line.posterior.names.index("log_scintillator_thickness")
    depth_mm = layer.thickness_mm * math.exp(float(line.posterior.best[log_thickness]))
    files = {"noise.json": "detector, dark, electronic noise, optical spread"}
    for number, setting in enumerate(line.settings):
        name = f"spectrum_{number}"
        pairs = zip(line.energies_keV.tolist(), line.photons[number].tolist(), strict=True)
        _write_lines(
            folder / f"{name}.dat",
            [str(len(line.energies_keV)), *(f"{energy:.6f},{count:.9e}" for energy, count in pairs)],
        )
        _write_lines(
            folder / f"protocol_{number}.cfg",
            [
                f"# {setting}",
                f'protocol.spectrumFilename = "{name}.dat"',
                "protocol.spectrumUnit_mm = 1",
                "protocol.spectrumUnit_mA = 1",
                "protocol.spectrumScaling = 1",
                f"protocol.mA = {setting.tube_current_mA:.9g}",
                "protocol.viewsPerRotation = 1",
                f"protocol.rotationTime = {setting.exposure_ms / 1000.0:.9g}",
                "protocol.dutyRatio = 1.0",
            ],
        )
        files[f"{name}.dat"] = f"spectrum behind the filters of {setting}"
        files[f"protocol_{number}.cfg"] = f"protocol of {setting}"
    lines = [
        f'scanner.detectorMaterial = "{material}"',
        f"scanner.detectorDepth = {depth_mm:.6g}",
        'scanner.detectionCallback = "Detection_EI"',
        f"scanner.detectionGain = {line.DN_per_keV:.9g} # DN a keV: views are in DN above dark",
        f"scanner.eNoise = {line.twin.noise.read_noise_DN.value:.6g} # DN",
        "scanner.detectorColFillFraction = 1.0",
        "scanner.detectorRowFillFraction = 1.0",
    ]
    if detector["source_detector_mm"] is not None:
        lines.append(f"scanner.sdd = {detector['source_detector_mm']:.9g}")
    if detector["source_object_mm"] is not None:
        lines.append(f"scanner.sid = {detector['source_object_mm']:.9g}")
    if detector["pixel_mm"] is not None:
        lines += [f"scanner.detector{side}Size = {detector['pixel_mm']:.9g}" for side in ("Col", "Row")]
    lines += [f"scanner.detectorColCount = {detector['columns']}", f"scanner.detectorRowCount = {detector['rows']}"]
    _write_lines(folder / "scanner.cfg", lines)
    files["scanner.cfg"] = "detector"
    write_json(folder / "noise.json", {**detector, "line_spread": line.kernel})
    # gecatsim's Detection_EI: a photon that interacts at all leaves all of its energy
    stopped = 1.0 - np.exp(-depth_mm * mu_per_mm(material_from_name(layer.material), line.energies_keV))
    told = []
    for number, setting in enumerate(line.settings):
        weights = line.photons[number]
        slab = weights @ (line.energies_keV * stopped) * line.DN_per_keV
        share = float(slab / (weights @ line.signal_DN) - 1.0)
        told.append(f"gecatsim keeps all energy of a photon that interacts: level {100 * share:+.1f} % at {setting}")
    return files, tuple(told)


def _to_leap(line: _Line, folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Arrays by the names of LEAP's functions; LEAP itself reads arrays, not files."""
    detector = _detector_of(line)
    with whole_file(folder / "leap_spectra.npz") as temporary, temporary.open("wb") as stream:
        np.savez(
            stream,
            Es=line.energies_keV,
            spectra=line.photons,
            detector_response=line.signal_DN,
            detected_spectra=line.photons * line.signal_DN,
        )
    pitch = detector["pixel_mm"]
    write_json(
        folder / "leap_geometry.json",
        {
            "numRows": detector["rows"],
            "numCols": detector["columns"],
            "pixelHeight": pitch,
            "pixelWidth": pitch,
            "centerRow": 0.5 * (detector["rows"] - 1),
            "centerCol": 0.5 * (detector["columns"] - 1),
            "sod": detector["source_object_mm"],
            "sdd": detector["source_detector_mm"],
            "settings": [str(setting) for setting in line.settings],
        },
    )
    write_json(folder / "noise.json", detector)
    files = {
        "leap_spectra.npz": "Es (keV), spectra (photons a bin, mAs and mm2 at 1 m), detector_response (DN a photon), their product",
        "leap_geometry.json": "arguments of set_conebeam",
        "noise.json": "detector, dark, electronic noise",
    }
    return files, ("LEAP is on no registry: these files were not tried with it",)


FORMATS: dict[str, Callable[[_Line, Path], tuple[dict[str, str], tuple[str, ...]]]] = {
    "csv": _to_csv,
    "gvxr": _to_gvxr,
    "xcist": _to_xcist,
    "leap": _to_leap,
}
