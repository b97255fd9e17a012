"""A tube calibrated with a dosimeter: alone, or as one more witness of a line that has flats."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import text_from_filters
from ...errors import FitError, InputError
from ...generator.line.spectral_signal import OpenBeam, absorber_of_parameter
from ...generator.line.twin import SpectralPosterior
from ...generator.line.twin_spectrum import model_of_posterior
from ...generator.predictions.tube_twin import NO_DETECTOR, NO_OUTPUT, TubeTwin
from ..frames.robust import robust_sd
from .dose_data import DOSE_FILTRATION, DOSIMETER_CALIBRATION, DOSIMETER_HARDNESS, KermaRatio, KermaReading
from .output_table import OutputTable
from .spectral_fit import SpectralFit, contradicts, fit_evidence, fit_spectrum, unlike_output
from .transmission_table import TransmissionTable

# A setting is left out where its departure from all the others happens to one table in a thousand. Its standard deviation is
# its own and the others' scatter, by their median absolute deviation, which is worth 0.37 of a Gaussian sample's degrees of
# freedom (Huber, Robust Statistics, 1981, 5.1); together they have those of Welch and Satterthwaite. Few settings have hardly
# any scatter to judge one of them by, and none of them is left out.
_STRAYS = 0.001
_EFFICIENCY = 0.37
_LEAST_TO_JUDGE = 4
_MOST_STRAYS = 5  # one in so many: beyond, the table is not mostly right
_RARE = 0.05
_FILTRATION = "inherent_filtration_mm_Al"
_OF_TUBE = (_FILTRATION, "kV_error", "log_output", "log_mu_")


@dataclass(frozen=True, slots=True, kw_only=True)
class DoseData:
    """What tables say, as data of the spectral fit; notes: what their owner should know."""

    kermas: tuple[KermaReading, ...]
    ratios: tuple[KermaRatio, ...]
    notes: tuple[str, ...] = ()

    @property
    def any(self) -> bool:
        """Whether there is anything."""
        return bool(self.kermas or self.ratios)


def dose_data(output: OutputTable | None, transmission: TransmissionTable | None) -> DoseData:
    """Kermas and ratios of the tables that there are."""
    return DoseData(
        kermas=() if output is None else output.kermas,
        ratios=(
            *(() if output is None else output.half_values),
            *(() if transmission is None else transmission.ratios),
        ),
        notes=tuple(note for table in (output, transmission) if table is not None for note in table.notes),
    )


def calibrate_tube(
    *,
    rng: np.random.Generator,
    output: OutputTable | None = None,
    transmission: TransmissionTable | None = None,
    instrument: Instrument | None = None,
    progress: Callable[[str], None] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> TubeTwin:
    """The twin of a tube alone, from a dose table, a transmission table or both.

    Args:
        rng: source of randomness of the posterior's draws.
        output: air kermas and half-value layers.
        transmission: of known or unknown absorbers.
        instrument: anode, angle and declared inherent layers; None: W, 12 degrees, none.
        progress: called with the name of each stage.
        provenance: kept in the twin.

    Raises:
        InputError: no table.
        FitError: the tables contradict each other or the tube so far that no posterior can be drawn.
    """
    data = dose_data(output, transmission)
    if not data.any:
        raise InputError(
            "tables",
            received="none",
            expected="a dose table or a transmission table",
            remedy="give --output-table FILE",
        )
    owner = instrument or Instrument()
    if progress is not None:
        progress("spectrum")

    def fit(chosen: DoseData) -> SpectralFit:
        return fit_spectrum([], owner, rng=rng, kermas=chosen.kermas, ratios=chosen.ratios)

    found, kept, warnings = fit_without_strays(data, fit)
    posterior = found.posterior
    evidence = {"spectrum": fit_evidence(found)} | table_evidence(
        posterior, kept, output=output, transmission=transmission
    )
    warnings += unlike_output(found)
    if contradicts(found):
        warnings.append(
            f"the tables do not fit any spectrum of this tube (chi-square {found.chi_square:.0f} for {found.data} data),"
            " and intervals are widened for it: check kV, filters, loads and distances"
        )
    if not data.kermas:
        warnings.append(NO_OUTPUT)
    return TubeTwin(
        instrument=owner,
        spectral=replace(
            posterior, undetermined=tuple(text for text in posterior.undetermined if text.startswith(_OF_TUBE))
        ),
        output_known=bool(data.kermas),
        evidence=evidence,
        warnings=(NO_DETECTOR, *warnings),
        provenance=dict(provenance or {}),
    )


def fit_without_strays(
    data: DoseData, fit: Callable[[DoseData], SpectralFit]
) -> tuple[SpectralFit, DoseData, list[str]]:
    """A fit, the data that it was made of, and a line for each setting that strays from all the others and was left out.

    Args:
        data: all that the tables hold.
        fit: makes the fit of a part of them.

    Raises:
        FitError: see `fit_spectrum`.
    """
    found, kept = fit(data), data
    warnings = list(data.notes)
    for _ in range(len(data.kermas) // _MOST_STRAYS + len(data.ratios) // _MOST_STRAYS):
        # what is wrong pulls the fit towards itself, and is judged by a fit that has not seen it
        tried: list[tuple[SpectralFit, DoseData, KermaReading | KermaRatio]] = []
        for suspect in suspects(found, kept):
            others = _without(kept, suspect)
            with suppress(FitError):
                tried.append((fit(others), others, suspect))
                if not contradicts(tried[-1][0]):
                    break
        if not tried:
            break
        refit, others, suspect = min(tried, key=lambda one: one[0].chi_square)
        departure = _stray(refit.posterior, others, suspect)
        if departure is None:
            break
        lines = ", ".join(str(line) for line in suspect.rows)
        beam = " ".join([f"{suspect.kV:g} kV", text_from_filters(suspect.filters)]).strip()
        warnings.append(
            f"line{'' if len(suspect.rows) == 1 else 's'} {lines} ({beam}): {100.0 * math.expm1(departure):+.0f} % from what all"
            " the others say, left out"
        )
        found, kept = refit, others
    return found, kept, warnings


def table_evidence(
    posterior: SpectralPosterior,
    kept: DoseData,
    *,
    output: OutputTable | None,
    transmission: TransmissionTable | None,
) -> dict[str, Any]:
    """What a twin keeps of its tables: their numbers, how far each setting departs from the fit, unknown absorbers."""
    evidence: dict[str, Any] = {}
    kermas, ratios = departures(posterior, kept.kermas, kept.ratios)
    of_table = [
        index for index, item in enumerate(kept.ratios) if transmission is not None and item in transmission.ratios
    ]
    if output is not None:
        half_values = [index for index in range(len(kept.ratios)) if index not in of_table]
        evidence["output_table"] = output.as_dict() | {
            "departures": _rows(kept.kermas, kermas),
            "half_value_departures": _rows([kept.ratios[index] for index in half_values], ratios[half_values]),
        }
    if transmission is not None:
        evidence["transmission_table"] = transmission.as_dict() | {
            "departures": _rows([kept.ratios[index] for index in of_table], ratios[of_table]),
            "absorbers": absorber_thicknesses(posterior),
        }
    return evidence


def absorber_thicknesses(posterior: SpectralPosterior) -> dict[str, dict[str, dict[str, float]]]:
    """Of each unknown absorber, mm of each material that it amounts to, with 95 % intervals."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name in posterior.names:
        found = absorber_of_parameter(name)
        if found is not None:
            result.setdefault(found[0], {})[found[1]] = posterior.interval(name).as_dict()
    return result


