"""Predictions for people: settings as objects, texts or words, one or many."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from ..acquisition.setting import Filter, Setting, filters_from_text, setting_from_text, text_from_filters
from ..errors import InputError
from ..materials import material_from_name
from ..results import Result, Table, axes_or_new, frame, interval_text
from .dual_layer import predict_back_layer
from .line_limits import frames_per_s
from .predict import UNITS, Prediction, predict_flatfield
from .twin import Twin

if TYPE_CHECKING:
    import pandas

_WORDS = ("filter", *(field.name for field in fields(Setting) if field.name != "filters"))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Predictions(Result):
    """Flatfields at several settings, in the order asked for."""

    predictions: tuple[Prediction, ...]

    def __len__(self) -> int:
        return len(self.predictions)

    def __iter__(self) -> Iterator[Prediction]:
        return iter(self.predictions)

    def __getitem__(self, number: int) -> Prediction:
        return self.predictions[number]

    def to_dict(self) -> dict[str, Any]:
        """`{"predictions": [...]}`, each as `raytwin predict --json` prints it."""
        return {"predictions": [item.to_dict() for item in self.predictions]}

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting: its words (kV, filter, ...), then every quantity with the ends of its interval."""
        return frame([{**_words_of(item.setting), **item.to_dict()} for item in self.predictions])

    def plot(self, ax: Any = None, *, what: str = "mean_DN", against: str = "kV") -> Any:
        """A quantity with its 95 % interval against a word of the settings; returns the axes.

        Args:
            ax: matplotlib axes; None: of a new figure.
            what: `mean_DN`, `sd_DN`, `gain_DN`, `photons_absorbed` or `air_kerma_uGy`.
            against: kV, exposure_ms, power_W, current_mA, averaged, binning or source_detector_mm.

        Raises:
            InputError: another quantity, or a word that some setting leaves open.
        """
        if what not in UNITS:
            raise InputError("what", received=repr(what), expected="one of " + ", ".join(UNITS))
        places = [_words_of(item.setting).get(against) for item in self.predictions]
        if not all(isinstance(place, int | float) for place in places):
            raise InputError("against", received=repr(against), expected="a number that every setting states")
        known = [
            (place, getattr(item, what))
            for place, item in zip(places, self.predictions, strict=True)
            if getattr(item, what) is not None
        ]
        axes = axes_or_new(ax)
        values = [item.value for _, item in known]
        ends = [[item.value - item.low for _, item in known], [item.high - item.value for _, item in known]]
        axes.errorbar([place for place, _ in known], values, yerr=ends, fmt="o", capsize=3)
        axes.set(xlabel=against, ylabel=f"{what} ({UNITS[what]})")
        return axes

    def _table(self) -> Table:
        names = ("mean_DN", "sd_DN", "gain_DN")
        rows = []
        for item in self.predictions:
            answer = item.to_dict()
            cells = [" (".join(filter(None, interval_text(answer[name]))) for name in names]
            closed = [f"{cell})" if "(" in cell else cell for cell in cells]
            rows.append((str(item.setting), *closed, "yes" if item.extrapolated else ""))
        title = f"{len(rows)} predictions, value (95 % interval)"
        return Table(title=title, header=("setting", *names, "extrapolated"), rows=tuple(rows))


def _words_of(setting: Setting) -> dict[str, Any]:
    """The words of a setting that are stated, by name."""
    words: dict[str, Any] = {}
    for name in _WORDS:
        value = text_from_filters(setting.filters) if name == "filter" else getattr(setting, name)
        if value is not None:
            words[name] = value
    return words


def as_filters(value: str | Filter | Sequence[str | Filter]) -> tuple[Filter, ...]:
    """Filters from their text (`"Cu:0.1+Al:1"`, empty: none), a `Filter`, or a sequence of either.

    Raises:
        InputError: a text that is no filter, or a material that nobody knows.
    """
    if isinstance(value, str):
        layers = filters_from_text(value)
    elif isinstance(value, Filter):
        layers = (value,)
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
    unknown = [name for name in value if name not in _WORDS]
    if unknown:
        raise InputError("setting", received=unknown[0], expected="words among " + ", ".join(_WORDS))
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
        if not isinstance(value, str | Filter) and hasattr(value, "__iter__")
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
    return tuple(as_setting({**words, **{name: lists[name][row] for name in lists}}) for row in range(count))


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
    return tuple(as_setting(item) for item in settings)


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
