"""The diagnosis in plain words: a headline, a table of causes, and a sentence for each thing that is to be said."""

from collections import Counter
from collections.abc import Sequence

from ...checks.findings import FindingCode
from ...generator.effects import EFFECTS
from ...results import Table
from ..inference.inference import UNKNOWN, title_of
from ..judgement.answer import EXPLAINED, Cause, Diagnosis, Place
from ..judgement.held_out import Gap
from .words import axis_text, family_text, meaning_text, nuisance_text, place_text, share_text, strength_text, when_text

# so many of a kind fit into a sentence
_NAMED = 3
_NAMED_UNTESTED = 8  # names alone are shorter
_NAMED_FAMILIES = 4
_RIVALS, _LEAST_LIKELY = 5, 0.05  # explanations that are named where none leads
_UNTESTED = "It shows in series that no others tell the strength of, so that no held-out data could test it."
_WIDE = 160  # characters of a line: titles and strengths of the longest units fit
_FINDING_TITLES = {
    FindingCode.STOPS: "Numbers are cut off early",
    FindingCode.SPECTRUM: "The flats fit no spectrum",
}


def _likely(cause: Cause) -> str:
    return f"{title_of(cause.effect)}, {strength_text(cause)}, probability {cause.probability:.2f}"


def _percent(value: tuple[float, float, float]) -> str:
    return f"{100 * value[0]:.0f} % ({100 * value[1]:.0f} to {100 * value[2]:.0f})"


def _signature(diagnosis: Diagnosis) -> list[str]:
    """Where an effect outside the catalogue is seen most, and its largest departures, one a kind of series and axis."""
    series = {view.session.name: view.session.series for view in diagnosis.compared.views}
    largest: dict[str, float] = {}
    for place in diagnosis.where:
        # objects of all scenes together: a signature is not one product's
        kind = series[place.series].kind if place.series in series else ""
        family = family_text(place.axis, kind, "" if kind else place.series)
        if abs(place.z) > abs(largest.get(family, 0.0)):
            largest[family] = place.z
    told = []
    axis, _, where = diagnosis.unknown_location.partition(" of ")
    if where:
        kind, _, scene = where.partition(" ")
        told.append(f"It is seen most in the {family_text(axis, kind, scene)}.")
    if largest:
        shown = sorted(largest.items(), key=lambda item: -abs(item[1]))[:_NAMED_FAMILIES]
        told.append(f"Its signature: {'; '.join(f'{family} (z {z:+.0f})' for family, z in shown)}.")
    return told


def _where(places: Sequence[Place]) -> list[str]:
    if not places:
        return ["No single probe stands out beyond noise and what calibration leaves open; it shows in many together."]
    axes = list(dict.fromkeys(axis_text(place.axis) for place in places[:12]))[:3]
    listed = ", ".join(axes[:-1]) + (" and " if axes[:-1] else "") + axes[-1]
    return [f"The gap shows in {listed}.", f"It is clearest in the {place_text(places[0])}."]


def compared_text(diagnosis: Diagnosis) -> str:
    """What was compared, what was left out, and what these series could not show."""
    kinds = Counter(view.session.series.kind for view in diagnosis.compared.views)
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
    """Nuisances that the frames pull far from what is known of them, the farthest of a kind each; empty without any."""
    farthest: dict[str, float] = {}
    for name, value in diagnosis.strained:
        farthest.setdefault(nuisance_text(name), value)
    if not farthest:
        return ""
    shown = ", ".join(f"{name} ({value:+.0f} sd)" for name, value in list(farthest.items())[:_NAMED])
    more = len(farthest) - _NAMED
    shown += f" and {more} more" if more > 0 else ""
    return (
        f"Far from what is known of it: {shown}. A wrong map, label or position looks like that, and so may an effect that is not in"
        " the catalogue."
    )


def answer_text(diagnosis: Diagnosis) -> str:
    """What `raytwin diagnose` prints: the headline, where, the causes as a table, and what else is to be said, a sentence a line."""
    lines = [headline(diagnosis)]
    if diagnosis.findings:
        lines += [*(item.line for item in diagnosis.findings), "All else is of the other series."]
    if _explained(diagnosis):
        lines += _where(diagnosis.where)
        lines += [_causes(diagnosis).as_text(widest=_WIDE), *_meanings(diagnosis)]
        lines += [*_less_likely(diagnosis), *_fall(diagnosis)]
    else:
        lines += _not_explained(diagnosis)
    if diagnosis.not_tested or diagnosis.warnings:
        lines.append(compared_text(diagnosis))
    if diagnosis.strained and diagnosis.verdict not in EXPLAINED:
        lines.append(strained_text(diagnosis))
    return "\n".join([*lines, *(f"{_sentence(note)}." for note in diagnosis.notes)])