def predict_ratio(posterior: SpectralPosterior, item: KermaRatio) -> NDArray[np.float64]:
    """Logarithm of the ratio that each draw expects (draw,); the absorber is the posterior's."""
    model = model_of_posterior(posterior, highest_kV=item.kV)
    open_beam = OpenBeam(kV=item.kV, filters=item.filters)
    behind = OpenBeam(kV=item.kV, filters=(*item.filters, *item.layers), absorber=item.absorber)
    if item.of_signal:
        rates = [model.signal(posterior.samples, beam).rate_DN_per_mAs for beam in (behind, open_beam)]
        return np.asarray(np.log(rates[0] / rates[1]))
    logs = [_log_kerma_read(posterior, beam) for beam in (behind, open_beam)]
    return np.asarray(logs[0] - logs[1])


def _log_kerma_read(posterior: SpectralPosterior, beam: OpenBeam) -> NDArray[np.float64]:
    """Logarithm of the kerma per mAs at 1 m as the dosimeter's response has it (draw,), its calibration left out."""
    model = model_of_posterior(posterior, highest_kV=beam.kV)
    value, _, hardness = model.log_kerma_derivatives(posterior.samples, beam, ())
    return value + hardness * _column(posterior, DOSIMETER_HARDNESS)


def _column(posterior: SpectralPosterior, name: str) -> NDArray[np.float64]:
    return posterior.column(name) if name in posterior.names else np.zeros(len(posterior.samples))


