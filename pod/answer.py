"""POD fits as plain numbers, and what a table of trials asks of a fit."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from .hit_miss import Bounds, PodFit, trusted_bound
from .response import ResponseFit
from .table import PodTable
from .trials import Trials, check_trials


def default_repeats(table: PodTable) -> str:
    """`crossed` where both a network and an image are known, else `pooled`."""
    return "crossed" if table.network is not None and table.image is not None else "pooled"


def trials_from_table(table: PodTable, *, log_size: bool) -> Trials:
    """The table's rows as checked trials."""
    return check_trials(
        table.size,
        table.hits if table.hits is not None else [],
        trials=table.trials,
        network=table.network,
        image=table.image,
        site=table.site,
        log_size=log_size,
        places=table.places,
    )


def notes_on_table(table: PodTable, repeats: str) -> list[str]:
    """What a reader of the answer should know of how the table was taken."""
    notes = list(table.notes)
    settings = set(table.other.get("setting", ()))
    if len(settings) > 1:
        notes.append(
            f"{len(settings)} settings in one curve; choose one with where={'setting': ...} (--where setting=...)"
        )
    if repeats == "pooled":
        for name in ("site", "image", "network"):
            labels = getattr(table, name)
            if labels is not None and 1 < len(set(labels)) < len(labels):
                notes.append(
                    f"{len(labels)} trials of {len(set(labels))} {name}s taken as independent: repeats need"
                    " repeats='scaled', 'cluster' or 'crossed' (--repeats)"
                )
                break
    return notes


def fit_answer(fit: PodFit) -> dict[str, Any]:
    """A fit as the POD answer."""
    result: dict[str, Any] = {
        "link": fit.link,
        "method": fit.method,
        "variant": fit.variant,
        "repeats": fit.repeats,
        "log_size": fit.log_size,
        "n": fit.n,
        "n_hits": fit.n_hits,
        "c0": fit.c0,
        "c1": fit.c1,
        "se0": fit.se0,
        "se1": fit.se1,
        "log_likelihood": fit.log_likelihood,
        "deviance": fit.deviance,
        "aic": fit.aic,
        "a50": fit.a50,
        "a90": fit.a90,
        "a90_95": asdict(fit.a90_95),
        "a90_95_two_sided": asdict(fit.a90_95_two_sided),
        "a90_low_two_sided": asdict(fit.a90_low_two_sided),
        "degrees_of_freedom": fit.degrees_of_freedom,
        "separated": fit.separated,
        "reaches_90": fit.reaches_90,
        "warnings": list(fit.warnings),
    }
    if fit.crossed is not None:
        for name in ("sd_network", "sd_image", "n_networks", "n_images", "a50_conditional", "a90_conditional"):
            result[name] = getattr(fit.crossed, name)
    if fit.naive is not None:
        naive = fit.naive
        result["naive"] = {
            "a50": naive.a50,
            "a90": naive.a90,
            "a90_95": asdict(naive.a90_95),
            "a90_95_two_sided": asdict(naive.a90_95_two_sided),
        }
    return result


def trusted_from_answer(answer: Mapping[str, Any], name: str) -> Any:
    """`trusted_bound` of an answer's `name` (a90_95 and the like); None where there is none, or no such entry."""
    bounds = answer.get(name)
    if not isinstance(bounds, Mapping):
        return None
    known = Bounds(**{field.name: bounds.get(field.name) for field in fields(Bounds)})
    return trusted_bound(known, separated=bool(answer.get("separated")))


def response_answer(fit: ResponseFit) -> dict[str, Any]:
    """A fit of a continuous response as the POD answer."""
    return {
        "link": "probit",
        "method": "ml",
        "variant": "censored regression of the response on size",
        "repeats": fit.repeats,
        "log_size": fit.log_size,
        "n": fit.n,
        "n_hits": fit.n_above,
        "c0": fit.c0,
        "c1": fit.c1,
        "se0": fit.se0,
        "se1": fit.se1,
        "log_likelihood": fit.log_likelihood,
        "deviance": -2 * fit.log_likelihood,
        "aic": 6 - 2 * fit.log_likelihood,
        "a50": fit.a50,
        "a90": fit.a90,
        "a90_95": asdict(fit.a90_95),
        "a90_95_two_sided": asdict(fit.a90_95_two_sided),
        "a90_low_two_sided": asdict(fit.a90_low_two_sided),
        "separated": False,
        "reaches_90": fit.reaches_90,
        "warnings": list(fit.warnings),
        "response": {
            name: getattr(fit, name)
            for name in (
                "decision",
                "box_cox",
                "intercept",
                "slope",
                "scatter",
                "p_line",
                "p_scatter",
                "mu",
                "sigma",
                "n_left_censored",
                "n_right_censored",
            )
        },
    }
