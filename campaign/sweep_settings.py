"""What is known of a setting before anything is trained: can the line do it, what it costs, how well the object stands out.

Time and dose of a product with N frames of t averaged in each image, readout r, and air kerma K of one frame at the product:

    pair = sum or maximum over the two images of N (t + r)        throughput = v / pitch on a belt, else 1 / (pair + pause)
    dose = sum over the two images of N K                         motion = v M t / pixel

(t + r is the longer of the two where readout overlaps the exposure.) The belt's motion goes into the images as the effect
`motion_blur`; frames that a belt would move apart are not averaged.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.dataset_io import Dataset, read_dataset
from ..acquisition.instrument import Instrument
from ..acquisition.setting import Setting, text_from_filters
from ..errors import InputError
from ..generator.datasets.belt_motion import motion_strength_px, twin_on_belt
from ..generator.effects.motion_blur import STATED_MS
from ..generator.line.line_limits import frames_per_s
from ..generator.line.twin import Twin
from ..generator.predictions.predict import Prediction, predict_flatfield, saturation_text
from .sweep_file import Campaign, Limits, Pair, Requirement, Timing, text_of_pair

if TYPE_CHECKING:
    from ..generator.datasets.render import Geometry
    from ..generator.predictions.contrast import SlabContrasts
    from ..generator.scenes.describe import Description

_STRICTER = ("maximum_kV", "maximum_current_mA", "maximum_power_w")


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlook:
    """A setting before training.

    Fields: pair; reason (why it cannot be, empty where it can); kept (whether it is trained) with why_left_out where not;
    dose_uGy, photons (low, high; a pixel and frame of the open beam), each {value, low, high}; pair_ms; throughput_per_s;
    belt_speed_mm_s; motion_px (longest path in one exposure); extrapolated; delta_R, cnr_object; warnings. None: unknown.
    """

    pair: Pair
    reason: str = ""
    kept: bool = True
    why_left_out: str = ""
    dose_uGy: Mapping[str, float] | None = None
    photons: tuple[Mapping[str, float] | None, Mapping[str, float] | None] = (None, None)
    pair_ms: float | None = None
    throughput_per_s: float | None = None
    belt_speed_mm_s: float | None = None
    motion_px: float | None = None
    extrapolated: bool | None = None
    delta_R: float | None = None
    cnr_object: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """LOW;HIGH."""
        return text_of_pair(self.pair)

    @property
    def feasible(self) -> bool:
        """Whether line and limits allow it."""
        return not self.reason


class _Refused(Exception):  # noqa: N818  (a finding, no failure)
    """A setting that a limit of the campaign rules out."""


class Scout:
    """Looks at the settings of a campaign; close it after use.

    Args:
        campaign: whose limits and references count.
        twin: the line, as the file has it.
    """

    def __init__(self, campaign: Campaign, twin: Twin) -> None:
        self.campaign = campaign
        self.twin = replace(twin, instrument=limited_instrument(twin.instrument, campaign.limits))
        self._datasets: list[Dataset] = []
        self._descriptions: list[Description] = []
        self._contrasts: SlabContrasts | None = None
        # settings of one tube voltage stand in many pairs: what each says by itself is kept
        self._predictions: dict[Setting, Prediction] = {}
        self._channels: dict[tuple[int, Setting, float | None, Geometry], tuple[str, ...]] = {}
        for word, path in (("references", campaign.references), ("test_references", campaign.test_references)):
            if path is None:
                continue
            if campaign.described:
                from ..generator.scenes.describe import read_description

                self._descriptions.append(read_description(path))
            else:
                self._datasets.append(open_references(path, word))

    def close(self) -> None:
        """Close the reference files."""
        for dataset in self._datasets:
            dataset.close()

    def look(self, pair: Pair) -> Outlook:
        """What is known of one pair of settings; one that cannot be comes back with the reason."""
        limits = self.campaign.limits
        known: dict[str, Any] = {"belt_speed_mm_s": pair[0].belt_speed_mm_s}
        warnings: list[str] = []
        try:
            predictions = tuple(map(self._predicted, pair))
            for found in predictions:
                warnings += found.warnings
            known |= _costs(self.twin, pair, predictions, self.campaign.timing)
            warnings += known.pop("warnings")
            known["motion_px"] = _motion_px(self.twin.instrument, pair)
            _check(self.twin, pair, predictions, known, limits, self.campaign.timing)
            warnings += self._try_images(pair)
            known |= self._contrast(pair, warnings)
        except InputError as error:
            return Outlook(pair=pair, reason=str(error), kept=False, warnings=_once(warnings), **known)
        except _Refused as error:
            return Outlook(pair=pair, reason=str(error), kept=False, warnings=_once(warnings), **known)
        missed = _missed(self.campaign.requirement, known)
        return Outlook(pair=pair, kept=not missed, why_left_out=missed, warnings=_once(warnings), **known)

    def _predicted(self, setting: Setting) -> Prediction:
        if setting not in self._predictions:
            self._predictions[setting] = predict_flatfield(self.twin, setting)
        return self._predictions[setting]

    def _try_images(self, pair: Pair) -> tuple[str, ...]:
        """Whether images can be made at all; the noise of one reference of each kind is weighed."""
        from ..generator.datasets.generate import ReferenceImages
        from ..generator.datasets.generate_described import channel_warnings, described_geometry

        twin, told = twin_on_belt(self.twin, pair)
        found: list[str] = list(told)
        for number, description in enumerate(self._descriptions):
            geometry = described_geometry(twin, description, low=pair[0], high=pair[1])
            for setting in pair:
                key = (number, setting, pair[0].belt_speed_mm_s, geometry)
                if key not in self._channels:
                    self._channels[key] = channel_warnings(twin, description, setting, geometry)
                found += self._channels[key]
        for dataset in self._datasets:
            _check_distance(self.twin.instrument, pair, dataset, self.campaign.reference_setting)
            images = ReferenceImages(
                twin,
                dataset,
                low=pair[0],
                high=pair[1],
                product_material=self.campaign.product_material,
                foreign_material=self.campaign.foreign_material,
                reference_setting=self.campaign.reference_setting,
            )
            found += images.warnings
            first = {dataset.rows[number].setting: place for place, number in reversed(list(enumerate(images.numbers)))}
            for place in first.values():
                found += images.counts(place, np.random.default_rng(0))[1]
        return tuple(found)

    def _contrast(self, pair: Pair, warnings: list[str]) -> dict[str, float | None]:
        from ..generator.predictions.contrast import SlabContrasts

        slabs = self.campaign.slabs
        if slabs is None:
            return {}
        if self.twin.spectral is None:
            warnings.append("no contrast-to-noise: the twin has no spectral part")
            return {}
        if self._contrasts is None:
            self._contrasts = SlabContrasts(
                replace(self.twin, effects=()),
                product=slabs.product,
                foreign_object=slabs.foreign_object,
                object_pixels=slabs.object_pixels,
                displaces=slabs.displaces,
            )
        found = self._contrasts.contrast(*pair, intervals=False)
        warnings += [line for line in found.warnings if line not in warnings]
        return {"delta_R": None if found.delta_R is None else found.delta_R.value, "cnr_object": found.cnr_object}


def open_references(path: Path, word: str) -> Dataset:
    """The dataset that a word of the campaign file names.

    Raises:
        InputError: a file of another kind.
    """
    try:
        return read_dataset(path)
    except InputError as error:
        another = "raytwin import" in error.remedy  # a file of another kind; else one that is cut off or damaged
        raise InputError(
            f"{word}, {error.argument}",
            received=error.received,
            expected="a dataset file with reference images (or a description, .toml)" if another else error.expected,
            remedy="`raytwin import reference` makes one of an acquisition or of folders" if another else error.remedy,
        ) from None


def limited_instrument(instrument: Instrument, limits: Limits) -> Instrument:
    """The instrument with the campaign's limits on the tube where they are stricter, and its readout where it is longer."""
    changes: dict[str, Any] = {}
    for field in _STRICTER:
        wanted, own = getattr(limits, field), getattr(instrument, field)
        if wanted is not None:
            changes[field] = wanted if own is None else min(wanted, own)
    if limits.readout_ms is not None:
        changes["readout_ms"] = max(limits.readout_ms, instrument.readout_ms or 0.0)
    return replace(instrument, **changes) if changes else instrument