def departures(
    posterior: SpectralPosterior, kermas: Sequence[KermaReading], ratios: Sequence[KermaRatio]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithm of what was measured over what the posterior's draws expect, medians: kermas (n,), ratios (n,)."""
    calibration = _column(posterior, DOSIMETER_CALIBRATION)
    read = [
        math.log(item.value)
        - float(
            np.median(
                _log_kerma_read(posterior, OpenBeam(kV=item.kV, filters=item.filters))
                + item.calibration_sd * calibration
            )
        )
        for item in kermas
    ]
    behind = [math.log(item.value) - float(np.median(predict_ratio(posterior, item))) for item in ratios]
    return np.array(read), np.array(behind)


def suspects(fit: SpectralFit, data: DoseData) -> list[KermaReading | KermaRatio]:
    """The datum that departs most from a fit of all, if so much is rare among so many Gaussian ones; none: an empty list.

    Where the fit contradicts the data, that which departs most from a tube as it is expected comes first, a common factor aside: one
    that is off by orders of magnitude bends the fit until another departs from it more.
    """
    found = _farthest(fit.posterior, data, level_free=False)
    if contradicts(fit):
        names = fit.posterior.names
        expected = np.where([name == _FILTRATION for name in names], DOSE_FILTRATION.centre, 0.0)
        usual = replace(fit.posterior, samples=expected[None, :])
        found = [*_farthest(usual, data, level_free=True), *found]
    return list(dict.fromkeys(found))


def _farthest(posterior: SpectralPosterior, data: DoseData, *, level_free: bool) -> list[KermaReading | KermaRatio]:
    """The datum that departs most from what a posterior's draws expect, if it is rare; level_free: from the median departure."""
    from scipy.special import ndtri

    worst: tuple[float, list[KermaReading | KermaRatio]] = (1.0, [])
    kinds: tuple[Sequence[KermaReading | KermaRatio], ...] = (data.kermas, data.ratios)
    for items, departure in zip(kinds, departures(posterior, data.kermas, data.ratios), strict=True):
        if len(items) <= _LEAST_TO_JUDGE:
            continue
        own = np.array([item.relative_sd for item in items])
        size = np.abs(departure - (float(np.median(departure)) if level_free else 0.0))
        size = size / np.hypot(robust_sd(departure), own) / -float(ndtri(0.5 * _RARE / len(items)))
        place = int(np.argmax(size))
        if size[place] > worst[0]:
            worst = (float(size[place]), [items[place]])
    return worst[1]


def _without(data: DoseData, left_out: KermaReading | KermaRatio) -> DoseData:
    return DoseData(
        kermas=tuple(item for item in data.kermas if item is not left_out),
        ratios=tuple(item for item in data.ratios if item is not left_out),
    )


def _stray(posterior: SpectralPosterior, others: DoseData, suspect: KermaReading | KermaRatio) -> float | None:
    """How far a datum lies from a fit of the others (logarithm), if one table in a thousand would show so much, or None."""
    from scipy.special import stdtrit

    if isinstance(suspect, KermaReading):
        around = departures(posterior, others.kermas, ())[0]
        departure, freedom = float(departures(posterior, [suspect], ())[0][0]), suspect.freedom
    else:
        around = departures(posterior, (), others.ratios)[1]
        departure, freedom = float(departures(posterior, (), [suspect])[1][0]), math.inf
    common, own = robust_sd(around) ** 2, suspect.relative_sd**2
    together = (common + own) ** 2 / (common**2 / (_EFFICIENCY * (around.size - 1)) + own**2 / freedom)
    limit = -float(stdtrit(together, 0.5 * _STRAYS / (around.size + 1)))
    return departure if abs(departure) > limit * math.sqrt(common + own) else None


def _rows(items: Sequence[KermaReading | KermaRatio], departure: NDArray[np.float64]) -> list[dict[str, Any]]:
    return [
        {
            "kV": item.kV,
            "filter": text_from_filters(item.filters),
            "lines": list(item.rows),
            "departure_percent": 100.0 * math.expm1(float(value)),
        }
        for item, value in zip(items, departure, strict=True)
    ]
