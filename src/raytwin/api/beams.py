"""Beams before any calibration: tube spectrum, effective attenuation, contrast of a foreign object."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from ..acquisition.setting import Filter, Setting, filter_from_text, text_from_filters
from ..errors import InputError, check_number
from ..materials import TABLES, Library, library_from_files, material_from_name, nist_identifier
from ..results import Result, Table, axes_or_new, frame, interval_text, number_text, plain
from ._given import PathLike, as_any_twin
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import pandas

    from ..generator.line.twin import Twin
    from ..generator.predictions.contrast import Contrast, UncalibratedLine
    from ..generator.predictions.tube_twin import TubeTwin
    from ..materials import Material
    from ..spectra import Response, Spectrum

Layers = str | Filter | Sequence[str | Filter]
_SOFT_KEV = 12.0
_SOFT_SHARE = 0.1
MOST_VALUES = 100  # of an axis of a map
AXES = {"kV_low": "low tube voltage (kV)", "kV_high": "high tube voltage (kV)", "filter": "filter (mm)"}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class BeamSpectrum(Result):
    """A spectrum behind filters at 1 m in vacuum, and its half-value layers, mean energy and air kerma.

    Fields: spectrum (energies_keV and fluence (energy,), photons / keV / cm2 / mAs, or relative where it was measured so);
    mean_energy_keV; hvl_mm_Al, hvl_mm_Cu, second_hvl_mm_Al; air_kerma_uGy_per_mAs, photons_per_cm2_mAs (None where the
    spectrum is relative); table (attenuation data); warnings; intervals (95 %, by name), twin and extrapolated: of a calibrated
    tube alone.
    """

    spectrum: "Spectrum"
    mean_energy_keV: float
    hvl_mm_Al: float
    hvl_mm_Cu: float
    second_hvl_mm_Al: float
    air_kerma_uGy_per_mAs: float | None
    photons_per_cm2_mAs: float | None
    table: str
    warnings: tuple[str, ...] = ()
    intervals: Mapping[str, Any] | None = None
    twin: str | None = None
    extrapolated: bool = False

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin spectrum --json` prints."""
        beam = self.spectrum
        names = ("mean_energy_keV", "hvl_mm_Al", "hvl_mm_Cu", "second_hvl_mm_Al")
        found: dict[str, Any] = plain(
            {
                "energies_keV": beam.energies_keV,
                "fluence": beam.fluence,
                "fluence_unit": self.unit,
                "bin_width_keV": beam.bin_width_keV,
                **{name: getattr(self, name) for name in names},
                "air_kerma_uGy_per_mAs": self.air_kerma_uGy_per_mAs,
                "photons_per_cm2_mAs": self.photons_per_cm2_mAs,
                "kV": beam.kV,
                "anode": beam.anode,
                "anode_angle_deg": beam.anode_angle_deg,
                "model": beam.model,
                "model_version": beam.model_version,
                "filters": [str(layer) for layer in beam.filters],
                "attenuation_table": self.table,
                **self._of_twin(),
            }
        )
        return found

    def _of_twin(self) -> dict[str, Any]:
        if self.twin is None:
            return {}
        told = {"intervals": self.intervals, "twin": self.twin, "extrapolated": self.extrapolated}
        return {**told, "warnings": self.warnings}

    @property
    def unit(self) -> str:
        """Unit of the fluence."""
        return "photons/keV/cm2/mAs at 1 m" if self.spectrum.absolute else "relative, per keV"

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row an energy: energy_keV, fluence."""
        import pandas

        return pandas.DataFrame({"energy_keV": self.spectrum.energies_keV, "fluence": self.spectrum.fluence})

    def plot(self, ax: Any = None) -> Any:
        """Fluence against photon energy; returns the axes."""
        axes = axes_or_new(ax)
        axes.plot(self.spectrum.energies_keV, self.spectrum.fluence, drawstyle="steps-mid", lw=1)
        axes.set(xlabel="photon energy (keV)", ylabel=f"fluence ({self.unit})")
        return axes

    def _table(self) -> Table:
        rows = tuple(
            (title, *_cells(name, value, self.intervals), unit)
            for title, name, value, unit in (
                ("mean energy", "mean_energy_keV", self.mean_energy_keV, "keV"),
                ("half-value layer", "hvl_mm_Al", self.hvl_mm_Al, "mm Al"),
                ("second half-value layer", "second_hvl_mm_Al", self.second_hvl_mm_Al, "mm Al"),
                ("half-value layer", "hvl_mm_Cu", self.hvl_mm_Cu, "mm Cu"),
                ("air kerma", "air_kerma_uGy_per_mAs", self.air_kerma_uGy_per_mAs, "uGy per mAs at 1 m"),
                ("photons", "photons_per_cm2_mAs", self.photons_per_cm2_mAs, "per cm2 and mAs at 1 m"),
            )
        )
        interval = () if self.intervals is None else ("95 % interval",)
        notes = tuple(f"note: {text}" for text in self.warnings)
        return Table(
            title=describe_beam(self.spectrum), header=("", "value", *interval, "unit"), rows=rows, notes=notes
        )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Attenuation(Result):
    """Attenuation of a material in a beam and for a detector, or at one photon energy.

    Fields: material; where (in words); mu_eff_per_mm (limit of a thin object, or at the energy);
    mu_eff_at_thickness_per_mm (as measured through thickness_mm; None without one); thickness_mm; energy_keV and
    mass_attenuation_cm2_g (None in a beam); table (attenuation data); warnings; intervals (95 %) and twin of a calibrated tube.
    """

    material: "Material"
    where: str
    mu_eff_per_mm: float
    mu_eff_at_thickness_per_mm: float | None
    thickness_mm: float | None
    energy_keV: float | None
    mass_attenuation_cm2_g: float | None
    table: str
    warnings: tuple[str, ...] = ()
    intervals: Mapping[str, Any] | None = None
    twin: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin mu --json` prints."""
        at_energy = {}
        if self.energy_keV is not None:
            at_energy = {"energy_keV": self.energy_keV, "mass_attenuation_cm2_g": self.mass_attenuation_cm2_g}
        found: dict[str, Any] = plain(
            {
                "material": self.material.name,
                "density_g_cm3": self.material.density_g_cm3,
                "source": self.material.source,
                "mass_fractions": dict(self.material.mass_fractions),
                "attenuation_table": self.table,
                "thickness_mm": self.thickness_mm,
                **at_energy,
                "mu_eff_per_mm": self.mu_eff_per_mm,
                "mu_eff_at_thickness_per_mm": self.mu_eff_at_thickness_per_mm,
                **({} if self.twin is None else {"intervals": self.intervals, "twin": self.twin}),
            }
        )
        return found

    def _table(self) -> Table:
        title = "at the energy" if self.energy_keV is not None else "thin object"
        values = [(title, "mu_eff_per_mm", self.mu_eff_per_mm)]
        if self.energy_keV is None and self.mu_eff_at_thickness_per_mm is not None:
            through = f"through {self.thickness_mm:g} mm"
            values.append((through, "mu_eff_at_thickness_per_mm", self.mu_eff_at_thickness_per_mm))
        rows = tuple((title, *_cells(name, value, self.intervals, digits=6)) for title, name, value in values)
        interval = () if self.intervals is None else ("95 % interval",)
        title = f"{self.material.name}, {self.material.density_g_cm3:.4g} g/cm3, {self.where}"
        notes = tuple(f"note: {text}" for text in self.warnings)
        return Table(title=title, header=("", "mu, /mm", *interval), rows=rows, notes=notes)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class ObjectContrast(Result):
    """Contrast of a foreign object in a product at a pair of settings.

    Fields: contrast (delta_R, noise and contrast-to-noise ratio, both beams); product and foreign_object with their
    thicknesses; displaces; twin (its name or file, None: the line as stated).
    """

    contrast: "Contrast"
    product: Filter
    foreign_object: Filter
    displaces: bool
    twin: str | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What limits the numbers."""
        return self.contrast.warnings

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin contrast --json` prints."""
        found: dict[str, Any] = plain({**_slabs_answer(self, self.contrast.object_pixels), **self.contrast.as_dict()})
        return found

    def _table(self) -> Table:
        found = self.contrast
        rows = [("Delta R", *interval_text(None if found.delta_R is None else found.delta_R.as_dict()))]
        rows.append(("  as published", number_text(found.delta_R_as_published), ""))
        rows.append(("contrast to noise, one pixel", number_text(found.cnr_pixel), ""))
        rows.append(("contrast to noise, the object", number_text(found.cnr_object), ""))
        title = f"{self.foreign_object} mm in {self.product} mm, {found.object_pixels} pixels"
        notes = (str(found.low.setting), str(found.high.setting), *(f"warning: {text}" for text in self.warnings))
        return Table(title=title, header=("", "value", "95 % interval"), rows=tuple(rows), notes=notes)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class ContrastMap(Result):
    """Contrast of a foreign object over two axes of settings.

    Fields: row_axis, column_axis (`kV_low`, `kV_high` or `filter`); row_values, column_values (kV, or layers); grid: rows of
    columns of contrasts; product, foreign_object, displaces, twin as in `ObjectContrast`.
    """

    row_axis: str
    column_axis: str
    row_values: tuple[Any, ...]
    column_values: tuple[Any, ...]
    grid: "tuple[tuple[Contrast, ...], ...]"
    product: Filter
    foreign_object: Filter
    displaces: bool
    twin: str | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What limits the numbers, each once."""
        return tuple(dict.fromkeys(text for row in self.grid for one in row for text in one.warnings))

    @property
    def best(self) -> "Contrast | None":
        """The pair of settings with the largest contrast-to-noise ratio of the object; None: the detector saturates at all."""
        shown = [one for row in self.grid for one in row if one.cnr_object is not None]
        return max(shown, key=lambda one: one.cnr_object or 0.0, default=None)

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin contrast --json` prints for a map."""
        best = self.best
        axes = (
            ("rows", self.row_axis, self.row_values),
            ("columns", self.column_axis, self.column_values),
        )
        found: dict[str, Any] = plain(
            {
                **_slabs_answer(self, self.grid[0][0].object_pixels),
                **{
                    place: {"axis": axis.lower(), "values": [_label(axis, value) for value in values]}
                    for place, axis, values in axes
                },
                "delta_R": [[_delta_R(one) for one in row] for row in self.grid],
                "cnr_pixel": [[one.cnr_pixel for one in row] for row in self.grid],
                "cnr_object": [[one.cnr_object for one in row] for row in self.grid],
                "best": best
                and {
                    "low": str(best.low.setting),
                    "high": str(best.high.setting),
                    "delta_R": _delta_R(best),
                    "cnr_object": best.cnr_object,
                },
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a pair of settings: the two axes, delta_R, cnr_pixel, cnr_object."""
        return frame(
            [
                {
                    self.row_axis: _label(self.row_axis, row_value),
                    self.column_axis: _label(self.column_axis, column_value),
                    "delta_R": _delta_R(one),
                    "cnr_pixel": one.cnr_pixel,
                    "cnr_object": one.cnr_object,
                }
                for row_value, row in zip(self.row_values, self.grid, strict=True)
                for column_value, one in zip(self.column_values, row, strict=True)
            ]
        )

    def plot(self, ax: Any = None, *, what: str = "cnr_object") -> Any:
        """`cnr_object`, `cnr_pixel` or `delta_R` as a map; returns the axes.

        Raises:
            InputError: another quantity.
        """
        names = {
            "delta_R": "Delta R",
            "cnr_pixel": "contrast to noise of a pixel",
            "cnr_object": "contrast to noise of the object",
        }
        if what not in names:
            raise InputError("what", received=repr(what), expected="one of " + ", ".join(names))
        axes = axes_or_new(ax)
        numbers = [[math.nan if one is None else one for one in row] for row in self.to_dict()[what]]
        image = axes.imshow(numbers, origin="lower", aspect="auto", cmap="viridis")
        axes.figure.colorbar(image, ax=axes)
        sides = ((axes.xaxis, self.column_axis, self.column_values), (axes.yaxis, self.row_axis, self.row_values))
        for side, axis, values in sides:
            shown = range(0, len(values), -(-len(values) // 12))
            side.set_ticks(list(shown), [_tick(_label(axis, values[item])) for item in shown])
        axes.set(title=names[what], xlabel=AXES[self.column_axis], ylabel=AXES[self.row_axis])
        return axes

    def _table(self) -> Table:
        best = self.best
        rows: tuple[tuple[str, str], ...] = (("contrast to noise of the object", number_text(None)),)
        if best is not None:
            rows = (
                ("Delta R", number_text(_delta_R(best))),
                ("contrast to noise of the object", number_text(best.cnr_object)),
                ("low", str(best.low.setting)),
                ("high", str(best.high.setting)),
            )
        size = f"{len(self.row_values)} {self.row_axis} x {len(self.column_values)} {self.column_axis}"
        title = f"{self.foreign_object} mm in {self.product} mm over {size}: best"
        return Table(title=title, rows=rows, notes=tuple(f"warning: {text}" for text in self.warnings))


def _delta_R(found: "Contrast") -> float | None:
    return None if found.delta_R is None else found.delta_R.value


def _slabs_answer(found: "ObjectContrast | ContrastMap", object_pixels: int) -> dict[str, Any]:
    return {
        "product": str(found.product),
        "object": str(found.foreign_object),
        "object_pixels": object_pixels,
        "displaces": found.displaces,
        "twin": found.twin,
    }


def _label(axis: str, value: Any) -> Any:
    return (text_from_filters(value) or "none") if axis == "filter" else value


def _tick(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def as_layers(value: Layers, library: Library) -> tuple[Filter, ...]:
    """Layers from texts or filters; each name is looked up, a NIST name with commas by its plain spelling.

    Raises:
        InputError: neither texts nor filters, a text that is no layer, or a material that nobody knows.
    """
    layers = []
    given = tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)
    for item in given:
        if not isinstance(item, str | Filter):
            raise InputError(
                "filter", received=repr(value), expected='a text such as "Cu:0.1+Al:1", a Filter, or a list of these'
            )
        parts = (
            [item] if isinstance(item, Filter) else [part for part in item.split("+") if part.strip() or item.strip()]
        )
        for part in parts:
            if isinstance(part, Filter):
                layer = part
            else:
                name, colon, thickness = part.rpartition(":")
                known = nist_identifier(name) if colon and "," in name else None
                layer = filter_from_text(f"{known}:{thickness}" if known else part)
            material_from_name(layer.material, library=library)
            layers.append(layer)
    return tuple(layers)


def _cells(name: str, value: float | None, intervals: Mapping[str, Any] | None, *, digits: int = 4) -> tuple[str, ...]:
    """A value for a table; where intervals were asked for, the value's own in the next column."""
    text = number_text(value, digits)
    if intervals is None:
        return (text,)
    return text, interval_text(intervals.get(name), digits)[1]


def describe_beam(beam: "Spectrum") -> str:
    """One line about where a spectrum comes from."""
    behind = " behind " + " + ".join(f"{layer.thickness_mm:g} mm {layer.material}" for layer in beam.filters)
    version = f" ({beam.model_version})" if beam.model_version else ""
    if beam.anode is None:
        return f"{beam.model}{behind if beam.filters else ''}"
    return (
        f"{beam.kV:g} kV, {beam.anode} anode at {beam.anode_angle_deg:g} degrees, {beam.model}"
        f"{version}{behind if beam.filters else ', unfiltered'}"
    )


def _soft(beam: "Spectrum") -> tuple[str, ...]:
    """A note where photons that no real window passes make up much of the beam's energy."""
    energy = beam.energies_keV * beam.fluence
    share = float(energy[beam.energies_keV < _SOFT_KEV].sum() / energy.sum())
    if not (share > _SOFT_SHARE and beam.anode is not None):
        return ()
    return (
        f"{100 * share:.0f} % of the beam's energy lies below {_SOFT_KEV:g} keV, which most tube windows stop;"
        " name the inherent filtration, for example Be:0.8 and Al:1 among the filters",
    )


def _beam(
    *,
    kV: float | None,
    filters: Layers,
    anode: str | None,
    anode_angle_deg: float | None,
    model: str | None,
    spectrum_file: str | os.PathLike[str] | None,
    table: str,
    library: Library,
) -> "Spectrum":
    from ..spectra import (
        DEFAULT_ANGLE_DEG,
        DEFAULT_ANODE,
        DEFAULT_MODEL,
        filtered_spectrum,
        spectrum_from_file,
        tube_spectrum,
    )

    if table not in TABLES:
        raise InputError("table", received=repr(table), expected=f"one of {', '.join(TABLES)}")
    layers = as_layers(filters, library)
    if spectrum_file is not None:
        return filtered_spectrum(spectrum_from_file(spectrum_file, kV=kV), layers, table=table, library=library)
    if kV is None:
        raise InputError("kV", received="nothing", expected="the tube voltage in kV, or the file of a spectrum")
    return tube_spectrum(
        kV=kV,
        filters=layers,
        anode=DEFAULT_ANODE if anode is None else anode,
        anode_angle_deg=DEFAULT_ANGLE_DEG if anode_angle_deg is None else anode_angle_deg,
        model=DEFAULT_MODEL if model is None else model,
        table=table,
        library=library,
    )


def spectrum(
    *,
    kV: float | None = None,
    twin: "Twin | TubeTwin | PathLike | None" = None,
    filter: Layers = (),
    anode: str | None = None,
    anode_angle_deg: float | None = None,
    model: str | None = None,
    spectrum_file: str | os.PathLike[str] | None = None,
    table: str = "xraylib",
    library: Sequence[str | os.PathLike[str]] = (),
) -> BeamSpectrum:
    """Spectrum of a tube behind filters at 1 m in vacuum, photons / keV / cm2 / mAs, with half-value layers and air kerma.

    Nothing is added on the way: a window is a filter (`Be:0.8`), air is a filter (`air:1000`).

    Args:
        kV: tube voltage, 10 to 300 kV (anodes other than W: to 50).
        twin: a calibrated line or tube, in place of the arguments from anode on; the answer then has intervals.
        filter: layers in the beam, `"Cu:0.1+Al:1"` or a list of such.
        anode: W, Mo, Rh, Ag, Cr, Cu or Au; None: W.
        anode_angle_deg: 1 to 60 degrees; None: 12.
        model: SpekPy's, `casim` or `kqp`; None: `casim`.
        spectrum_file: a measured spectrum (two columns: keV, fluence) in place of the tube.
        table: attenuation data, `xraylib`, `chantler` or `penelope`.
        library: files of your own materials (TOML).

    Returns:
        The spectrum with what follows from it.

    Raises:
        InputError: an argument outside its range, an unknown anode, model, table or material.

    Source: SpekPy, see `raytwin.spectra.tube_spectrum`.

    Example:
        >>> beam = rt.spectrum(kV=60, filter="Al:2.5")
        >>> 30 < beam.mean_energy_keV < 40
        True
    """
    from ..spectra import air_kerma_uGy_per_mAs, fluence_per_cm2_mAs, half_value_layer_mm, mean_energy_keV

    if twin is not None:
        _alone(anode, anode_angle_deg, model, spectrum_file, table=table)
        return _spectrum_of_twin(twin, kV=kV, layers=as_layers(filter, library_from_files(library)))
    beam = _beam(
        kV=kV,
        filters=filter,
        anode=anode,
        anode_angle_deg=anode_angle_deg,
        model=model,
        spectrum_file=spectrum_file,
        table=table,
        library=library_from_files(library),
    )
    aluminium, copper = material_from_name("aluminium"), material_from_name("copper")
    first_mm_Al = half_value_layer_mm(beam, aluminium)
    return BeamSpectrum(
        spectrum=beam,
        mean_energy_keV=mean_energy_keV(beam),
        hvl_mm_Al=first_mm_Al,
        hvl_mm_Cu=half_value_layer_mm(beam, copper),
        second_hvl_mm_Al=half_value_layer_mm(beam, aluminium, fraction=0.25) - first_mm_Al,
        air_kerma_uGy_per_mAs=air_kerma_uGy_per_mAs(beam) if beam.absolute else None,
        photons_per_cm2_mAs=fluence_per_cm2_mAs(beam) if beam.absolute else None,
        table=table,
        warnings=_soft(beam),
    )


def _alone(*stated: Any, table: str) -> None:
    """Refuse a tube, or attenuation data, that are stated beside a calibrated one."""
    if table != "xraylib":
        raise InputError(
            "table", received=f"{table!r} with a twin", expected="none: the twin's intervals hold all tables"
        )
    if any(item is not None for item in stated):
        raise InputError("twin", received="also a stated tube", expected="a twin or a stated tube, not both")


def _spectrum_of_twin(
    twin: "Twin | TubeTwin | PathLike", *, kV: float | None, layers: tuple[Filter, ...]
) -> BeamSpectrum:
    from ..generator.predictions.tube_twin import predict_spectrum
    from ..spectra import fluence_per_cm2_mAs, half_value_layer_mm

    if kV is None:
        raise InputError("kV", received="nothing", expected="the tube voltage in kV")
    found = predict_spectrum(as_any_twin(twin), kV=kV, filters=layers)
    beam, kerma = found.spectrum, found.air_kerma_uGy_per_mAs
    quarter_mm = half_value_layer_mm(beam, material_from_name("aluminium"), fraction=0.25)
    return BeamSpectrum(
        spectrum=beam,
        mean_energy_keV=found.mean_energy_keV.value,
        hvl_mm_Al=found.hvl_mm_Al.value,
        hvl_mm_Cu=found.hvl_mm_Cu.value,
        second_hvl_mm_Al=quarter_mm - half_value_layer_mm(beam, material_from_name("aluminium")),
        air_kerma_uGy_per_mAs=None if kerma is None else kerma.value,
        photons_per_cm2_mAs=fluence_per_cm2_mAs(beam) if beam.absolute else None,
        table="xraylib",
        warnings=tuple(found.warnings),
        intervals=found.intervals(),
        twin=_name_of(twin),
        extrapolated=found.extrapolated,
    )


def _mu_of_twin(
    twin: "Twin | TubeTwin | PathLike",
    material: "Material",
    name: str,
    *,
    kV: float | None,
    layers: tuple[Filter, ...],
    thickness_mm: float | None,
    scintillator: tuple[Filter, ...],
    cover: tuple[Filter, ...],
    counting: bool,
) -> Attenuation:
    from ..generator.predictions.tube_twin import TubeTwin, predict_effective_mu
    from ..spectra import DEFAULT_SCINTILLATOR, detector_response, energy_grid_keV

    if kV is None:
        raise InputError("kV", received="nothing", expected="the tube voltage in kV")
    known = as_any_twin(twin)
    response = None
    if isinstance(known, TubeTwin) or scintillator or cover or counting:
        # the voltage may be wrong by some per cent, so the beam may reach beyond it
        response = detector_response(
            energies_keV=energy_grid_keV(1.1 * kV),
            scintillator=scintillator or DEFAULT_SCINTILLATOR,
            cover=cover,
            counting=counting,
        )
    asked: dict[str, Any] = {"material": name, "kV": kV, "filters": layers, "response": response}
    thin = predict_effective_mu(known, **asked)
    thick = None if thickness_mm is None else predict_effective_mu(known, thickness_mm=thickness_mm, **asked)
    return Attenuation(
        material=material,
        where=f"{kV:g} kV of {_name_of(twin)}",
        mu_eff_per_mm=thin.value,
        mu_eff_at_thickness_per_mm=None if thick is None else thick.value,
        thickness_mm=thickness_mm,
        energy_keV=None,
        mass_attenuation_cm2_g=None,
        table="xraylib",
        intervals={
            "mu_eff_per_mm": thin.as_dict(),
            "mu_eff_at_thickness_per_mm": None if thick is None else thick.as_dict(),
        },
        twin=_name_of(twin),
    )


def _name_of(twin: Any) -> str:
    return str(twin) if isinstance(twin, str | os.PathLike) else "a twin in memory"


def mu(
    material: str,
    *,
    kV: float | None = None,
    twin: "Twin | TubeTwin | PathLike | None" = None,
    energy_keV: float | None = None,
    filter: Layers = (),
    thickness_mm: float | None = None,
    scintillator: Layers = (),
    cover: Layers = (),
    counting: bool = False,
    anode: str | None = None,
    anode_angle_deg: float | None = None,
    model: str | None = None,
    spectrum_file: str | os.PathLike[str] | None = None,
    table: str = "xraylib",
    library: Sequence[str | os.PathLike[str]] = (),
) -> Attenuation:
    """Attenuation of a material, 1/mm: effective, in a beam and for a detector (Eq. 4), or at one photon energy.

    Two numbers: the limit of a thin object, sum(w mu) / sum(w), and what is measured through a thickness L,
    -ln(sum(w exp(-mu L)) / sum(w)) / L. w = E D(E) N(E), without E for a photon-counting detector.

    Args:
        material: library id or alias, element, FORMULA@DENSITY, NIST name.
        twin: a calibrated line or tube, in place of a stated one; the answer then has intervals.
        kV: of the beam; or `energy_keV`, one photon energy of 1 to 500 keV; or `spectrum_file`.
        filter: layers in the beam.
        thickness_mm: also the value measured through this thickness.
        scintillator, cover: sensitive layers and those before them; none: CsI 0.5 mm, no cover.
        counting: photon-counting instead of energy-integrating.
        anode, anode_angle_deg, model, spectrum_file, table, library: as for `spectrum`.

    Returns:
        The attenuation.

    Raises:
        InputError: a beam and an energy, or neither; an argument outside its range; an unknown material.

    Example:
        >>> thin = rt.mu("water", kV=60, filter="Al:2.5", thickness_mm=50)
        >>> thin.mu_eff_at_thickness_per_mm < thin.mu_eff_per_mm
        True
    """
    from ..materials import mass_attenuation_cm2_g, mu_per_mm
    from ..spectra import DEFAULT_SCINTILLATOR, detector_response, effective_mu_per_mm

    for word, given, unit in (
        ("kV", kV, "kV"),
        ("energy_keV", energy_keV, "keV"),
        ("thickness_mm", thickness_mm, "mm"),
    ):
        if given is not None:
            check_number(word, given, unit=unit)
    known = library_from_files(library)
    found = material_from_name(material, library=known)
    if twin is not None:
        _alone(anode, anode_angle_deg, model, spectrum_file, energy_keV, table=table)
        return _mu_of_twin(
            twin,
            found,
            material,
            kV=kV,
            layers=as_layers(filter, known),
            thickness_mm=thickness_mm,
            scintillator=as_layers(scintillator, known),
            cover=as_layers(cover, known),
            counting=counting,
        )
    has_beam = kV is not None or spectrum_file is not None
    if has_beam == (energy_keV is not None):
        raise InputError(
            "kV, energy_keV",
            received="both" if has_beam else "neither",
            expected="a beam (kV, or the file of a spectrum) or one energy",
        )
    if thickness_mm is not None and not 0 <= thickness_mm < float("inf"):
        raise InputError("thickness_mm", received=f"{thickness_mm} mm", expected="a finite thickness of 0 mm or more")
    if energy_keV is not None:
        value = float(mu_per_mm(found, energy_keV, table=table))
        return Attenuation(
            material=found,
            where=f"at {energy_keV:g} keV",
            mu_eff_per_mm=value,
            mu_eff_at_thickness_per_mm=None if thickness_mm is None else value,
            thickness_mm=thickness_mm,
            energy_keV=energy_keV,
            mass_attenuation_cm2_g=float(mass_attenuation_cm2_g(found, energy_keV, table=table)),
            table=table,
        )
    beam = _beam(
        kV=kV,
        filters=filter,
        anode=anode,
        anode_angle_deg=anode_angle_deg,
        model=model,
        spectrum_file=spectrum_file,
        table=table,
        library=known,
    )
    response: Response = detector_response(
        energies_keV=beam.energies_keV,
        scintillator=as_layers(scintillator, known) or DEFAULT_SCINTILLATOR,
        cover=as_layers(cover, known),
        counting=counting,
        table=table,
        library=known,
    )
    thick = None
    if thickness_mm is not None:
        thick = float(
            effective_mu_per_mm(found, spectrum=beam, response=response, thickness_mm=thickness_mm, table=table)
        )
    return Attenuation(
        material=found,
        where=f"in {describe_beam(beam)}",
        mu_eff_per_mm=float(effective_mu_per_mm(found, spectrum=beam, response=response, table=table)),
        mu_eff_at_thickness_per_mm=thick,
        thickness_mm=thickness_mm,
        energy_keV=None,
        mass_attenuation_cm2_g=None,
        table=table,
        warnings=_soft(beam),
    )


def contrast(
    *,
    product: str | Filter,
    foreign_object: str | Filter,
    low: Setting | str,
    high: Setting | str,
    twin: "Twin | TubeTwin | PathLike | None" = None,
    object_pixels: int = 100,
    displaces: bool = False,
    kV_low: Sequence[float] | None = None,
    kV_high: Sequence[float] | None = None,
    filters: Sequence[Layers] | None = None,
    progress: Progress | bool | None = None,
    **line: Any,
) -> "ObjectContrast | ContrastMap":
    """Contrast Delta R of a foreign object in a product, and how far it stands out of the noise, at a pair of settings or a map.

    Delta R is the shift of the quotient M_low / M_high that the object makes, for flat slabs, without scatter.

    Args:
        product, foreign_object: material and thickness, `"chicken_breast:20"`.
        low, high: the settings of the pair.
        twin: a calibrated line; None: SpekPy's tube behind 1 mm Al, silent electronics, unless `line` says otherwise.
        object_pixels: pixels that the object covers, as a disc.
        displaces: the object takes the product's place instead of adding to it.
        kV_low, kV_high, filters: two of them make a map. kV changes at the power (or current) of the pair; a filter stands in
            both beams.
        progress: True for a bar, or a function of (stage, done, total).
        **line: fields of `raytwin.generator.UncalibratedLine` (anode, inherent, scintillator, source_detector_mm, pixel_mm,
            psf_sigma_px, swank, read_noise_keV, ...), without a twin; layers as texts.

    Returns:
        An `ObjectContrast`, or a `ContrastMap`.

    Raises:
        InputError: an unknown material, a setting that the line cannot have, one axis or three, a twin and a stated line.

    Example:
        >>> pair = {"low": "kv=40,power_w=40,exposure_ms=20", "high": "kv=90,power_w=45,exposure_ms=20"}
        >>> found = rt.contrast(product="water:30", foreign_object="Al:0.5", **pair)
        >>> found.contrast.cnr_object > 0
        True
    """
    from ..generator.predictions.contrast import compute_contrast_map, predict_contrast
    from ..generator.predictions.predict_settings import as_filters, as_setting

    pair = (as_setting(low), as_setting(high))
    slabs = tuple(_one_layer(name, value) for name, value in (("product", product), ("object", foreign_object)))
    axes: dict[str, tuple[Any, ...]] = {
        name: tuple(values) for name, values in (("kV_low", kV_low), ("kV_high", kV_high)) if values is not None
    }
    if filters is not None:
        axes["filter"] = tuple(as_filters(() if item == "none" else item) for item in filters)
    if len(axes) not in (0, 2):
        raise InputError(
            "map", received=f"{len(axes)} axes", expected="exactly two of kV_low, kV_high and filters, or none"
        )
    for name, values in axes.items():
        if not 1 <= len(values) <= MOST_VALUES:
            raise InputError(f"map, {name}", received=f"{len(values)} values", expected=f"1 to {MOST_VALUES}")
    source = _line_of(twin, line)
    told = None if twin is None else _name_of(twin)
    words: dict[str, Any] = {"product": slabs[0], "foreign_object": slabs[1], "displaces": displaces}
    if not axes:
        found = predict_contrast(source, low=pair[0], high=pair[1], object_pixels=object_pixels, **words)
        return ObjectContrast(contrast=found, twin=told, **words)
    rows, columns = axes
    pairs = [[_at(_at(pair, rows, row), columns, column) for column in axes[columns]] for row in axes[rows]]
    with Telling(progress, unit="row") as telling:
        telling.begin("settings", len(pairs))

        def told_rows() -> Any:
            for number, row in enumerate(pairs):
                yield row
                telling.reach(number + 1)

        grid = compute_contrast_map(source, told_rows(), object_pixels=object_pixels, **words)
    return ContrastMap(
        row_axis=rows,
        column_axis=columns,
        row_values=axes[rows],
        column_values=axes[columns],
        grid=grid,
        twin=told,
        **words,
    )


def _one_layer(name: str, value: str | Filter) -> Filter:
    try:
        layer = filter_from_text(value) if isinstance(value, str) else value
        if not isinstance(layer, Filter):
            raise InputError(name, received=repr(value), expected="MATERIAL:mm")
        material_from_name(layer.material)
    except InputError as error:
        raise InputError(name, received=error.received, expected=error.expected, remedy=error.remedy) from None
    return layer


def _line_of(twin: "Twin | TubeTwin | PathLike | None", line: dict[str, Any]) -> "Twin | UncalibratedLine":
    """A calibrated line, a calibrated tube with a stated detector, or a line as stated."""
    from ..generator.predictions.tube_twin import TubeTwin

    if twin is None:
        return _stated_line(line)
    known = as_any_twin(twin)
    if isinstance(known, TubeTwin):
        stated = [name for name in ("anode", "anode_angle_deg", "inherent", "output_scale") if name in line]
        if stated:
            raise InputError(
                "twin", received=f"also {', '.join(stated)}", expected="a calibrated tube or a stated one, not both"
            )
        return _stated_line({**line, "tube": known})
    if line:
        raise InputError("twin", received=f"also {', '.join(line)}", expected="a twin or a stated line, not both")
    return known


def _stated_line(line: dict[str, Any]) -> "UncalibratedLine":
    from ..generator.predictions.contrast import UncalibratedLine
    from ..generator.predictions.predict_settings import as_filters

    names = [field.name for field in fields(UncalibratedLine)]
    unknown = [name for name in line if name not in names]
    if unknown:
        raise InputError(unknown[0], received="a word of the line", expected="one of " + ", ".join(names))
    layers = ("inherent", "scintillator", "cover")
    given: dict[str, Any] = {name: as_filters(item) if name in layers else item for name, item in line.items()}
    return UncalibratedLine(**given)


def _at(pair: tuple[Setting, Setting], axis: str, value: Any) -> tuple[Setting, Setting]:
    low, high = pair
    if axis == "filter":
        return replace(low, filters=value), replace(high, filters=value)
    if axis == "kV_low":
        return _at_kV(low, value), high
    return low, _at_kV(high, value)


def _at_kV(setting: Setting, kV: float) -> Setting:
    """The same power where it was given (a current beside it follows), else the same current."""
    return replace(setting, kV=kV, current_mA=None if setting.power_W is not None else setting.current_mA)