def _motion_px(instrument: Instrument, pair: Pair) -> float | None:
    """Longest path (px) of the object's image in one exposure; None where no belt moves."""
    strengths = [motion_strength_px(instrument, one) for one in pair]
    paths = [
        strength * one.exposure_ms / STATED_MS
        for strength, one in zip(strengths, pair, strict=True)
        if strength is not None
    ]
    return max(paths) if paths else None


def _costs(twin: Twin, pair: Pair, predictions: Sequence[Prediction], timing: Timing) -> dict[str, Any]:
    """Dose, photons, time and throughput of a pair."""
    instrument = twin.instrument
    warnings: list[str] = []
    kerma = [found.air_kerma_uGy for found in predictions]
    dose = None
    if all(one is not None for one in kerma):
        parts = [one.times(setting.averaged) for one, setting in zip(kerma, pair, strict=True) if one is not None]
        # flux is uncertain in both images alike, so the ends add up as the values do
        dose = {end: sum(getattr(part, end) for part in parts) for end in ("value", "low", "high")}
    photons = tuple(
        None if found.photons_absorbed is None else found.photons_absorbed.as_dict() for found in predictions
    )
    speed = pair[0].belt_speed_mm_s
    area = instrument.detector in (None, "area")
    pair_ms = throughput = None
    if area:
        each = [1000.0 / frames_per_s(instrument, one) for one in pair]
        pair_ms = sum(each) if timing.pair == "in_turn" else max(each)
        if instrument.readout_ms is None:
            warnings.append("readout unknown: taken as none (readout_ms under [limits] states it)")
    if speed is not None:
        throughput = None if timing.product_pitch_mm is None else speed / timing.product_pitch_mm
    elif pair_ms is not None:
        throughput = 1000.0 / (pair_ms + timing.pause_ms)
    else:
        warnings.append(
            "throughput unknown: a line detector's images take as long as the belt does; state belt_speed_mm_s"
        )
    return {
        "dose_uGy": dose,
        "photons": photons,
        "pair_ms": pair_ms,
        "throughput_per_s": throughput,
        "extrapolated": any(found.extrapolated for found in predictions),
        "warnings": warnings,
    }