def verdict_text(diagnosis: Diagnosis) -> str:
    """Where, which and how far, without what the session could not show."""
    if not _explained(diagnosis):
        return " ".join(_not_explained(diagnosis))
    named = "; ".join(map(_likely, diagnosis.leading))
    return " ".join([*_where(diagnosis.where), f"{_relation(diagnosis.gap)}: {named}.", *_fall(diagnosis)])


def lead_text(diagnosis: Diagnosis) -> str:
    """Where the gap is observed and what becomes of it, in two to four sentences."""
    gap = diagnosis.gap
    if diagnosis.findings:
        names = {name for item in diagnosis.findings for name in item.names}
        one = len(diagnosis.findings) == 1
        found = diagnosis.findings[0].line if one else f"{len(names)} series contradict what they state"
        return f"{found}. All else is of the other series. {verdict_text(diagnosis)}"
    if not diagnosis.added or not diagnosis.where:
        return verdict_text(diagnosis)
    place = diagnosis.where[0]
    told = [f"The gap is clearest in the {axis_text(place.axis)} of {place.series}."]
    if not gap.tested:
        told.append(_UNTESTED)
    elif gap.at_floor:
        told.append(
            f"Over all probes of series that the fit did not use, the gap was no more than noise ({gap.floor:.2f}) already:"
            f" {gap.before:.2f}, and {gap.after:.2f} with what was found added to the twin."
        )
    else:
        ends = f"the gap on series that the fit did not use, {gap.before:.2f} (noise alone: {gap.floor:.2f}), {_falls(gap)}"
        told.append(f"With what was found added to the twin, {ends}.")
    return " ".join([*told, *([] if not gap.tested else _no_better(gap)), *_left(diagnosis)])


def headline(diagnosis: Diagnosis) -> str:
    """The answer in one line."""
    if diagnosis.no_gap_but_findings:
        return findings_title(diagnosis)
    found = _headline_of_verdict(diagnosis)
    if not diagnosis.findings:
        return found
    title = findings_title(diagnosis)
    # what makes labels look wrong may be that effect
    return f"{found}. {title}, too" if diagnosis.verdict == "unknown_effect" else f"{title}. The other series: {found}"


def _headline_of_verdict(diagnosis: Diagnosis) -> str:
    """What explains the series that were compared."""
    if diagnosis.verdict == "no_gap":
        return "No gap: the session agrees with its twin"
    if diagnosis.verdict == "unknown_effect":
        return "An effect that is not in the catalogue"
    if diagnosis.verdict == "ambiguous":
        names = [title for title, _ in rivals(diagnosis)[:3]]
        return _sentence(f"{' or '.join(names)}: these data cannot distinguish them")
    named = _sentence(" and ".join(f"{title_of(cause.effect)}, {strength_text(cause)}" for cause in diagnosis.leading))
    if diagnosis.gap.tested and not (diagnosis.gap.falls or diagnosis.gap.at_floor):
        return f"{named}: most like it, but the gap does not fall"
    if diagnosis.verdict == "explained":
        return named
    return f"{named}: {'its law leaves' if len(diagnosis.leading) == 1 else 'their laws leave'} a misfit"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _explained(diagnosis: Diagnosis) -> bool:
    """Whether effects are named."""
    return diagnosis.verdict in EXPLAINED and not diagnosis.no_gap_but_findings


def _causes(diagnosis: Diagnosis) -> Table:
    """The causes that are named."""
    rows = tuple(
        (
            title_of(cause.effect),
            f"{cause.probability:.2f}",
            strength_text(cause),
            f"in {len(cause.series)} series" if cause.series and not cause.apart else when_text(cause),
            (diagnosis.gap.tested and share_text(cause.shrinks_by)) or "-",
        )
        for cause in diagnosis.leading
    )
    header = ("effect", "probability", "strength (95 %)", "when", "removed")
    return Table(title=f"{_relation(diagnosis.gap)}:", header=header, rows=rows)


def _meanings(diagnosis: Diagnosis) -> list[str]:
    """What the strengths of what is named are, a sentence each."""
    told = [(title_of(cause.effect), meaning_text(cause.effect)) for cause in diagnosis.leading]
    return [f"Strength ({title}): {meaning}." for title, meaning in told if meaning]


def _relation(gap: Gap) -> str:
    """What effects that are named are to the gap."""
    if gap.at_floor or not gap.tested:
        return "Observed there"
    return "It is explained by" if gap.explained else "Of the catalogue it is most like"


def _figures(gap: Gap) -> str:
    return f"On data the fit did not see the gap is {gap.before:.2f} (noise alone: {gap.floor:.2f})"


