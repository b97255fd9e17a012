"""Twin files: HDF5, `format = "raytwin-twin"`, version 1. Numbers and text only; nothing is ever unpickled.

The twin of a tube alone has `part = "tube"` among its root attributes and no groups of a detector.
"""

import json
import math
import os
import sys
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._guard import bounded
from ...acquisition.instrument import Instrument
from ...acquisition.setting import filters_from_text, text_from_filters
from ...errors import FileFormatError, InputError
from ...files import whole_file
from ..effects import AppliedEffect, in_order
from ..line.spectral_signal import SpectrumCorrection
from ..line.twin import (
    BAD_PIXEL_MAP,
    LEAST_PIXELS,
    DetectorMaps,
    Estimate,
    Level,
    NoiseModel,
    OtherSpread,
    SpectralPosterior,
    SpreadEstimate,
    Twin,
    gaussian_spread,
)
from ..predictions.tube_twin import TubeTwin
from ..spread.psf import Spread

FORMAT = "raytwin-twin"
VERSION = 1
_READING_S = 20.0  # of processor time, for what takes a second or two: at some damaged files HDF5 reads on without end
_LARGEST_EXPONENT = math.log(sys.float_info.max)
TUBE = "tube"
_SDS_OF_EFFECTS = ("strength_sd", "law_sd")
_SHAPE_OF_SPREAD = ("aspect", "tail_share", "tail_px", "tail_order", "absorption_per_px")
_OF_LEVELS = ("source_detector_mm", "saturation_DN", "exposures", "signal_DN", "dark_noise")
_MAPS = ("dark_DN", "dark_DN_per_ms", "gain_relative", "read_variance_DN2", BAD_PIXEL_MAP)


def _put_estimate(group: Any, name: str, estimate: Estimate | None) -> None:
    if estimate is not None:
        group.attrs[name] = np.array([estimate.value, estimate.low, estimate.high])


def _get_estimate(group: Any, name: str) -> Estimate | None:
    if name not in group.attrs:
        return None
    value, low, high = (float(item) for item in group.attrs[name])
    return Estimate(value=value, low=low, high=high)


def _required(estimate: Estimate | None, name: str, path: object) -> Estimate:
    if estimate is None:
        raise FileFormatError(f"twin {path}", received=f"no {name}", expected="a complete twin file")
    return estimate


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _object(value: Any) -> dict[str, Any]:
    """Names with values, of their JSON."""
    found = json.loads(_text(value))
    if not isinstance(found, dict):
        raise ValueError(f"{type(found).__name__} where names with values belong")
    return found


def _texts(value: Any) -> tuple[str, ...]:
    """Texts, of their JSON."""
    found = json.loads(_text(value))
    if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
        raise ValueError(f"{type(found).__name__} where a list of texts belongs")
    return tuple(found)


