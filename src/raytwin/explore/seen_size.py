"""The size that is found at a state, by model observers: a disc of the foreign object, and what networks would find.

The ideal observer of the residual image looks for a disc of the object's thickness, of any diameter, through the whole image at a
stated rate of false alarms: what signal and noise of the state allow. An observer that was calibrated to networks says what these
reach on the objects of its references, with an interval.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..acquisition.dataset_io import read_dataset
from ..generator.line.twin import Estimate, Twin
from ..observers import (
    Efficiency,
    ForeignObjects,
    LineImages,
    Observer,
    ProductTexture,
    Shape,
    materials_seen,
    objects_of_shape,
    observe_settings,
    predicted_sizes,
    read_efficiency,
    sight_of_references,
)
from .state import ExplorerState

DISC_PX = (0.6, 1.0, 1.6, 2.5, 4.0, 6.0, 9.0, 14.0, 20.0, 28.0)  # diameters that the observer is asked at
_UNIT_MM = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenSize:
    """What observers find at a state.

    Fields: a90_mm (diameter in the object's plane that the ideal observer finds in 90 % of cases; None: none of those asked for);
    largest_mm (asked for); pod (of the disc that is shown; None outside these); false_alarm_rate (of the ideal
    observer); networks (a90 of networks, of the calibrated observer's size; None without one); size_name (of it); reason (why
    nothing is said; empty: something is).
    """

    a90_mm: float | None
    largest_mm: float
    pod: float | None
    false_alarm_rate: float
    networks: Estimate | None = None
    size_name: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworksObserver:
    """An observer that was brought to networks, and what they look at. Fields: name; efficiency; objects; texture of the product,
    where the observer's image shows it."""

    name: str
    efficiency: Efficiency
    objects: ForeignObjects
    texture: ProductTexture | None = None


def read_networks_observer(
    path: str,
    references: str,
    twin: Twin,
) -> NetworksObserver:
    """A calibrated observer with the objects of a dataset, of the materials with which it was calibrated.

    Raises:
        InputError, FileFormatError: no such files, other kinds of files, references of other materials.
    """
    efficiency = read_efficiency(path)
    with read_dataset(references) as dataset:
        product, foreign = materials_seen(dataset, efficiency)
        sight = sight_of_references(
            LineImages(twin),
            dataset,
            product_material=product,
            foreign_material=foreign,
            size=efficiency.size_name,
            detector=efficiency.observer.detector,
            image=efficiency.observer.image,
        )
    return NetworksObserver(name=path, efficiency=efficiency, objects=sight.objects, texture=sight.texture)


class Eye:
    """Observers of one line; what does not change between states is prepared once.

    Args:
        twin: a line with a spectral part.
        networks: an observer that was brought to networks; None: the ideal one alone.
    """

    def __init__(self, twin: Twin, *, networks: NetworksObserver | None = None) -> None:
        self._line = LineImages(twin)
        self._networks = networks
        self._observer = Observer()
        pitch = self._line.object_pixel_mm
        rows, columns = twin.maps.shape
        self._sizes_mm = [size * pitch for size in DISC_PX]
        # the profile of a disc of one thickness scales with it: its spectrum is computed once
        self._discs = objects_of_shape(
            Shape(kind="plate", height_mm=_UNIT_MM),
            sizes_mm=self._sizes_mm,
            pixel_mm=pitch,
            product_mm=[_UNIT_MM],
            product_material="water",
            foreign_material="water",
            area_px=float(rows * columns),
        )

    def see(self, state: ExplorerState) -> SeenSize:
        """What is found at a state.

        Raises:
            InputError: materials or thicknesses that nothing gets through.
        """
        from scipy.special import ndtr

        pair = (state.setting("low"), state.setting("high"))
        count = len(self._discs)
        # the mean thickness of a disc that pixels cut, weighted by itself, is below the slab's
        thickness = self._discs.object_mm * state.foreign_object.thickness_mm
        discs = replace(
            self._discs,
            product_mm=np.full(count, state.product.thickness_mm),
            object_mm=thickness,
            product_material=state.product.material,
            foreign_material=state.foreign_object.material,
            displaces=state.displaces,
        )
        (against,) = self._line.reasons_against([pair], discs)
        size_name = "" if self._networks is None else self._networks.efficiency.size_name
        if against:
            return SeenSize(
                a90_mm=None,
                largest_mm=self._sizes_mm[-1],
                pod=None,
                false_alarm_rate=self._observer.false_alarm_rate,
                size_name=size_name,
                reason=against,
            )
        found = observe_settings(self._line, [pair], discs, observer=self._observer)
        a90 = float(found.a90[0])
        sizes = self._sizes_mm
        shown = 2.0 * math.sqrt(state.object_pixels / math.pi) * self._line.object_pixel_mm
        pod = None
        if sizes[0] <= shown <= sizes[-1]:
            # ln d' is smooth in ln size; thresholds hardly change
            d_prime = math.exp(float(np.interp(math.log(shown), np.log(sizes), np.log(found.d_prime[0]))))
            pod = float(ndtr(d_prime - float(np.interp(shown, sizes, found.threshold[0]))))
        networks = None
        if self._networks is not None:
            of = self._networks
            expected = predicted_sizes(self._line, [pair], of.objects, of.efficiency, texture=of.texture)
            ends = [float(one[0]) for one in (expected.a90, expected.low, expected.high)]
            networks = Estimate(value=ends[0], low=ends[1], high=ends[2]) if _all_finite(ends) else None
        return SeenSize(
            a90_mm=a90 if math.isfinite(a90) else None,
            largest_mm=sizes[-1],
            pod=pod,
            false_alarm_rate=self._observer.false_alarm_rate,
            networks=networks,
            size_name=size_name,
        )


def _all_finite(values: Sequence[float]) -> bool:
    return all(math.isfinite(value) for value in values)
