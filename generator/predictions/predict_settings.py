"""Predictions for people: settings as objects, texts or words, one or many."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ...acquisition.setting import Filter, Setting, filters_from_text, setting_from_text
from ...errors import InputError
from ...materials import material_from_name
from ..line.line_limits import frames_per_s
from ..line.twin import Twin
from .dual_layer import predict_back_layer
from .predict import WORDS, Prediction, Predictions, predict_flatfield

if TYPE_CHECKING:
    pass


def as_filters(value: str | Filter | Sequence[str | Filter]) -> tuple[Filter, ...]:
    """Filters from their text (`"Cu:0.1+Al:1"`, empty: none), a `Filter`, or a sequence of either.

    Raises:
        InputError: a text that is no filter, or a material that nobody knows.
    """
    if isinstance(value, str):
        layers = filters_from_text(value)
    elif isinstance(value, Filter):
        layers = (value,)
    elif not isinstance(value, Iterable):
        raise InputError(
            "filter", received=repr(value), expected='a text such as "Cu:0.1+Al:1", a Filter, or a list of these'
        )
    else:
        layers = tuple(layer for item in value for layer in as_filters(item))
    for layer in layers:
        material_from_name(layer.material)
    return layers


def as_setting(value: Setting | str | Mapping[str, Any]) -> Setting:
    """A setting from itself, from its text form, or from its words; its materials are looked up.

    Raises:
        InputError: a text or words that are no setting, or a material that nobody knows.
    """
    if isinstance(value, Setting):
        as_filters(value.filters)
        return value
    if isinstance(value, str):
        return as_setting(setting_from_text(value))
    if not isinstance(value, Mapping):
        raise InputError(
            "setting",
            received=repr(value),
            expected="a Setting, its text or its words",
            remedy='for example "kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1"',
        )
    unknown = [name for name in value if name not in WORDS]
    if unknown:
        raise InputError("setting", received=unknown[0], expected="words among " + ", ".join(WORDS))
    for name in ("kV", "exposure_ms"):
        if value.get(name) is None:
            raise InputError("setting", received=f"no {name}", expected="kV and exposure_ms, and power_W or current_mA")
    words = {name: item for name, item in value.items() if name != "filter" and item is not None}
    for name, item in words.items():
        try:
            words[name] = int(item) if name in ("averaged", "binning") and int(item) == item else float(item)
        except (TypeError, ValueError):
            raise InputError(f"setting, {name}", received=repr(item), expected="a number") from None
    return Setting(filters=as_filters(value.get("filter") or ""), **words)


def settings_from_words(words: Mapping[str, Any]) -> tuple[Setting, ...] | Setting:
    """One setting, or several where words are lists, which go together entry by entry.

    Raises:
        InputError: lists of different lengths, or words that make no setting.
    """
    lists = {
        name: list(value)
        for name, value in words.items()
        if not isinstance(value, str | Filter) and hasattr(value, "__iter__") and getattr(value, "ndim", 1) > 0
    }
    if not lists:
        return as_setting(words)
    lengths = {name: len(values) for name, values in lists.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(
            "settings",
            received=", ".join(f"{length} of {name}" for name, length in lengths.items()),
            expected="lists of one length, which go together entry by entry",
        )
    count = next(iter(lengths.values()))
    return _one_or_more(
        tuple(as_setting({**words, **{name: lists[name][row] for name in lists}}) for row in range(count))
    )


def predict_setting(twin: Twin, setting: Setting) -> Prediction:
    """`predict_flatfield` with the frame rate, and the back layer where the panel has one.

    Raises:
        InputError: as `predict_flatfield`.
    """
    found = predict_flatfield(twin, setting)
    dual = twin.instrument.dual_layer and twin.spectral is not None
    return replace(
        found,
        frames_per_s=frames_per_s(twin.instrument, setting),
        back_layer=predict_back_layer(twin, setting) if dual else None,
    )


def asked_settings(
    settings: Setting | str | Sequence[Setting | str] | None, words: Mapping[str, Any]
) -> Setting | tuple[Setting, ...]:
    """One setting or several, from what a user gave.

    Raises:
        InputError: settings and words together, neither, or what makes no setting.
    """
    if (settings is None) == (not words):
        raise InputError(
            "settings",
            received="nothing" if settings is None else "settings and words",
            expected="a setting, several, or the words of one",
            remedy='for example kV=60, power_W=30, exposure_ms=20, filter="Cu:0.1"',
        )
    if settings is None:
        return settings_from_words(words)
    if isinstance(settings, Setting | str):
        return as_setting(settings)
    return _one_or_more(tuple(as_setting(item) for item in settings))


def _one_or_more(settings: tuple[Setting, ...]) -> tuple[Setting, ...]:
    if not settings:
        raise InputError("settings", received="an empty list", expected="one setting or more")
    return settings


def predict_words(
    twin: Twin, settings: Setting | str | Sequence[Setting | str] | None, words: Mapping[str, Any]
) -> Prediction | Predictions:
    """What `Twin.predict` does.

    Raises:
        InputError: as `asked_settings` and `predict_setting`.
    """
    asked = asked_settings(settings, words)
    if isinstance(asked, Setting):
        return predict_setting(twin, asked)
    return Predictions(predictions=tuple(predict_setting(twin, item) for item in asked))
