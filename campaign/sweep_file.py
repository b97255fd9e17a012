"""The campaign file of a sweep (TOML): what is asked of a line, checked word by word before anything is begun.

Paths in it are relative to the file. docs/campaigns.md has an example and every word.
"""

import contextlib
import difflib
import itertools
import math
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..acquisition.setting import Filter, Setting, filter_from_text, filters_from_text, setting_from_text
from ..errors import InputError
from ..files import read_utf8
from ..segmentation.recipe import RECIPES, STARTER

SIZES = ("contrast", "size_mm")
LINKS = ("cloglog", "loglog", "logit", "probit")
METHODS = ("auto", "ml", "firth")
PAIRS = ("in_turn", "at_once")
KEEP_OF = ("throughput", "all")
MATERIALS = ("product_material", "foreign_material")
MOST_SETTINGS = 10_000
_START_STEPS = 240  # of random weights, on the references
_FEWEST_TO_CALIBRATE = 4  # of settings, for the two numbers of an observer: observers.efficiency

Pair = tuple[Setting, Setting]

# word of the grid -> field of Setting; each may stand as it is (both images) or as low_word and high_word
_GRID_WORDS = {
    "kv": "kV",
    "filter": "filters",
    "power_w": "power_W",
    "current_ma": "current_mA",
    "exposure_ms": "exposure_ms",
    "averaged": "averaged",
    "belt_speed_mm_s": "belt_speed_mm_s",
    "source_detector_mm": "source_detector_mm",
    "frame_interval_ms": "frame_interval_ms",
    "binning": "binning",
}
_TABLES = ("setting", "grid", "line", "limits", "requirement", "screening", "training", "detection", "pod", "contrast")


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """How products pass. Fields: product_pitch_mm (from one product on the belt to the next, None: unknown); pair (`in_turn`:
    one image after the other, `at_once`: two tubes or detectors); pause_ms between two products where no belt moves."""

    product_pitch_mm: float | None = None
    pair: str = "in_turn"
    pause_ms: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a setting may ask of line and product; None: no limit.

    Fields: maximum_kV, maximum_current_mA, maximum_power_w of the tube; readout_ms of the detector, where the twin does not know
    it; maximum_belt_speed_mm_s; maximum_motion_px (path of the object's image in one exposure); maximum_dose_uGy (air kerma of a
    pair); minimum_throughput_per_s (products); extrapolation (whether settings outside the calibrated range are tried);
    maximum_false_alarm_rate and a90 (the goal), known only afterwards.
    """

    maximum_kV: float | None = None
    maximum_current_mA: float | None = None
    maximum_power_w: float | None = None
    readout_ms: float | None = None
    maximum_belt_speed_mm_s: float | None = None
    maximum_motion_px: float | None = None
    maximum_dose_uGy: float | None = None
    minimum_throughput_per_s: float | None = None
    extrapolation: bool = True
    maximum_false_alarm_rate: float | None = None
    a90: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """What the line must do; None: not asked for.

    Fields: size (contrast or length in mm, as the campaign's curve has it) of an object that must be found with a probability of
    90 %, shown with 95 % confidence; false_alarm_rate (share of images without objects, shown with 95 % confidence);
    throughput_per_s (products); dose_uGy (air kerma of a pair, its 95 % upper end).
    """

    size: float
    false_alarm_rate: float | None = None
    throughput_per_s: float | None = None
    dose_uGy: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Screening:
    """A model observer looks at all settings; those that it leaves undecided are trained.

    Fields: observer (file of a calibrated one; None: calibrated on the campaign's own first settings); train_first (settings that it
    is calibrated on); round (settings trained before it is asked again); most (settings trained in all, None: no limit); detector,
    image (see `observers.Observer`; no image: see `observers.sight_of_references`).
    """

    observer: Path | None = None
    train_first: int = 6
    round: int = 4
    most: int | None = None
    detector: str = "ideal"
    image: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """How networks are trained.

    Fields: recipe (`starter`: networks start from the one that comes with raytwin; others from random weights); networks and
    images (pairs generated to learn from) of each setting; steps of each network; batch; crop_px (squares round the objects, 0:
    whole images); start_steps of one network that learns from the references first and that all start from (0: there is none);
    mixed_steps of it after that, on the references with start_shares of their exposure; start: the low and high setting of those
    first images where products come from a description.
    """

    recipe: str = STARTER
    networks: int = 5
    images: int = 150
    steps: int = 60
    batch: int = 8
    crop_px: int = 0
    start_steps: int = 0
    mixed_steps: int = 60
    start_shares: tuple[float, ...] = (0.2, 0.05)
    start: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Trying:
    """How networks are tried.

    Fields: draws (images of each test reference, each with its own noise); images (pairs, where products come from a
    description); threshold (probability above which a pixel is marked; None: from marked_share); marked_share (of the images a
    network learnt from that may show a mark away from objects: sets its threshold).
    """

    draws: int = 1
    images: int = 100
    threshold: float | None = None
    marked_share: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveOptions:
    """The POD curve. Fields: size (column of the objects), link, log_size, method; see `pod.fit_pod`."""

    size: str = "contrast"
    link: str = "cloglog"
    log_size: bool = False
    method: str = "auto"


@dataclass(frozen=True, slots=True, kw_only=True)
class Slabs:
    """What contrast-to-noise is predicted for: product and foreign object as slabs, see `generator.predictions.contrast`."""

    product: Filter
    foreign_object: Filter
    object_pixels: int = 100
    displaces: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """A campaign file, checked.

    Fields: path; twin, references, test_references (files; None: held back from the references); reference_setting (of
    references that do not say); test_share, validation_share (of the references' products, where the file does not deal them
    out); product_material, foreign_material (of a transfer); seed; settings (pairs, each once, in the file's order); timing;
    limits; requirement (None: the best is sought); screening (None: all are trained); training; trying; curve; slabs (None: no
    contrast-to-noise); keep_best (None: all are trained) of keep_best_of.
    """

    path: Path
    twin: Path
    references: Path
    test_references: Path | None
    reference_setting: Pair | None
    test_share: float
    validation_share: float
    product_material: str
    foreign_material: str
    seed: int
    settings: tuple[Pair, ...]
    timing: Timing
    limits: Limits
    requirement: Requirement | None
    screening: Screening | None
    training: Training
    trying: Trying
    curve: CurveOptions
    slabs: Slabs | None
    keep_best: int | None
    keep_best_of: str

    @property
    def goal(self) -> float | None:
        """Size that a90 is to lie below; None: none."""
        return self.limits.a90 if self.requirement is None else self.requirement.size

    @property
    def most_false_alarms(self) -> float | None:
        """Share of images without objects that may show an alarm; None: any."""
        if self.requirement is not None and self.requirement.false_alarm_rate is not None:
            return self.requirement.false_alarm_rate
        return self.limits.maximum_false_alarm_rate

    @property
    def described(self) -> bool:
        """Whether images come from a description of products rather than from reference images."""
        return self.references.suffix.lower() == ".toml"


def read_campaign(path: str | os.PathLike[str]) -> Campaign:
    """Read a campaign file and check every word of it.

    Raises:
        InputError: no such file, no TOML, an unknown word, a value that cannot be, a file that is not there.
    """
    file = Path(path)
    try:
        text = read_utf8(file)
        content = tomllib.loads(text)
    except FileNotFoundError:
        raise InputError(str(path), received="no such file", expected="a campaign file (TOML)") from None
    except OSError as error:
        what = "a folder" if file.is_dir() else f"a file that cannot be read ({error.strerror})"
        raise InputError(str(path), received=what, expected="a campaign file (TOML)") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), received=f"text that is not TOML ({error})", expected="a campaign file") from None
    if not text.strip():
        raise InputError(
            str(path),
            received="an empty file",
            expected="a campaign file (TOML) with twin, references and settings",
            remedy="docs/campaigns.md has an example",
        )
    words = _Words(content, file.name)
    tables = {name: words.table(name) for name in _TABLES if name != "setting"}
    settings = _settings(words.tables("setting"), tables["grid"], file.name)
    references = words.file("references", file.parent)
    test_references = words.file("test_references", file.parent, needed=False)
    twin = _twin_file(words, file.parent)
    low, high = (words.text(f"reference_{side}", "") for side in ("low", "high"))
    if bool(low) != bool(high):
        raise InputError(
            f"{file.name}, reference_low and reference_high", received="one of the two", expected="both or neither"
        )
    shares = {name: words.number(name, default, least=0.0, most=0.9) for name, default in _SHARES.items()}
    if sum(shares.values()) >= 1:
        raise InputError(
            f"{file.name}, test_share and validation_share",
            received=sum(shares.values()),
            expected="less than 1 together",
        )
    product_material, foreign_material = _materials(words, [references, test_references])
    seed = words.whole("seed", 1, least=0)
    keep_best = words.whole("keep_best", None, least=1)
    keep_best_of = words.choice("keep_best_of", "throughput", KEEP_OF)
    words.done(_TABLES)
    content_words = {word.lower() for word in content}
    # a contrast is another one at every setting where products are described; a length is not
    described = references.suffix.lower() == ".toml"
    requirement, usual_size = None, "size_mm" if described else "contrast"
    if "requirement" in content_words:
        requirement, usual_size = _requirement(tables["requirement"])
    campaign = Campaign(
        path=file,
        twin=twin,
        references=references,
        test_references=test_references,
        reference_setting=(setting_from_text(low), setting_from_text(high)) if low else None,
        test_share=shares["test_share"],
        validation_share=shares["validation_share"],
        product_material=product_material,
        foreign_material=foreign_material,
        seed=seed,
        settings=settings,
        timing=_timing(tables["line"]),
        limits=_limits(tables["limits"]),
        requirement=requirement,
        screening=_screening(tables["screening"], file.parent) if "screening" in content_words else None,
        training=_training(tables["training"]),
        trying=_trying(tables["detection"]),
        curve=_curve(tables["pod"], usual=usual_size),
        slabs=_slabs(tables["contrast"]),
        keep_best=keep_best,
        keep_best_of=keep_best_of,
    )
    _check_together(campaign, usual_size)
    return campaign


_SHARES = {"test_share": 0.3, "validation_share": 0.15}


def _check_together(campaign: Campaign, size_of_requirement: str) -> None:
    """Words that fit alone but not together."""
    name = campaign.path.name
    tests = campaign.test_references
    if not campaign.described and tests is not None and tests.samefile(campaign.references):
        raise InputError(
            f"{name}, test_references",
            received=f"{tests.name}, the file that networks learn from",
            expected="images of other products",
            remedy="leave it out: a share of the products is then held back",
        )
    _check_requirement(campaign, size_of_requirement)
    _check_screening(campaign)
    if campaign.keep_best is not None and campaign.slabs is None:
        raise InputError(
            f"{name}, keep_best",
            received=f"{campaign.keep_best} without a table [contrast]",
            expected="product and object to predict contrast-to-noise for",
            remedy='for example [contrast] product = "chicken_breast:20" object = "rib_bone:1"',
        )
    moving = any(one.belt_speed_mm_s is not None for pair in campaign.settings for one in pair)
    if moving and campaign.limits.minimum_throughput_per_s is not None and campaign.timing.product_pitch_mm is None:
        raise InputError(
            f"{name}, [limits], minimum_throughput_per_s",
            received="settings with a belt speed, and no product_pitch_mm",
            expected="how many products a metre of belt carries",
            remedy="give product_pitch_mm = ... under [line]",
        )
    if (
        campaign.described
        and campaign.test_references is not None
        and campaign.test_references.suffix.lower() != ".toml"
    ):
        raise InputError(
            f"{name}, test_references",
            received=f"{campaign.test_references.name} beside the description {campaign.references.name}",
            expected="a description as well, or none: other products are drawn from the same one",
        )
    if (
        not campaign.described
        and campaign.test_references is not None
        and campaign.test_references.suffix.lower() == ".toml"
    ):
        raise InputError(
            f"{name}, test_references",
            received=f"the description {campaign.test_references.name} beside reference images",
            expected="reference images as well",
        )
    if campaign.described and campaign.training.start is None and campaign.training.start_steps:
        low, high = (replace(one, averaged=50, belt_speed_mm_s=None) for one in campaign.settings[0])
        raise InputError(
            f"{name}, [training], start_low and start_high",
            received="neither, with products from a description",
            expected="two low-noise settings to learn from first",
            remedy=f'for example start_low = "{low}" and start_high = "{high}"; start_steps = 0 does without',
        )
    if not campaign.described and campaign.training.start is not None and campaign.training.start_steps:
        raise InputError(
            f"{name}, [training], start_low and start_high",
            received="settings, with reference images",
            expected="none: networks learn from the references first",
        )
    if campaign.described and campaign.curve.size == "contrast":
        raise InputError(
            f"{name}, [pod], size",
            received="contrast with products from a description, whose contrast is another one at every setting",
            expected="one size for all settings",
            remedy='write size = "size_mm" under [pod]',
        )


def _check_requirement(campaign: Campaign, size: str) -> None:
    if campaign.requirement is None:
        return
    limits = campaign.limits
    twice = [
        word
        for word, mine, theirs in (
            ("a90", limits.a90, campaign.requirement.size),
            ("maximum_false_alarm_rate", limits.maximum_false_alarm_rate, campaign.requirement.false_alarm_rate),
            ("minimum_throughput_per_s", limits.minimum_throughput_per_s, campaign.requirement.throughput_per_s),
            ("maximum_dose_uGy", limits.maximum_dose_uGy, campaign.requirement.dose_uGy),
        )
        if mine is not None and theirs is not None
    ]
    if twice:
        raise InputError(
            f"{campaign.path.name}, [limits], {twice[0]}",
            received="the same beside [requirement]",
            expected="one of the two",
            remedy="a requirement is judged for every setting, a limit rules settings out",
        )
    if campaign.curve.size != size:
        raise InputError(
            f"{campaign.path.name}, [pod], size",
            received=f"{campaign.curve.size} with a requirement on {size}",
            expected="one size",
            remedy="leave size out under [pod]; the other size is reported beside it",
        )


def _check_screening(campaign: Campaign) -> None:
    if campaign.screening is None:
        return
    if campaign.described:
        raise InputError(
            f"{campaign.path.name}, [screening]",
            received=f"the description {campaign.references.name}",
            expected="reference images, whose objects the observer looks for",
            remedy="generate some from the description (`raytwin generate`), or leave [screening] out",
        )
    most = campaign.screening.most
    if most is not None and campaign.screening.observer is None and most < campaign.screening.train_first:
        raise InputError(
            f"{campaign.path.name}, [screening], most",
            received=most,
            expected=f"train_first, {campaign.screening.train_first}, or more",
        )


class _Words:
    """A table of the file, read word by word; case does not matter; what is left over at the end is an error."""

    def __init__(self, table: Mapping[str, Any], where: str) -> None:
        self.where = where
        self._given: dict[str, Any] = {}
        self._asked: list[str] = []
        for word, value in table.items():
            if word.lower() in self._given:
                raise InputError(where, received=f"{word} twice", expected="each word once")
            self._given[word.lower()] = value

    def __contains__(self, word: str) -> bool:
        return word.lower() in self._given

    def take(self, word: str) -> Any:
        self._asked.append(word)
        return self._given.get(word.lower())

    def error(self, word: str, received: object, expected: str, remedy: str = "") -> InputError:
        return InputError(f"{self.where}, {word}", received=received, expected=expected, remedy=remedy)

    def number(
        self, word: str, default: Any, *, above: float | None = None, least: float = -math.inf, most: float = math.inf
    ) -> Any:
        """A finite number within the range; the default where the word is not there."""
        value = self.take(word)
        if value is None:
            return default
        low = f"above {above:g}" if above is not None else f"{least:g} or more" if least > -math.inf else "finite"
        expected = f"a number, {low}" + (f", at most {most:g}" if most < math.inf else "")
        return _number(value, lambda got: self.error(word, got, expected), above=above, least=least, most=most)

    def whole(self, word: str, default: Any, *, least: int) -> Any:
        value = self.take(word)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.error(word, repr(value), f"a whole number, {least} or more")
        return value

    def text(self, word: str, default: str | None) -> str:
        value = self.take(word)
        if value is None and default is not None:
            return default
        if not isinstance(value, str) or not value.strip():
            raise self.error(word, "nothing" if value is None else repr(value), "a text in quotes")
        return value.strip()

    def choice(self, word: str, default: str, choices: Sequence[str]) -> str:
        value = self.text(word, default)
        if value not in choices:
            near = difflib.get_close_matches(value, choices, n=1)
            raise self.error(
                word, repr(value), "one of " + ", ".join(choices), f"did you mean {near[0]}?" if near else ""
            )
        return value

    def flag(self, word: str, default: bool) -> bool:
        value = self.take(word)
        if value is None:
            return default
        if not isinstance(value, bool):
            raise self.error(word, repr(value), "true or false")
        return value

    def file(self, word: str, folder: Path, *, needed: bool = True) -> Any:
        if not needed and word not in self:
            self.take(word)
            return None
        place = folder / self.text(word, None)
        if not place.is_file():
            what = "a folder" if place.is_dir() else "which is not there"
            raise self.error(word, f"{place}, {what}", "a file; paths are relative to the campaign file")
        return place

    def table(self, word: str) -> "_Words":
        value = self.take(word)
        if value is not None and not isinstance(value, dict):
            raise self.error(
                f"[{word}]", "several tables" if isinstance(value, list) else repr(value), f"one table [{word}]"
            )
        return _Words(value or {}, f"{self.where}, [{word}]")

    def tables(self, word: str) -> "list[_Words]":
        value = self.take(word)
        found = [] if value is None else value
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            raise self.error(f"[[{word}]]", "one table or a value", f"tables written [[{word}]]")
        return [_Words(one, f"{self.where}, {word} {number + 1}") for number, one in enumerate(found)]

    def done(self, tables: Sequence[str] = ()) -> None:
        """Refuse what nobody asked for."""
        known = list(dict.fromkeys(self._asked))
        lowered = {word.lower() for word in known}
        for word in self._given:
            if word not in lowered:
                near = difflib.get_close_matches(word, known, n=2)
                raise InputError(
                    self.where,
                    received=f"the word {word!r}",
                    expected="one of " + ", ".join(f"[{name}]" if name in tables else name for name in known),
                    remedy=f"did you mean {' or '.join(near)}?" if near else "",
                )


def _number(
    value: object, refuse: Callable[[str], InputError], *, above: float | None, least: float, most: float
) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise refuse(repr(value))
    fits = math.isfinite(value) and value <= most and (value > above if above is not None else value >= least)
    if not fits:
        raise refuse(f"{value:g}")
    return float(value)


def _twin_file(words: _Words, folder: Path) -> Path:
    from ..generator.twins.shipped import shipped_calibration, shipped_calibrations

    name = words.text("twin", None)
    place = folder / name
    if place.is_file():
        return place
    if name in shipped_calibrations():
        return shipped_calibration(name)
    raise words.error(
        "twin",
        f"{place}, which is not there",
        "a twin file relative to the campaign file, or the name of a shipped calibration",
    )


def _materials(words: _Words, files: Sequence[Path | None]) -> tuple[str, str]:
    """Materials of product and foreign object: those of the campaign, else those that the reference images state, else the usual."""
    from ..acquisition.dataset_io import read_dataset
    from ..generator.datasets.reference_materials import USUAL_MATERIALS, materials_of_references

    product, foreign = (_material(words, name) for name in MATERIALS)
    for file in files:
        if file is None or file.suffix.lower() == ".toml":
            continue
        try:
            dataset = read_dataset(file)
        except InputError:
            continue  # refused where its images are opened
        with dataset:
            product, foreign = materials_of_references(
                dataset, product_material=product, foreign_material=foreign, where=f"{words.where}, "
            )
    return product or USUAL_MATERIALS[0], foreign or USUAL_MATERIALS[1]


def _material(words: _Words, name: str) -> str | None:
    """The material that a word names; None where the word is not there."""
    from ..materials import material_from_name

    if name not in words:
        return None
    material = words.text(name, None)
    with _placed(f"{words.where}, {name}"):
        material_from_name(material)
    return material


@contextlib.contextmanager
def _placed(where: str) -> Iterator[None]:
    """Errors of a part of the file say where in it they are."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"{where}, {error.argument}", received=error.received, expected=error.expected, remedy=error.remedy
        ) from None


def _settings(given: "list[_Words]", grid: _Words, name: str) -> tuple[Pair, ...]:
    pairs: dict[str, Pair] = {}
    for table in given:
        texts = [table.text(side, None) for side in ("low", "high")]
        table.done()
        with _placed(table.where):
            pair = (setting_from_text(texts[0]), setting_from_text(texts[1]))
            _check_pair(pair)
        pairs[text_of_pair(pair)] = pair
    for pair in _grid(grid):
        pairs.setdefault(text_of_pair(pair), pair)
    if not pairs:
        raise InputError(
            name,
            received="no settings",
            expected="[[setting]] tables with low and high, a [grid], or both",
            remedy='for example [grid] low_kv = [40, 50] high_kv = [90] filter = "Cu:0.05" power_w = 40 exposure_ms = [20, 50]',
        )
    return tuple(pairs.values())


def text_of_pair(pair: Pair) -> str:
    """LOW;HIGH, the one text of a pair of settings."""
    return ";".join(map(str, pair))


def _check_pair(pair: Pair) -> None:
    from ..generator.datasets.belt_motion import check_one_belt
    from ..materials import material_from_name

    check_one_belt(pair)
    for setting in pair:
        setting.stated_load_mAs()
        for layer in setting.filters:
            material_from_name(layer.material)


def _grid(words: _Words) -> Iterator[Pair]:
    axes: list[tuple[tuple[str, ...], str, list[Any]]] = []  # sides, field, values
    for word, field in _GRID_WORDS.items():
        values = words.take(word)
        sided = {side: words.take(f"{side}_{word}") for side in ("low", "high")}
        if word == "kv" and values is not None:
            raise words.error("kv", "one tube voltage for both images", "low_kv and high_kv")
        if values is not None and any(one is not None for one in sided.values()):
            raise words.error(word, f"{word} beside low_{word} or high_{word}", "one of the two ways")
        if values is not None:
            axes.append((("low", "high"), field, _values(values, words, word, field)))
        for side, own in sided.items():
            if own is not None:
                axes.append(((side,), field, _values(own, words, f"{side}_{word}", field)))
    words.done()
    if not axes:
        return
    held = {(side, field) for sides, field, _ in axes for side in sides}
    for side, field in itertools.product(("low", "high"), ("kV", "exposure_ms")):
        if (side, field) not in held:
            raise InputError(
                words.where,
                received=f"no {side}_{field.lower()}" + ("" if field == "kV" else f" and no {field.lower()}"),
                expected="tube voltage, tube load and exposure of both images",
            )
    count = math.prod(len(values) for _, _, values in axes)
    if count > MOST_SETTINGS:
        raise InputError(words.where, received=f"{count} settings", expected=f"at most {MOST_SETTINGS}")
    for chosen in itertools.product(*(values for _, _, values in axes)):
        fields: dict[str, dict[str, Any]] = {"low": {}, "high": {}}
        for (sides, field, _), value in zip(axes, chosen, strict=True):
            for side in sides:
                fields[side][field] = value
        with _placed(words.where):
            pair = (Setting(**fields["low"]), Setting(**fields["high"]))
            _check_pair(pair)
        yield pair


def _values(given: Any, words: _Words, word: str, field: str) -> list[Any]:
    """The values of an axis of the grid; one value is an axis of one."""
    values = given if isinstance(given, list) else [given]
    if not values:
        raise words.error(word, "an empty list", "one value or more")
    if field == "filters":
        if not all(isinstance(one, str) for one in values):
            raise words.error(word, repr(given), 'texts, for example "Cu:0.05" or ["Cu:0.05", "Al:1+Cu:0.1", "none"]')
        with _placed(f"{words.where}, {word}"):
            return [() if one.strip() == "none" else filters_from_text(one) for one in values]
    whole = field in ("averaged", "binning")
    for one in values:
        if isinstance(one, bool) or not isinstance(one, int if whole else int | float):
            raise words.error(word, repr(given), "whole numbers" if whole else "numbers")
    return values if whole else [float(one) for one in values]


def _timing(words: _Words) -> Timing:
    timing = Timing(
        product_pitch_mm=words.number("product_pitch_mm", None, above=0.0),
        pair=words.choice("pair", "in_turn", PAIRS),
        pause_ms=words.number("pause_ms", 0.0, least=0.0),
    )
    words.done()
    return timing


def _limits(words: _Words) -> Limits:
    above_0 = (
        "maximum_kV",
        "maximum_current_mA",
        "maximum_power_w",
        "maximum_belt_speed_mm_s",
        "maximum_motion_px",
        "maximum_dose_uGy",
        "minimum_throughput_per_s",
        "a90",
    )
    numbers = {name: words.number(name, None, above=0.0) for name in above_0}
    limits = Limits(
        **numbers,
        readout_ms=words.number("readout_ms", None, least=0.0),
        maximum_false_alarm_rate=words.number("maximum_false_alarm_rate", None, least=0.0, most=1.0),
        extrapolation=words.flag("extrapolation", True),
    )
    words.done()
    return limits


def _requirement(words: _Words) -> tuple[Requirement, str]:
    """The requirement, and the name of its size."""
    sizes = {name: words.number(name, None, above=0.0) for name in SIZES}
    given = [name for name, value in sizes.items() if value is not None]
    if len(given) != 1:
        raise words.error(
            "contrast or size_mm", "both" if given else "neither", "the size of the object that must be found"
        )
    rates = {
        "throughput_per_s": words.number("throughput_per_s", None, above=0.0),
        "products_per_minute": words.number("products_per_minute", None, above=0.0),
    }
    if None not in rates.values():
        raise words.error("throughput_per_s and products_per_minute", "both", "one of the two")
    pace = rates["throughput_per_s"]
    if rates["products_per_minute"] is not None:
        pace = rates["products_per_minute"] / 60.0
    requirement = Requirement(
        size=sizes[given[0]],
        false_alarm_rate=words.number("false_alarm_rate", None, above=0.0, most=1.0),
        throughput_per_s=pace,
        dose_uGy=words.number("dose_uGy", None, above=0.0),
    )
    words.done()
    return requirement, given[0]


def _screening(words: _Words, folder: Path) -> Screening:
    from ..observers import DETECTORS, IMAGES

    usual = Screening()
    screening = Screening(
        observer=words.file("observer", folder, needed=False),
        train_first=words.whole("train_first", usual.train_first, least=_FEWEST_TO_CALIBRATE),
        round=words.whole("round", usual.round, least=1),
        most=words.whole("most", None, least=1),
        detector=words.choice("detector", usual.detector, tuple(DETECTORS)),
        image=words.choice("image", "", IMAGES) if "image" in words else None,
    )
    if screening.observer is not None:
        for word in ("train_first", "detector", "image"):
            if word in words:
                raise words.error(word, "given beside observer", "those that it was calibrated with; leave it out")
    words.done()
    return screening


def _training(words: _Words) -> Training:
    recipe = words.choice("recipe", STARTER, (STARTER, *RECIPES))
    usual = Training(recipe=recipe, start_steps=0 if recipe == STARTER else _START_STEPS)
    least = {"networks": 1, "images": 4, "steps": 1, "batch": 2, "crop_px": 0, "start_steps": 0, "mixed_steps": 0}
    wholes = {name: words.whole(name, getattr(usual, name), least=low) for name, low in least.items()}
    if 0 < wholes["crop_px"] < 16:
        raise words.error("crop_px", wholes["crop_px"], "0 for whole images, or 16 pixels and more")
    shares = words.take("start_shares")
    given = list(usual.start_shares) if shares is None else shares
    if not isinstance(given, list):
        raise words.error(
            "start_shares", repr(given), "a list of shares of the references' exposure, for example [0.2, 0.05]"
        )

    def refuse(got: str) -> InputError:
        return words.error("start_shares", got, "shares of the references' exposure, above 0 and at most 0.9")

    start = [words.text(f"start_{side}", "") for side in ("low", "high")]
    if bool(start[0]) != bool(start[1]):
        raise words.error("start_low and start_high", "one of the two", "both or neither")
    with _placed(words.where):
        texts = [str(setting_from_text(one)) for one in start if one]
    training = replace(
        usual,
        **wholes,
        start=(texts[0], texts[1]) if texts else None,
        start_shares=tuple(_number(one, refuse, above=0.0, least=0.0, most=0.9) for one in given),
    )
    words.done()
    return training


def _trying(words: _Words) -> Trying:
    both = "threshold" in words and "marked_share" in words
    trying = Trying(
        draws=words.whole("draws", 1, least=1),
        images=words.whole("images", 100, least=10),
        threshold=words.number("threshold", None, above=0.0, most=0.999999),
        marked_share=words.number("marked_share", 0.1, above=0.0, most=0.9),
    )
    if both:
        raise words.error("threshold and marked_share", "both", "one of the two: either sets what is marked")
    words.done()
    return trying


def _curve(words: _Words, *, usual: str) -> CurveOptions:
    curve = CurveOptions(
        size=words.choice("size", usual, SIZES),
        link=words.choice("link", "cloglog", LINKS),
        log_size=words.flag("log_size", False),
        method=words.choice("method", "auto", METHODS),
    )
    words.done()
    return curve


def _slabs(words: _Words) -> Slabs | None:
    from ..materials import material_from_name

    if "product" not in words and "object" not in words:
        for word in ("product", "object", "object_pixels", "displaces"):
            words.take(word)
        if "object_pixels" in words or "displaces" in words:
            raise words.error("product", "nothing", 'MATERIAL:mm, for example "chicken_breast:20"')
        words.done()
        return None
    layers = {}
    for word in ("product", "object"):
        text = words.text(word, None)
        with _placed(f"{words.where}, {word}"):
            layers[word] = filter_from_text(text)
            material_from_name(layers[word].material)
    slabs = Slabs(
        product=layers["product"],
        foreign_object=layers["object"],
        object_pixels=words.whole("object_pixels", 100, least=1),
        displaces=words.flag("displaces", False),
    )
    words.done()
    return slabs