def write_twin(path: str | os.PathLike[str], twin: Twin | TubeTwin) -> None:
    """Write a twin, whole or of a tube alone; the file appears whole or not at all."""
    import h5py

    from ...acquisition._hdf5 import mark_as_pictures
    from ...acquisition.instrument_io import write_instrument

    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.attrs["provenance"] = json.dumps(dict(twin.provenance))
        file.attrs["evidence"] = json.dumps(dict(twin.evidence))
        file.attrs["warnings"] = json.dumps(list(twin.warnings))
        write_instrument(file.create_group("instrument"), twin.instrument)
        if isinstance(twin, TubeTwin):
            file.attrs["part"] = TUBE
            file.attrs["output_known"] = twin.output_known
            _put_spectral(file, twin.spectral)
            return
        if twin.layer is not None:
            file.attrs["layer"] = twin.layer
        if twin.effects:
            in_order(twin.effects)  # refuses what could not be read back
            file.attrs["effects"] = json.dumps(
                [
                    {
                        "id": item.id,
                        "parameters": dict(item.parameters),
                        "since": item.since,
                        "options": dict(item.options),
                    }
                    | {name: getattr(item, name) for name in _SDS_OF_EFFECTS if getattr(item, name) is not None}
                    for item in twin.effects
                ]
            )
        maps = file.create_group("maps")
        for name in _MAPS:
            maps.create_dataset(name, data=getattr(twin.maps, name), compression="gzip", shuffle=True)
        mark_as_pictures(maps, _MAPS[0], others=_MAPS[1:])
        file.attrs.update({"NX_class": "NXroot", "default": "maps"})
        if twin.maps.dark_exposure_ms is not None:
            maps.attrs["dark_exposure_ms"] = twin.maps.dark_exposure_ms
        if twin.maps.dark_noise is not None:
            maps.attrs["dark_noise"] = twin.maps.dark_noise
        noise = file.create_group("noise")
        spread = twin.noise.spread
        noise.attrs["psf_model"] = spread.value.model
        noise.attrs["spread_axes"] = spread.value.axes
        noise.attrs["spread_family"] = spread.family
        noise.attrs["spread_others"] = json.dumps([asdict(item) for item in spread.others])
        for name in _SHAPE_OF_SPREAD:
            noise.attrs[name] = getattr(spread.value, name)
            if name in spread.intervals:
                _put_estimate(noise, f"{name}_interval", spread.intervals[name])
        noise.attrs["white_fraction"] = twin.noise.white_fraction
        noise.attrs["quantised"] = twin.noise.quantised
        if twin.noise.shared_gain_sd is not None:
            noise.attrs["shared_gain_sd"] = twin.noise.shared_gain_sd
        if twin.noise.common_variance is not None:
            _put_estimate(noise, "common_variance", twin.noise.common_variance)
        exact = Estimate(value=spread.value.sigma_px, low=spread.value.sigma_px, high=spread.value.sigma_px)
        _put_estimate(noise, "psf_sigma_px", spread.intervals.get("sigma_px", exact))
        _put_estimate(noise, "read_noise_DN", twin.noise.read_noise_DN)
        _put_estimate(noise, "dark_DN", twin.dark_DN)
        levels = file.create_group("levels")
        for index, level in enumerate(twin.levels):
            group = levels.create_group(f"{index:04d}")
            if level.kV is not None:
                group.attrs["kV"] = level.kV
            group.attrs["filter"] = text_from_filters(level.filters)
            group.attrs["series"] = json.dumps(list(level.series))
            group.attrs["role"] = level.role
            for name in ("gain_DN", "photon_transfer_slope_DN", "rate_DN_per_mAs"):
                _put_estimate(group, name, getattr(level, name))
            for name in _OF_LEVELS:
                if getattr(level, name) is not None:
                    group.attrs[name] = getattr(level, name)
            group.create_dataset("flat_shape", data=level.flat_shape, compression="gzip", shuffle=True)
        if twin.spectral is not None:
            _put_spectral(file, twin.spectral)


def _put_spectral(file: Any, posterior: SpectralPosterior) -> None:
    spectral = file.create_group("spectral")
    spectral.create_dataset("samples", data=posterior.samples, compression="gzip", shuffle=True)
    spectral.create_dataset("best", data=posterior.best)
    spectral.attrs["names"] = json.dumps(list(posterior.names))
    spectral.attrs["prior"] = json.dumps(dict(posterior.prior))
    spectral.attrs["undetermined"] = json.dumps(list(posterior.undetermined))
    for name in (
        "anode",
        "anode_angle_deg",
        "model",
        "counting",
        "level_discrepancy",
        "gain_discrepancy",
        "secondary_DN",
    ):
        spectral.attrs[name] = getattr(posterior, name)
    for name in ("inherent", "scintillator", "alternative", "cover"):
        spectral.attrs[name] = text_from_filters(getattr(posterior, name))
    if posterior.kerma_discrepancy is not None:
        spectral.attrs["kerma_discrepancy"] = posterior.kerma_discrepancy
    if posterior.correction is not None:
        corrected = spectral.create_dataset("log_correction", data=posterior.correction.log_ratio)
        corrected.attrs["kV"] = np.array(posterior.correction.kV)
        corrected.attrs["relative"] = posterior.correction.relative
    spectral.attrs["calibrated_kV"] = np.array(posterior.calibrated_kV)
    spectral.attrs["calibrated_filters"] = json.dumps(list(posterior.calibrated_filters))