def _not_explained(diagnosis: Diagnosis) -> list[str]:
    """What is found where no effect of the catalogue is named: a sentence each."""
    figures = f"{_figures(diagnosis.gap)}."
    if diagnosis.no_gap_but_findings or diagnosis.verdict == "no_gap":
        who, where = "The session agrees with its twin", ""
        if diagnosis.no_gap_but_findings:
            who, where = "The other series agree with the twin", " in them"
        return [f"{who} (probability {diagnosis.probability_no_gap:.2f} that nothing is missing{where}).", figures]
    if diagnosis.verdict == "unknown_effect":
        return [*_where(diagnosis.where), _unknown(diagnosis), *_signature(diagnosis), figures]
    named = ", ".join(f"{title} ({probability:.2f})" for title, probability in rivals(diagnosis))
    measure = diagnosis.next_measurement
    return [
        *_where(diagnosis.where),
        f"These data cannot distinguish between {named}.",
        figures,
        *([f"To distinguish them: {measure['text']}."] if measure else []),
    ]


def _unknown(diagnosis: Diagnosis) -> str:
    """How probable an effect outside the catalogue is, and what else is not out of the question."""
    unknown = f"probability {diagnosis.probability_unknown:.2f} of an effect that is not in the catalogue"
    others = [(title, probability) for title, probability in rivals(diagnosis) if title != title_of(UNKNOWN)]
    if not others:
        return f"No effect of the catalogue, and no pair of them, explains it ({unknown})."
    return f"The catalogue explains it less well ({unknown}): {', '.join(f'{title} ({p:.2f})' for title, p in others)}."


def _less_likely(diagnosis: Diagnosis) -> list[str]:
    """What else may be there, beside or instead of what is named, in one sentence."""
    others = [cause for cause in diagnosis.causes if cause not in diagnosis.leading]
    told = [_likely(cause) for cause in others if cause.probability >= _LEAST_LIKELY]
    if diagnosis.probability_unknown >= _LEAST_LIKELY:
        told.append(f"{title_of(UNKNOWN)}, probability {diagnosis.probability_unknown:.2f}")
    return [f"Less likely, but not out of the question: {'; '.join(told)}."] if told else []


def _fall(diagnosis: Diagnosis) -> list[str]:
    """What becomes of the gap once what is named is added, a sentence each."""
    gap = diagnosis.gap
    if not gap.tested:
        return [f"{_figures(gap)}.", _UNTESTED, *_left(diagnosis)]
    text = f"{_figures(gap)}{',' if gap.at_floor else ' and'} {_falls(gap)} once that is added"
    if gap.falls and gap.shrinks_by is not None:
        value, low, high = (min(one, 1.0) for one in gap.shrinks_by)
        text += f", by {_percent((value, low, high))} of what is above noise"
    return [f"{text}.", *_no_better(gap), *_left(diagnosis)]


def findings_title(diagnosis: Diagnosis) -> str:
    """What is wrong with series that contradict themselves or each other, in a few words."""
    return _FINDING_TITLES.get(diagnosis.findings[0].code, "Labels look wrong")


def rivals(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    """Explanations that are not out of the question, in words, and their probabilities, most probable first."""
    likely = [item for item in diagnosis.hypotheses if item.probability >= _LEAST_LIKELY]
    return [(" with ".join(map(title_of, item.effects)) or "no effect", item.probability) for item in likely[:_RIVALS]]


def _falls(gap: Gap) -> str:
    """What becomes of the gap once what was found is added: a verb and the figure."""
    if gap.at_floor:
        return f"over all probes no more than noise, and {gap.after:.2f}"
    return f"falls to {gap.after:.2f}" if gap.falls else f"does not fall ({gap.after:.2f})"


def _no_better(gap: Gap) -> list[str]:
    """That the improved twin is none, where the gap does not fall."""
    if gap.falls or gap.at_floor:
        return []
    told = []
    if gap.shrinks_by is not None:
        value, low, high = gap.shrinks_by
        told.append(f"What is above noise grows by {_percent((-value, -high, -low))}.")
    return [*told, "The twin with it added is no better than the twin without."]


def _left(diagnosis: Diagnosis) -> list[str]:
    """By how much laws of what is named are off here, and where they leave most; nothing where they fit."""
    if diagnosis.verdict != "explained_in_part":
        return []
    leading = diagnosis.leading
    off = [f"{title_of(cause.effect)} by some {100.0 * cause.level:.0f} %" for cause in leading if cause.level > 0.0]
    left = leading[0].left if leading else ()
    told = [f"The law leaves a misfit that is no noise{f', most in the {place_text(left[0])}' if left else ''}."]
    return [*told, *([f"These laws seem to be off here: {', '.join(off)}."] if off else [])]
