"""What `fit_pod` adds to a curve of hits and misses when it is asked: lapse, bootstrap, covariates, explanation.

Each is a dictionary of plain numbers beside the curve. A warning goes into the list that was given.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..pod.answer import trials_from_table
from ..pod.table import PodTable
from ._given import generator_of

if TYPE_CHECKING:
    import numpy as np

    from ..pod import PodFit, Trials


def added_lapse(trials: "Trials", fit: "PodFit", *, ceiling: bool, floor: bool, warnings: list[str]) -> dict[str, Any]:
    """A curve that ends below 1, or begins above 0; where looks repeat, its values without intervals."""
    from ..pod import fit_lapse_pod

    found = fit_lapse_pod(trials, link=fit.link, log_size=fit.log_size, ceiling=ceiling, floor=floor)
    warnings += [f"with ceiling or floor: {note}" for note in found.warnings]
    answer = asdict(found)
    if fit.repeats != "pooled" and _looks_repeat(trials):
        warnings.append("ceiling and floor take all looks as independent, and looks repeat: values without intervals")
        answer |= {"p_plain": None, "a90_95": None, "a90_95_two_sided": None}
        for name in ("ceiling", "floor"):
            answer[name] |= {"low": None, "high": None}
    return answer


def _looks_repeat(trials: "Trials") -> bool:
    """Whether a network, image or site was part of more than one look, by more than one of them."""
    labels = (trials.network, trials.image, trials.site)
    return any(codes is not None and 0 < codes.max() < len(codes) - 1 for codes in labels)


def added_bootstrap(
    table: PodTable,
    fit: "PodFit",
    *,
    replicates: int,
    by: str | None,
    seed: "int | np.random.Generator",
    warnings: list[str],
) -> dict[str, Any]:
    """Bounds of a90 from refits to data resampled by row, network, image or both."""
    import numpy as np

    from ..pod import bootstrap_pod

    if isinstance(replicates, bool) or not isinstance(replicates, int | np.integer) or replicates < 20:
        raise InputError("bootstrap", received=replicates, expected="20 refits or more (1000 is usual)")
    if by is None:
        known = table.network is not None, table.image is not None
        by = {(True, True): "both", (True, False): "network", (False, True): "image"}.get(known, "row")
    if by == "row" and table.trials is not None:
        raise InputError("bootstrap", received="grouped trials", expected="one trial a row, or a column of images")
    found = bootstrap_pod(
        trials_from_table(table, log_size=fit.log_size),
        link=fit.link,
        log_size=fit.log_size,
        by=by,
        replicates=int(replicates),
        rng=generator_of(seed),
    )
    if None in (found.a90_95, found.a90_low, found.a90_high) and found.unknown < 0.025:
        warnings.append(
            "the bootstrap gives no bound there: so few networks or images need more resamples than were drawn"
        )
    return {
        "by": by,
        "replicates": int(replicates),
        "a90_95": found.a90_95,
        "a90_low": found.a90_low,
        "a90_high": found.a90_high,
        "unknown": found.unknown,
    }


def added_covariates(
    table: PodTable, fit: "PodFit", asked: Mapping[str, float | None], *, method: str, warnings: list[str]
) -> dict[str, Any]:
    """A curve with further properties of the objects: coefficients, and a50 and a90 where they are held."""
    import numpy as np

    from ..pod import fit_covariates, size_at

    if table.size_name in asked:
        raise InputError("covariates", received=table.size_name, expected="another property than the size")
    columns = {table.size_name: table.size, **{name: table.numbers(name) for name in asked}}
    held = {name: float(np.median(columns[name])) if value is None else float(value) for name, value in asked.items()}
    trials = trials_from_table(table, log_size=fit.log_size)
    logs = (table.size_name,) if fit.log_size else ()
    found = fit_covariates(trials, columns, link=fit.link, logs=logs, method=method)
    at = size_at(found, trials, columns, name=table.size_name, held=held)
    warnings += [f"with covariates: {note}" for note in at.warnings]
    names, scales = ("constant", *found.names), (False, *found.logs)
    values = (found.coefficients.tolist(), found.errors.tolist(), found.p.tolist())
    return {
        "coefficients": [
            {"name": name, "log": log, "value": value, "error": error, "p": p}
            for name, log, value, error, p in zip(names, scales, *values, strict=True)
        ],
        "method": found.method,
        "deviance": found.deviance,
        "aic": found.aic,
        "held": dict(at.held),
        "a50": at.a50,
        "a90": at.a90,
        "a90_95": asdict(at.a90_95),
    }


def added_explanation(
    table: PodTable, names: Sequence[str], *, link: str, repeats: str, seed: "int | np.random.Generator"
) -> list[dict[str, Any]]:
    """Which of several properties explains detection best, the best one first."""
    from ..pod import explain_detection

    found, _ = explain_detection(
        trials_from_table(table, log_size=False),
        {name: table.numbers(name) for name in names},
        rng=generator_of(seed),
        link=link,
        repeats=repeats,
    )
    shown = ("name", "log", "gain", "behind", "behind_error", "area", "rising", "aic", "p_beyond")
    return [
        {
            **{name: getattr(one, name) for name in shown},
            "a50": one.fit.a50,
            "a90": one.fit.a90,
            "a90_95": asdict(one.fit.a90_95),
        }
        for one in found
    ]