def _array(group: Any, name: str, dtype: type[Any]) -> NDArray[Any]:
    from ...acquisition._hdf5 import real_numbers

    return real_numbers(group[name][()], dtype, where=f"twin {group.file.filename}, {group.name.strip('/')}/{name}")


def read_twin(path: str | os.PathLike[str]) -> Twin:
    """Read the file of a whole twin: tube and detector.

    Raises:
        FileFormatError: no such file, not HDF5, truncated, another format or version, or parts missing; the twin of a tube
            alone (`read_any_twin`).
    """
    twin = read_any_twin(path)
    if isinstance(twin, TubeTwin):
        raise FileFormatError(
            f"twin {path}",
            received="the twin of a tube alone",
            expected="a twin with a detector",
            remedy="calibrate from flats too; spectrum, mu, contrast and predict take this one",
        )
    return twin


def read_any_twin(path: str | os.PathLike[str]) -> Twin | TubeTwin:
    """Read a twin file, of a whole line or of a tube alone.

    Raises:
        FileFormatError: no such file, not HDF5, truncated, another format or version, or parts missing.
    """
    from ...acquisition._hdf5 import HDF5_ERRORS, check_format, open_hdf5

    if not os.path.isfile(path):
        raise FileFormatError(
            "twin", received=path, expected="an existing file that `raytwin calibrate` wrote", remedy="check the path"
        )
    with open_hdf5(path, what="a twin file that `raytwin calibrate` wrote") as file, bounded(_READING_S):
        try:
            check_format(
                file,
                path=f"twin {path}",
                format_name=FORMAT,
                version=VERSION,
                remedy="calibrate again with this raytwin",
            )
            if _text(file.attrs.get("part", "")) == TUBE:
                return _tube_from_file(file, path)
            return _twin_from_file(file, path)
        except InputError:
            raise
        except HDF5_ERRORS as error:
            raise FileFormatError(
                f"twin {path}",
                received=f"a damaged file ({' '.join(str(error).split()) or type(error).__name__})",
                expected="a complete twin file",
                remedy="calibrate again",
            ) from None


def _instrument_from_file(file: Any, path: object) -> Instrument:
    from ...acquisition.instrument_io import read_instrument

    return read_instrument(file["instrument"], path=f"twin {path}")


def _tube_from_file(file: Any, path: object) -> TubeTwin:
    return TubeTwin(
        instrument=_instrument_from_file(file, path),
        spectral=_spectral_from_group(file["spectral"], path),
        output_known=bool(file.attrs["output_known"]),
        evidence=_object(file.attrs["evidence"]),
        warnings=_texts(file.attrs["warnings"]),
        provenance=_object(file.attrs["provenance"]),
    )


