"""Model observers: a90 at any setting from the twin alone."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ..acquisition.setting import Filter, Setting, filter_from_text, setting_from_text
from ..errors import InputError
from ..files import given_path
from ..results import Result, Table, axes_or_new, frame, interval_text, number_text, plain
from ._given import PathLike, as_twin, dataset_of

if TYPE_CHECKING:
    import pandas

    from ..acquisition import Dataset
    from ..generator.line.twin import Twin
    from ..observers import Efficiency, ForeignObjects, LineImages, Observed, Observer, Sight
    from ..observers.efficiency import PredictedSizes

_UNITS = {"contrast": "", "size_mm": "mm"}
_SIZES = 24
_SMALLEST_PX, _LARGEST_PX = 0.5, 120.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Observation(Result):
    """What an observer finds at each pair of settings.

    Fields: rows (a mapping a pair: setting, a50, a90 with its interval where the observer is calibrated, a90_delta_R,
    independent_places); sizes (size,) and pod (pair, size) of the curve; size (`size_mm` or `contrast`); observer (detector, image,
    false_alarm_rate, efficiency, internal_noise); warnings.
    """

    rows: tuple[Mapping[str, Any], ...]
    sizes: tuple[float, ...]
    pod: tuple[tuple[float, ...], ...]
    size: str
    observer: Mapping[str, Any]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin observe --json` prints."""
        found: dict[str, Any] = plain(
            {
                "size": self.size,
                "unit": _UNITS[self.size],
                "observer": self.observer,
                "rows": self.rows,
                "curve": {"size": self.sizes, "pod": self.pod},
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a pair of settings."""
        return frame(self.rows)

    def plot(self, ax: Any = None) -> Any:
        """POD against size, a curve a pair of settings, up to twelve; returns the axes."""
        axes = axes_or_new(ax)
        for row, curve in list(zip(self.rows, self.pod, strict=True))[:12]:
            axes.plot(self.sizes, curve, label=str(row["setting"]), lw=1)
        axes.set(
            xlabel=f"{self.size.removesuffix('_mm')} ({_UNITS[self.size] or 'Delta R'})", ylabel="POD", ylim=(0, 1)
        )
        axes.axhline(0.9, color="0.7", lw=0.7)
        axes.legend(frameon=False, fontsize=7)
        return axes

    def _table(self) -> Table:
        rows = tuple(
            (str(row["setting"]), number_text(row["a50"]), *interval_text(row["a90"]), number_text(row["a90_delta_R"]))
            for row in self.rows
        )
        unit = _UNITS[self.size]
        words = self.observer
        title = (
            f"{words['detector']} observer of the {words['image']} image, {100 * words['false_alarm_rate']:g} % false alarms,"
            f" efficiency {words['efficiency']:.3g}; sizes {f'in {unit}' if unit else 'as Delta R'}"
        )
        header = ("setting", "a50", "a90", "95 % interval", "a90 in Delta R")
        return Table(title=title, header=header, rows=rows, notes=tuple(f"note: {line}" for line in self.warnings))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class CalibratedObserver(Result):
    """An observer brought to the networks of a sweep. Fields: efficiency (two numbers, their covariance, left-out settings)."""

    efficiency: "Efficiency"

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin observe --networks SWEEP --json` prints."""
        from ..observers.efficiency_io import efficiency_to_mapping

        found: dict[str, Any] = plain(
            {
                **efficiency_to_mapping(self.efficiency),
                "left_out_rms": self.efficiency.left_out_rms,
                "warnings": self.efficiency.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting: measured and, from the other settings, predicted a90."""
        return frame(self.to_dict()["left_out"])

    def save(self, path: PathLike) -> None:
        """Write it as JSON, to give to `observe` or to a campaign."""
        from ..observers import write_efficiency

        write_efficiency(path, self.efficiency)

    def _table(self) -> Table:
        one = self.efficiency
        rows = tuple(
            (
                number_text(row.measured),
                number_text(row.predicted),
                f"{row.low:.4g} to {row.high:.4g}",
                "yes" if row.inside else "no",
                f"{row.pair[0]};{row.pair[1]}",
            )
            for row in one.left_out
        )
        title = (
            f"{one.observer.detector} observer: efficiency {one.observer.efficiency:.3g}, internal noise"
            f" {one.observer.internal_noise:.3g}; settings left out are met to {100 * one.left_out_rms:.1f} % (rms)"
        )
        return Table(
            title=title,
            header=("a90 of networks", "predicted", "95 % interval", "agrees within both errors", "setting"),
            rows=rows,
            notes=tuple(f"note: {line}" for line in one.warnings),
        )


def observe(
    twin: "Twin | PathLike",
    settings: Sequence[tuple[Setting | str, Setting | str]] | tuple[Setting | str, Setting | str],
    *,
    product: str | Filter | None = None,
    foreign_object: str | None = None,
    shape: str = "ellipsoid",
    width: float = 1.0,
    height: float = 1.0,
    height_mm: float | None = None,
    sizes_mm: Sequence[float] | None = None,
    displaces: bool = False,
    references: "Dataset | PathLike | None" = None,
    product_material: str | None = None,
    foreign_material: str | None = None,
    size: str | None = None,
    detector: str | None = None,
    image: str | None = None,
    false_alarm_rate: float | None = None,
    calibrated: "CalibratedObserver | Efficiency | PathLike | None" = None,
) -> Observation:
    """POD and a90 of a foreign object at pairs of settings, without images or training.

    A linear observer reads them off the twin: the object's signal in the log images, the noise of quanta and electronics with its
    correlations, the belt's motion, and a threshold for a search of the whole image. Without `calibrated` it is the detector itself:
    an order of settings, and what signal and noise allow in its image. With it, a90 is what networks as in the calibration reach,
    with a 95 % interval. Scatter and effects in images are left out. A setting that the line cannot have, whose open field
    saturates, or that leaves too little light behind the product gets no number; `warnings` say why.

    Args:
        twin: a calibrated line with a spectral part.
        settings: one (low, high) pair, or several.
        product, foreign_object: a shape in a slab: `"chicken_breast:20"`, and the material of the object.
        shape, width, height, height_mm: `ellipsoid`, `rod` or `plate`, its length being the size; width and height (along the
            beam) of the length, or height_mm the same at every size.
        sizes_mm: lengths to look at; None: from half a pixel to 120 pixels or the field's shorter side.
        displaces: the shape takes the product's place.
        references: in place of a shape: a dataset of low-noise images, whose objects are looked for (they take the product's place).
        product_material, foreign_material: of the references; None: as their file states them, else as `calibrated` was
            calibrated, else chicken_breast, rib_bone.
        size: of the references, `contrast` or `size_mm`; None: that of the calibrated observer, else `contrast`.
        detector: `ideal` (default), `hotelling`, `npw` or `npwe`; image: `residual` (default of a shape), `quotient`, `low`,
            `high` or `both` (default of references, where detector and texture of the product allow it).
        false_alarm_rate: share of images without object that show an alarm; default 0.01.
        calibrated: of `calibrate_observer`, or its file; it brings detector, image and false alarms along.

    Raises:
        InputError: no settings, unknown materials or others than those of the references or of `calibrated`, neither product nor
            references, or both.

    Source: ICRU Report 54 (1996); Barrett & Myers, Foundations of Image Science (2004), ch. 13.

    Example:
        >>> pair = ("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05", "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
        >>> found = rt.observe("virtual_lab", pair, product="chicken_breast:20", foreign_object="rib_bone", shape="rod", width=0.2,
        ...                    height=0.2)
        >>> 1 < found.rows[0]["a90"]["value"] < 30
        True
    """
    import numpy as np

    from ..generator.predictions.contrast import check_pair
    from ..observers import LineImages, Sight, observe_settings, predicted_sizes

    pairs = _pairs(settings)
    line = LineImages(as_twin(twin))
    efficiency = _efficiency_of(calibrated)
    observer = _observer_of(efficiency, detector=detector, image=image, false_alarm_rate=false_alarm_rate)
    if (references is None) == (product is None and foreign_object is None):
        raise InputError(
            "product and references",
            received="neither" if references is None else "both",
            expected="a product and a foreign object, or a dataset of references",
        )
    if references is None:
        if product is None or foreign_object is None:
            raise InputError("product and foreign_object", received="one of the two", expected="both")
        objects = _objects_of_shape(
            line,
            product=product,
            foreign_object=foreign_object,
            words={"kind": shape, "width": width, "height": height, "height_mm": height_mm},
            sizes_mm=sizes_mm,
            displaces=displaces,
        )
        sight = Sight(objects=objects, image=observer.image, texture=None)
    else:
        sight = _sight_of_file(
            line,
            references,
            efficiency,
            product_material=product_material,
            foreign_material=foreign_material,
            size=size or (efficiency.size_name if efficiency is not None else "contrast"),
            detector=observer.detector,
            image=observer.image if efficiency is not None else image,
        )
        objects, observer = sight.objects, replace(observer, image=sight.image)
    if observer.image in ("residual", "quotient"):
        for pair in pairs:
            check_pair(*pair)
    texture = sight.texture
    found = observe_settings(line, pairs, objects, observer=observer, texture=texture)
    expected = None if efficiency is None else predicted_sizes(line, pairs, objects, efficiency, texture=texture)
    against = line.reasons_against(pairs, objects, image=observer.image)
    warnings = [*line.warnings, *sight.warnings, *(reason for reason in against if reason), *_outside(line, pairs)]
    if efficiency is None:
        warnings.append(
            "not calibrated to networks: no interval; `calibrate_observer` brings it to the networks of a sweep"
        )
    else:
        warnings += efficiency.warnings
    largest = float(objects.size.max())
    rows = []
    for number, pair in enumerate(pairs):
        unseen = bool(against[number])
        rows.append(_row_of_pair(pair, found, expected, number, unseen=unseen))
        if rows[-1]["a90"] is None and not unseen:
            beyond = float(found.a90_of_curve[number])
            where = f"; the curve would reach it at {beyond:.3g}" if math.isfinite(beyond) else ""
            warnings.append(f"{pair[0]};{pair[1]}: POD does not pass 90 % within the sizes, up to {largest:.3g}{where}")
    pod = np.where(np.array([bool(reason) for reason in against])[:, None], np.nan, found.pod)
    sizes, curves = _curves(pod, objects)
    words = {
        name: getattr(observer, name)
        for name in ("detector", "image", "false_alarm_rate", "efficiency", "internal_noise")
    }
    return Observation(
        rows=tuple(plain(rows)),
        sizes=sizes,
        pod=curves,
        size=objects.size_name,
        observer=words,
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _observer_of(efficiency: "Efficiency | None", **given: Any) -> "Observer":
    """The observer as it was calibrated, or as words that are not None ask for."""
    from ..observers import Observer

    changes = {name: value for name, value in given.items() if value is not None}
    if efficiency is None:
        return Observer(**changes)
    if changes:
        raise InputError(
            ", ".join(changes),
            received="given with a calibrated observer",
            expected="those that it was calibrated with",
            remedy="leave them out",
        )
    return efficiency.observer


def _row_of_pair(
    pair: tuple[Setting, Setting], found: "Observed", expected: "PredictedSizes | None", number: int, *, unseen: bool
) -> dict[str, Any]:
    """What was found at a pair of settings; unseen: there is a reason against it, and no number."""
    a90 = math.nan if unseen else float(found.a90[number])
    known = math.isfinite(a90)
    low, high = (None, None) if expected is None else (float(expected.low[number]), float(expected.high[number]))
    return {
        "setting": f"{pair[0]};{pair[1]}",
        "a50": math.nan if unseen else float(found.a50[number]),
        "a90": {"value": a90, "low": low, "high": high} if known else None,
        "a90_delta_R": float(found.a90_delta_R[number]) if known else math.nan,
        "independent_places": float(found.independent_places[number]),
    }


def calibrate_observer(
    twin: "Twin | PathLike",
    sweep: PathLike,
    *,
    product_material: str | None = None,
    foreign_material: str | None = None,
    detector: str = "ideal",
    image: str | None = None,
    false_alarm_rate: float | None = None,
) -> CalibratedObserver:
    """An observer brought to the networks of a sweep: efficiency and internal noise, and how far left-out settings depart.

    Args:
        twin: the line that the sweep was of.
        sweep: folder of a finished `sweep` with reference images and four settings or more that have an a90 with its interval.
        product_material, foreign_material: of the references; None: as the sweep's campaign says.
        detector, image: as of `observe`.
        false_alarm_rate: None: the mean over the sweep's settings.

    Raises:
        InputError: no such sweep, one of described products, or fewer than four settings with an a90 and its interval.

    Example:
        >>> observer = rt.calibrate_observer("twin.h5", "sweep")  # doctest: +SKIP
        >>> rt.observe("twin.h5", pair, references="references.h5", calibrated=observer)  # doctest: +SKIP
    """
    import json

    from ..observers import LineImages, MeasuredSize, Observer, fit_efficiency

    folder = given_path(sweep, expected="the folder of a sweep", argument="sweep")
    try:
        answer = json.loads((folder / "sweep.json").read_text(encoding="utf-8"))
        rows = [row for row in answer["rows"] if row["a90"] is not None]
        size = answer["size"]
        own_product, own_foreign = answer["materials"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            "sweep",
            received=f"{sweep}, without a readable sweep.json",
            expected="the folder of a finished `raytwin sweep`",
        ) from None
    tests = folder / "references" / "test.h5"
    if not tests.exists():
        raise InputError("sweep", received=f"{sweep}, of described products", expected="a sweep with reference images")
    if false_alarm_rate is None:
        rates = [row["false_alarm_rate"]["value"] for row in rows if row["false_alarm_rate"]]
        if not rates or not 0 < sum(rates) / len(rates) < 1:
            raise InputError(
                "false_alarm_rate",
                received="a sweep whose networks alarmed at no image without object, or at all",
                expected="a rate above 0 and below 1",
                remedy="give false_alarm_rate (--false-alarms), such as 0.01",
            )
        false_alarm_rate = sum(rates) / len(rates)
    line = LineImages(as_twin(twin))
    sight = _sight_of_file(
        line,
        tests,
        None,
        product_material=product_material or own_product,
        foreign_material=foreign_material or own_foreign,
        size=size,
        detector=detector,
        image=image,
    )
    measured = [
        MeasuredSize(
            pair=(setting_from_text(row["low"]), setting_from_text(row["high"])),
            a90=row["a90"],
            low=row["a90_low"],
            high=row["a90_high"],
        )
        for row in rows
    ]
    observer = Observer(detector=detector, image=sight.image, false_alarm_rate=false_alarm_rate)
    return CalibratedObserver(
        efficiency=fit_efficiency(line, measured, sight.objects, observer=observer, texture=sight.texture)
    )


def _sight_of_file(
    line: "LineImages",
    references: "Dataset | PathLike",
    efficiency: "Efficiency | None",
    *,
    product_material: str | None,
    foreign_material: str | None,
    size: str,
    detector: str,
    image: str | None,
) -> "Sight":
    """What an observer, calibrated or not, looks at in a dataset of references.

    Raises:
        InputError: references that do not say their setting, without objects of known contrast, or of other materials.
    """
    from ..observers import materials_seen, sight_of_references

    if size not in _UNITS:
        raise InputError("size", received=size, expected="contrast or size_mm")
    with dataset_of(references) as dataset:
        product, foreign = materials_seen(
            dataset, efficiency, product_material=product_material, foreign_material=foreign_material
        )
        return sight_of_references(
            line,
            dataset,
            product_material=product,
            foreign_material=foreign,
            size=size,
            detector=detector,
            image=image,
        )


def _outside(line: "LineImages", pairs: "Sequence[tuple[Setting, Setting]]") -> list[str]:
    """Settings beyond what calibrated the twin, in words."""
    from ..generator.predictions.predict import spectrum_outside

    if line.twin.spectral is None:
        return []
    found = []
    for setting in dict.fromkeys(one for pair in pairs for one in pair):
        outside = spectrum_outside(line.twin.spectral, kV=setting.kV, filters=setting.filters)
        if outside:
            found.append(
                f"{setting}: outside the calibrated range of {', '.join(outside)}; a90 rests on the spectral model"
            )
    return found


def _pairs(settings: Any) -> list[tuple[Setting, Setting]]:
    from ..generator.predictions.predict_settings import as_setting

    given = list(settings) if isinstance(settings, Iterable) else []
    if len(given) == 2 and all(isinstance(one, str | Setting) for one in given):
        given = [tuple(given)]
    if not given or not all(isinstance(one, tuple | list) and len(one) == 2 for one in given):
        raise InputError("settings", received=repr(settings), expected="a (low, high) pair of settings, or several")
    return [(as_setting(low), as_setting(high)) for low, high in given]


def _efficiency_of(calibrated: Any) -> "Efficiency | None":
    from ..observers import Efficiency, read_efficiency

    if calibrated is None or isinstance(calibrated, Efficiency):
        return calibrated
    if isinstance(calibrated, CalibratedObserver):
        return calibrated.efficiency
    if isinstance(calibrated, str | os.PathLike):
        return read_efficiency(calibrated)
    raise InputError("calibrated", received=type(calibrated).__name__, expected="a calibrated observer or its file")


def _objects_of_shape(
    line: "LineImages",
    *,
    product: str | Filter,
    foreign_object: str,
    words: Mapping[str, Any],
    sizes_mm: Sequence[float] | None,
    displaces: bool,
) -> "ForeignObjects":
    import numpy as np

    from ..materials import material_from_name
    from ..observers import Shape, objects_of_shape

    slab = filter_from_text(product) if isinstance(product, str) else product
    for name in (slab.material, foreign_object):
        material_from_name(name)
    shape = Shape(**words)
    pitch = line.object_pixel_mm
    if sizes_mm is None:
        largest = min(_LARGEST_PX, *line.twin.maps.shape) * pitch  # no object is larger than the field
        if displaces and shape.height_mm is None:
            largest = min(largest, slab.thickness_mm / shape.height)
        sizes_mm = np.geomspace(_SMALLEST_PX * pitch, largest, _SIZES).tolist()
    rows, columns = line.twin.maps.shape
    return objects_of_shape(
        shape,
        sizes_mm=sizes_mm,
        pixel_mm=pitch,
        product_mm=[slab.thickness_mm],
        product_material=slab.material,
        foreign_material=foreign_object,
        area_px=float(rows * columns),
        displaces=displaces,
    )


def _curves(pod: Any, objects: "ForeignObjects") -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
    """Sizes, and the mean POD at each (pair, size)."""
    import numpy as np

    sizes, where = np.unique(objects.size, return_inverse=True)
    count = np.bincount(where)
    return tuple(sizes.tolist()), tuple(tuple((np.bincount(where, row) / count).tolist()) for row in pod)