def _check(
    twin: Twin,
    pair: Pair,
    predictions: Sequence[Prediction],
    known: Mapping[str, Any],
    limits: Limits,
    timing: Timing,
) -> None:
    """Raise where the campaign's limits or the detector's range rule a setting out."""
    for setting, found in zip(pair, predictions, strict=True):
        saturated = saturation_text(twin, setting, found.mean_DN.value)
        if saturated:
            raise _Refused(f"open field at {setting.kV:g} kV: {saturated}")
    if known["extrapolated"] and not limits.extrapolation:
        raise _Refused("outside the calibrated range, and extrapolation = false")
    speed, motion = known["belt_speed_mm_s"], known["motion_px"]
    pitch, pair_ms = timing.product_pitch_mm, known["pair_ms"]
    if speed is not None and pitch is not None and pair_ms is not None and pair_ms > 1000.0 * pitch / speed:
        raise _Refused(
            f"a pair takes {pair_ms:.4g} ms, and products come every {1000.0 * pitch / speed:.4g} ms at {speed:g} mm/s"
        )
    dose = known["dose_uGy"]
    if limits.maximum_dose_uGy is not None and dose is None:
        raise _Refused("the dose is unknown (the twin has no spectral part), and maximum_dose_uGy asks for it")
    for name, value, limit, unit in (
        ("belt speed", speed, limits.maximum_belt_speed_mm_s, "mm/s"),
        ("motion in one exposure", motion, limits.maximum_motion_px, "px"),
        ("dose", None if dose is None else dose["value"], limits.maximum_dose_uGy, "uGy"),
    ):
        if value is not None and limit is not None and value > limit * (1 + 1e-9):
            raise _Refused(f"{name} {value:.4g} {unit}, allowed are {limit:g} {unit}")
    least, throughput = limits.minimum_throughput_per_s, known["throughput_per_s"]
    if least is not None and (throughput is None or throughput < least * (1 - 1e-9)):
        text = "unknown" if throughput is None else f"{throughput:.4g} products/s"
        raise _Refused(f"throughput {text}, asked for are {least:g} products/s")


def _missed(requirement: Requirement | None, known: Mapping[str, Any]) -> str:
    """Why a setting cannot meet the requirement whatever its networks find; empty where it may."""
    if requirement is None:
        return ""
    pace, asked = known["throughput_per_s"], requirement.throughput_per_s
    if asked is not None and pace is not None and pace < asked * (1 - 1e-9):
        return f"not trained: throughput {pace:.4g} products/s, required are {asked:.4g}"
    dose, most = known["dose_uGy"], requirement.dose_uGy
    if most is not None and dose is not None and dose["low"] > most * (1 + 1e-9):
        return f"not trained: dose {dose['low']:.4g} uGy or more, required is {most:g} uGy at most"
    return ""