def _twin_from_file(file: Any, path: object) -> Twin:
    instrument = _instrument_from_file(file, path)
    maps = file["maps"]
    noise = file["noise"]
    levels = []
    for name in sorted(file["levels"]):
        group = file["levels"][name]
        levels.append(
            Level(
                kV=float(group.attrs["kV"]) if "kV" in group.attrs else None,
                filters=filters_from_text(_text(group.attrs["filter"])),
                gain_DN=_required(_get_estimate(group, "gain_DN"), "gain_DN", path),
                photon_transfer_slope_DN=_required(
                    _get_estimate(group, "photon_transfer_slope_DN"), "photon_transfer_slope_DN", path
                ),
                rate_DN_per_mAs=_get_estimate(group, "rate_DN_per_mAs"),
                **{name: _optional_number(group, name, path) for name in _OF_LEVELS},
                flat_shape=_array(group, "flat_shape", np.float32),
                series=_texts(group.attrs["series"]),
                role=_text(group.attrs["role"]),
            )
        )
    shapes = {maps[name].shape for name in _MAPS} | {level.flat_shape.shape for level in levels}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise FileFormatError(
            f"twin {path}", received=f"maps of shapes {sorted(shapes)}", expected="maps (row, column) of one shape"
        )
    bad = _array(maps, BAD_PIXEL_MAP, np.uint8)
    usable = int(np.count_nonzero(bad == 0))
    if usable < LEAST_PIXELS:
        raise FileFormatError(
            f"twin {path}", received=f"{usable} pixels that are not bad", expected=f"at least {LEAST_PIXELS}"
        )
    spectral = _spectral_from_group(file["spectral"], path) if "spectral" in file else None
    return Twin(
        instrument=instrument,
        maps=DetectorMaps(
            dark_DN=_array(maps, "dark_DN", np.float32),
            dark_exposure_ms=_optional_float(maps, "dark_exposure_ms"),
            dark_DN_per_ms=_array(maps, "dark_DN_per_ms", np.float32),
            gain_relative=_array(maps, "gain_relative", np.float32),
            read_variance_DN2=_array(maps, "read_variance_DN2", np.float32),
            bad_pixels=bad,
            dark_noise=_dark_noise(maps, path),
        ),
        noise=NoiseModel(
            spread=_spread(noise, path),
            white_fraction=float(noise.attrs["white_fraction"]),
            read_noise_DN=_required(_get_estimate(noise, "read_noise_DN"), "read_noise_DN", path),
            quantised=bool(noise.attrs["quantised"]),
            shared_gain_sd=_optional_float(noise, "shared_gain_sd"),
            common_variance=_get_estimate(noise, "common_variance"),
        ),
        dark_DN=_required(_get_estimate(noise, "dark_DN"), "dark_DN", path),
        levels=tuple(levels),
        spectral=spectral,
        evidence=_object(file.attrs["evidence"]),
        warnings=_texts(file.attrs["warnings"]),
        provenance=_object(file.attrs["provenance"]),
        effects=_effects_from_text(_text(file.attrs["effects"])) if "effects" in file.attrs else (),
        layer=_text(file.attrs["layer"]) if "layer" in file.attrs else None,
    )


def _spread(noise: Any, path: object) -> SpreadEstimate:
    """The spread; files of raytwin 0.1 have a Gaussian."""
    sigma = _required(_get_estimate(noise, "psf_sigma_px"), "psf_sigma_px", path)
    model = _text(noise.attrs["psf_model"])
    if "tail_share" not in noise.attrs:
        return gaussian_spread(model, sigma)
    # files from before layers that absorb and line cameras
    none = {"absorption_per_px": 0.0, "axes": "both"}
    shape = {name: float({**none, **noise.attrs}[name]) for name in _SHAPE_OF_SPREAD}
    axes = _text(noise.attrs.get("spread_axes", "both"))
    found = {name: _get_estimate(noise, f"{name}_interval") for name in shape}
    return SpreadEstimate(
        value=Spread(model=model, sigma_px=sigma.value, axes=axes, **shape),
        family=_text(noise.attrs["spread_family"]),
        intervals={"sigma_px": sigma} | {name: known for name, known in found.items() if known is not None},
        others=tuple(
            OtherSpread(
                family=str(item["family"]),
                probability=float(item["probability"]),
                value=Spread(**{name: (none | item["value"])[name] for name in ("model", "sigma_px", "axes", *shape)}),
            )
            for item in json.loads(_text(noise.attrs.get("spread_others", "[]")))
        ),
    )


