"""The diagnosis in plain words: one paragraph that can be read once."""

import math
from collections.abc import Sequence

from ...checks.findings import FindingCode
from ...generator.effects import EFFECTS
from ..inference.inference import title_of
from ..judgement.answer import EXPLAINED, Cause, Diagnosis, Place
from ..judgement.held_out import Gap

# so many of a kind fit into a paragraph
_NAMED = 3
_NAMED_UNTESTED = 8  # names alone are shorter
_NAMED_FAMILIES = 4
_RIVALS, _LEAST_LIKELY = 5, 0.05  # explanations that are named where none leads
_MOSTLY = 0.5  # of the gap above noise, from which what takes so much explains it
_SHAPED_LIKE = "like "  # templates of what effects would do
_KIND_WORDS = {"flat": "flats", "dark": "darks", "object": "objects", "afterglow": "frames after the beam"}
_AXIS_WORDS = {
    "level": "brightness",
    "noise": "noise",
    "sharpness": "sharpness at edges",
    "texture": "noise texture",
    "time": "change with time",
    "position": "pattern across the field",
    "energy": "change with tube voltage",
    "tails": "outlying pixels and codes",
}
_FINDING_TITLES = {
    FindingCode.STOPS: "Numbers are cut off early",
    FindingCode.SPECTRUM: "The flats fit no spectrum",
}


def axis_text(axis: str) -> str:
    """An axis of the gap in words."""
    return _AXIS_WORDS.get(axis, axis)


def _percent(value: tuple[float, float, float]) -> str:
    return f"{100 * value[0]:.0f} % ({100 * value[1]:.0f} to {100 * value[2]:.0f})"


def strength_text(cause: Cause) -> str:
    """Strength with its 95 % interval and unit."""
    value, low, high = cause.strength
    digits = min(max(0, 2 - math.floor(math.log10(max(abs(value), 1e-9)))), 4)
    return f"{value:.{digits}f} {cause.unit} ({low:.{digits}f} to {high:.{digits}f})"


def location_text(location: str) -> str:
    """Where within a series, in words; what effects would do is called by their titles."""
    if not location.startswith(_SHAPED_LIKE):
        return location
    return f"in the shape of: {title_of(location.removeprefix(_SHAPED_LIKE).split(' ')[0])}"


def _place_text(place: Place) -> str:
    where = location_text(place.location)
    what = f"{place.statistic}, {where}" if where else place.statistic
    return f"{axis_text(place.axis)} of {place.series} ({what}, z {place.z:+.1f})"


def _family_text(axis: str, kind: str, scene: str) -> str:
    """One axis of a kind of series, or of those of a scene."""
    return f"{axis_text(axis)} of {scene or _KIND_WORDS.get(kind, kind)}"


def _signature_text(diagnosis: Diagnosis) -> str:
    """Where an effect outside the catalogue is seen most, and its largest departures, one a kind of series and axis."""
    series = {view.session.name: view.session.series for view in diagnosis.compared.views}
    largest: dict[str, float] = {}
    for place in diagnosis.where:
        # objects of all scenes together: a signature is not one product's
        kind = series[place.series].kind if place.series in series else ""
        family = _family_text(place.axis, kind, "" if kind else place.series)
        if abs(place.z) > abs(largest.get(family, 0.0)):
            largest[family] = place.z
    text = ""
    axis, _, where = diagnosis.unknown_location.partition(" of ")
    if where:
        kind, _, scene = where.partition(" ")
        text = f" It is seen most in the {_family_text(axis, kind, scene)}."
    if largest:
        shown = sorted(largest.items(), key=lambda item: -abs(item[1]))[:_NAMED_FAMILIES]
        text += f" Its signature: {'; '.join(f'{family} (z {z:+.0f})' for family, z in shown)}."
    return text


def _where_text(places: Sequence[Place]) -> str:
    if not places:
        return "No single probe stands out beyond noise and what calibration leaves open; it shows in many together."
    axes = list(dict.fromkeys(axis_text(place.axis) for place in places[:12]))
    return f"The gap shows in {', '.join(axes[:3])}; most clearly in the {_place_text(places[0])}."


def compared_text(diagnosis: Diagnosis) -> str:
    """What was compared, what was left out, and what these series could not show."""
    kinds: dict[str, int] = {}
    for view in diagnosis.compared.views:
        kinds[view.session.series.kind] = kinds.get(view.session.series.kind, 0) + 1
    told = ", ".join(f"{number} of kind {kind}" for kind, number in kinds.items())
    text = f"{sum(kinds.values())} series were compared ({told})"
    if diagnosis.warnings:
        text += f", {len(diagnosis.warnings)} could not be used"
    if diagnosis.not_tested:
        names = [title_of(effect) for effect in diagnosis.not_tested]
        shown = ", ".join(names[:_NAMED_UNTESTED]) + (" and others" if len(names) > _NAMED_UNTESTED else "")
        text += f"; {len(names)} of the catalogue's {len(EFFECTS)} effects would not show in them: {shown}"
    return text + "."


def strained_text(diagnosis: Diagnosis) -> str:
    """Nuisances that the frames pull far from what is known of them; empty without any."""
    if not diagnosis.strained:
        return ""
    shown = ", ".join(f"{name} ({value:+.0f} sd)" for name, value in diagnosis.strained[:_NAMED])
    more = len(diagnosis.strained) - _NAMED
    shown += f" and {more} more" if more > 0 else ""
    return (
        f"Far from what is known of it: {shown}. A wrong map, label or position looks like that, and so may an effect that is not in"
        " the catalogue."
    )