def _check_distance(instrument: Instrument, pair: Pair, dataset: Dataset, fallback: Pair | None) -> None:
    """Refuse a distance that references which state none (the instrument's, then) were not taken at."""
    from ..generator.datasets.generate import reference_settings

    own = instrument.source_detector_mm
    rows = {row.setting: row for row in dataset.rows}
    for row in rows.values():
        for reference, target in zip(reference_settings(row, fallback), pair, strict=True):
            stated = target.source_detector_mm
            if reference.source_detector_mm is None and stated is not None and own is not None and stated != own:
                raise InputError(
                    "target setting",
                    received=f"source-detector distance {stated:g} mm",
                    expected=f"the references' {own:g} mm",
                    remedy="another distance is another magnification; measure references there",
                )


def keep_best(outlooks: Sequence[Outlook], *, keep: int, of: str) -> tuple[Outlook, ...]:
    """The outlooks, those feasible ones left out that have less contrast-to-noise than the best `keep`.

    Longer exposures always show more, so settings are compared with others of the same throughput (`of` throughput; belt
    speed where products a second are unknown), or all with all (`of` all). Which they lost to stands in `why_left_out`.
    """
    groups: dict[str, list[int]] = {}
    for number, one in enumerate(outlooks):
        if one.kept and one.cnr_object is not None:
            groups.setdefault(_pace(one) if of == "throughput" else "any throughput", []).append(number)
    result = list(outlooks)
    for name, members in groups.items():
        ranked = sorted(members, key=lambda number: (-(outlooks[number].cnr_object or 0.0), outlooks[number].text))
        for place, number in enumerate(ranked[keep:], start=keep + 1):
            told = (
                f"not trained: contrast-to-noise {outlooks[number].cnr_object:.3g} is number {place} of {len(ranked)} at"
                f" {name}; keep_best trains the best {keep}"
            )
            result[number] = replace(outlooks[number], kept=False, why_left_out=told)
    return tuple(result)


def _pace(one: Outlook) -> str:
    if one.throughput_per_s is not None:
        return f"{one.throughput_per_s:.4g} products/s"
    return "unknown throughput" if one.belt_speed_mm_s is None else f"{one.belt_speed_mm_s:.4g} mm/s"


def labels_of(pairs: Sequence[Pair]) -> list[str]:
    """A short name for each pair: what differs between them, in words with units."""
    words = [[_words_of(one) for one in pair] for pair in pairs]
    names = list(dict.fromkeys(name for pair in words for side in pair for name in side))
    varied = [name for name in names if len({(pair[0].get(name), pair[1].get(name)) for pair in words}) > 1]
    shown = varied or [name for name in names if name in ("kV", "filters", "exposure_ms")]
    labels = []
    for pair in words:
        parts = []
        for name in shown:
            low, high = pair[0].get(name, ""), pair[1].get(name, "")
            if not (low or high):
                parts += ["no belt"] if name == "belt_speed_mm_s" else []
                continue
            parts.append((low if low == high else f"{low or '-'}/{high or '-'}") + _UNITS[name])
        labels.append(", ".join(parts))
    return labels


_UNITS = {
    "kV": " kV",
    "filters": "",
    "power_W": " W",
    "current_mA": " mA",
    "exposure_ms": " ms",
    "averaged": " frames",
    "belt_speed_mm_s": " mm/s",
    "source_detector_mm": " mm to the source",
    "frame_interval_ms": " ms a frame",
    "binning": " x binned",
}


def _words_of(setting: Setting) -> dict[str, str]:
    found = {}
    for name in _UNITS:
        value = getattr(setting, name)
        if name == "filters":
            found[name] = text_from_filters(value) or "no filter"
        else:
            found[name] = "" if value is None else f"{value:g}"
    return found


def start_pair(references: Pair, share: float) -> Pair:
    """The references' own settings with a share of their exposure: fewer frames, and less current where that is not enough."""
    targets = []
    for one in references:
        frames = one.averaged * share
        averaged = max(1, math.ceil(frames - 1e-9))
        factor = frames / averaged
        targets.append(
            replace(
                one,
                averaged=averaged,
                power_W=None if one.power_W is None else one.power_W * factor,
                current_mA=None if one.current_mA is None else one.current_mA * factor,
                belt_speed_mm_s=None,
                frame_interval_ms=None,
            )
        )
    return targets[0], targets[1]


def _once(lines: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(lines))