def _spectral_from_group(group: Any, path: object) -> SpectralPosterior:
    attributes = group.attrs
    spectral = SpectralPosterior(
        names=_texts(attributes["names"]),
        samples=_array(group, "samples", np.float64),
        best=_array(group, "best", np.float64),
        prior=_object(attributes["prior"]),
        undetermined=_texts(attributes["undetermined"]),
        anode=_text(attributes["anode"]),
        anode_angle_deg=float(attributes["anode_angle_deg"]),
        model=_text(attributes["model"]),
        inherent=filters_from_text(_text(attributes["inherent"])),
        scintillator=filters_from_text(_text(attributes["scintillator"])),
        alternative=filters_from_text(_text(attributes.get("alternative", ""))),
        correction=_correction(group),
        cover=filters_from_text(_text(attributes["cover"])),
        counting=bool(attributes["counting"]),
        level_discrepancy=float(attributes["level_discrepancy"]),
        gain_discrepancy=float(attributes["gain_discrepancy"]),
        kerma_discrepancy=_optional_float(group, "kerma_discrepancy"),
        secondary_DN=_optional_float(group, "secondary_DN") or 0.0,
        calibrated_kV=(float(attributes["calibrated_kV"][0]), float(attributes["calibrated_kV"][1])),
        calibrated_filters=_texts(attributes["calibrated_filters"]),
    )
    wide = len(spectral.names)
    samples, best = spectral.samples, spectral.best
    whole = samples.ndim == 2 and len(samples) > 0 and samples.shape[1] == wide and best.shape == (wide,)
    # parameters are exponents of what is computed from them; not finite ones fail, too
    if not (whole and all(bool((np.abs(values) < _LARGEST_EXPONENT).all()) for values in (samples, best))):
        raise FileFormatError(
            f"twin {path}, spectral",
            received=f"draws of shape {samples.shape} and best of {best.shape}, or values that are not finite",
            expected=f"finite draws (n, {wide}) and best ({wide},), all below {_LARGEST_EXPONENT:.0f}",
            remedy="calibrate again",
        )
    if not 0.0 <= spectral.secondary_DN < math.inf:
        raise FileFormatError(
            f"twin {path}, spectral",
            received=f"secondary_DN of {spectral.secondary_DN}",
            expected="a number of 0 or more",
            remedy="calibrate again",
        )
    return spectral


def _effects_from_text(text: str) -> tuple[AppliedEffect, ...]:
    effects = tuple(
        AppliedEffect(
            id=str(item["id"]),
            parameters={str(name): float(value) for name, value in item["parameters"].items()},
            since=str(item["since"]),
            options={str(name): str(value) for name, value in item.get("options", {}).items()},
            **{name: float(item[name]) for name in _SDS_OF_EFFECTS if name in item},
        )
        for item in json.loads(text)
    )
    in_order(effects)  # names the effects and parameters that it does not know
    return effects


def _correction(group: Any) -> SpectrumCorrection | None:
    if "log_correction" not in group:
        return None
    stored = group["log_correction"]
    return SpectrumCorrection(
        kV=tuple(float(value) for value in stored.attrs["kV"]),
        log_ratio=_array(group, "log_correction", np.float64),
        relative=bool(stored.attrs["relative"]),
    )


def _optional_float(group: Any, name: str) -> float | None:
    return float(group.attrs[name]) if name in group.attrs else None


def _optional_number(group: Any, name: str, path: object) -> float | None:
    """A finite number of 0 or more, or None."""
    value = _optional_float(group, name)
    if value is not None and not 0.0 <= value < math.inf:
        raise FileFormatError(f"{name} of twin {path}", received=value, expected="a finite number, 0 or more")
    return value


def _dark_noise(maps: Any, path: object) -> tuple[float, float, float] | None:
    """Noise of the dark; None where the file does not say it."""
    if "dark_noise" not in maps.attrs:
        return None
    stored = np.atleast_1d(np.asarray(maps.attrs["dark_noise"]))
    if stored.shape != (3,) or stored.dtype.kind not in "iuf" or not np.all(np.isfinite(stored)):
        raise FileFormatError(f"dark_noise of twin {path}", received=f"{stored.tolist()}", expected="three numbers")
    same, mixed, grown = map(float, stored)
    return same, mixed, grown