def paragraph(diagnosis: Diagnosis) -> str:
    """Verdict, where, which, how far; findings come first, what the session could not show comes last."""
    text = verdict_text(diagnosis)
    if diagnosis.findings:
        lines = [item.line for item in diagnosis.findings]
        shown = "; ".join(lines[:_NAMED])
        more = f"; and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
        text = f"{findings_title(diagnosis)}: {shown}{more}. All else is of the other series. {text}"
    if diagnosis.not_tested or diagnosis.warnings:
        text += f" {compared_text(diagnosis)}"
    if diagnosis.strained and diagnosis.verdict not in EXPLAINED:
        text += f" {strained_text(diagnosis)}"
    for note in diagnosis.notes:
        text += f" {note[0].upper()}{note[1:]}."
    return text


def verdict_text(diagnosis: Diagnosis) -> str:
    """Where, which and how far, without what the session could not show."""
    gap = diagnosis.gap
    figures = f"On data the fit did not see the gap is {gap.before:.2f} (1 is noise)"
    if diagnosis.no_gap_but_findings:
        return (
            f"The other series agree with the twin (probability {diagnosis.probability_no_gap:.2f} that nothing is missing in"
            f" them). {figures}."
        )
    if diagnosis.verdict == "no_gap":
        return (
            f"The session agrees with its twin (probability {diagnosis.probability_no_gap:.2f} that nothing is missing). "
            f"{figures}."
        )
    where = _where_text(diagnosis.where)
    if diagnosis.verdict == "unknown_effect":
        return (
            f"{where} No effect of the catalogue, and no pair of them, explains it (probability"
            f" {diagnosis.probability_unknown:.2f} of an effect that is not in the catalogue).{_signature_text(diagnosis)}"
            f" {figures}."
        )
    if diagnosis.verdict == "ambiguous":
        named = ", ".join(f"{title} ({probability:.2f})" for title, probability in rivals(diagnosis))
        text = f"{where} These data cannot distinguish between {named}. {figures}."
        if diagnosis.next_measurement:
            text += f" To distinguish them: {diagnosis.next_measurement['text']}."
        return text
    named = "; ".join(
        f"{title_of(cause.effect)}, {strength_text(cause)}, probability {cause.probability:.2f}"
        for cause in diagnosis.leading
    )
    share = None if gap.shrinks_by is None else gap.shrinks_by[0]
    if gap.at_floor:
        found = "Observed there"
    elif gap.falls and (share is None or share > _MOSTLY):
        found = "It is explained by"
    else:
        found = "Of the catalogue it is most like"
    text = f"{where} {found}: {named}. {figures}{',' if gap.at_floor else ' and'} {fall_text(gap)} once that is added"
    if gap.falls and gap.shrinks_by is not None:
        value, low, high = (min(one, 1.0) for one in gap.shrinks_by)
        text += f", by {_percent((value, low, high))} of what is above noise"
    return f"{text}.{no_better_text(gap)}{rest_text(diagnosis)}"


def findings_title(diagnosis: Diagnosis) -> str:
    """What is wrong with series that contradict themselves or each other, in a few words."""
    return _FINDING_TITLES.get(diagnosis.findings[0].code, "Labels look wrong")


def rivals(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    """Explanations that are not out of the question, in words, and their probabilities, most probable first."""
    likely = [item for item in diagnosis.hypotheses if item.probability >= _LEAST_LIKELY]
    return [(" with ".join(map(title_of, item.effects)) or "no effect", item.probability) for item in likely[:_RIVALS]]


def fall_text(gap: Gap) -> str:
    """What becomes of the gap once what was found is added: a verb and the figure."""
    if gap.at_floor:
        return f"over all probes at its floor of {gap.floor:.2f} already, and {gap.after:.2f}"
    return f"falls to {gap.after:.2f}" if gap.falls else f"does not fall ({gap.after:.2f})"


def no_better_text(gap: Gap) -> str:
    """That the improved twin is none, where the gap does not fall; empty elsewhere."""
    if gap.falls or gap.at_floor:
        return ""
    grown = ""
    if gap.shrinks_by is not None:
        value, low, high = gap.shrinks_by
        grown = f" What is above noise grows by {_percent((-value, -high, -low))}."
    return f"{grown} The twin with it added is no better than the twin without."


def share_text(share: tuple[float, float, float] | None) -> str:
    """Share of the gap that an effect removes, in words where it removes none; empty where there was no gap to remove."""
    if share is None:
        return ""
    value = 100.0 * min(share[0], 1.0)
    return f"{value:.0f} %" if value >= 0.0 else f"grows by {-value:.0f} %"


def rest_text(diagnosis: Diagnosis) -> str:
    """By how much laws of what is named are off here, and where they leave most; empty where they fit."""
    if diagnosis.verdict != "explained_in_part":
        return ""
    leading = diagnosis.leading
    off = [f"{title_of(cause.effect)} by some {100.0 * cause.level:.0f} %" for cause in leading if cause.level > 0.0]
    told = f"; these laws seem to be off here: {', '.join(off)}" if off else ""
    left = leading[0].left if leading else ()
    place = f", most in the {_place_text(left[0])}" if left else ""
    return f" The law leaves a misfit that is no noise{place}{told}."
