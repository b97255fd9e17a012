"""Where the gap between a session and its twin lies, which effect explains it, and how far it shrinks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..acquisition.acquisition_io import AcquisitionFile
from ..errors import InputError
from ..generator.line.twin import Twin
from .checks.preparation import PreparedSession, calibrated_twin, mislabelled, prepare_session
from .checks.readings import Suspect
from .inference.inference import UNKNOWN, Hypothesis, Priors
from .judgement.answer import EXPLAINED, Diagnosis, in_pixels
from .judgement.judgement import judge
from .judgement.sought_anew import is_to_be_asked, with_sought_anew
from .model.changes import catalogue_variants
from .problem.assemble import build_problem
from .problem.known_effects import already_there, lasting
from .problem.problem import Problem
from .session.coarse import unseen_in_squares


def diagnose(
    acquisition: AcquisitionFile,
    *,
    twin: Twin | None = None,
    rng: np.random.Generator,
    without: Sequence[str] = (),
    priors: Priors | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Diagnose a session.

    Args:
        acquisition: open acquisition file, anything from two flats with darks to the full protocol; frames of more than
            LARGEST_PIXELS are compared as means of squares of pixels.
        twin: calibrated elsewhere; absent, the session's own calibrating series make it. Effects that it has are part of what is
            expected: the gap is what they leave.
        rng: source of randomness.
        without: effects to leave out of the catalogue.
        priors: probabilities of the kinds of hypothesis before looking.
        progress: called with the name of each stage.

    Raises:
        InputError: nothing in the session can be judged.
    """
    session = prepare_session(acquisition, twin=twin, rng=rng, progress=progress)
    had = {} if twin is None else already_there(twin.effects)
    unseen = unseen_in_squares() if session.factor > 1 else {}

    def judged(with_effects: Twin, left_out: Sequence[str]) -> Diagnosis:
        problem = problem_of(session, with_effects, without=left_out, progress=progress)
        return judge(problem, with_effects, rng=rng, priors=priors, progress=progress)

    try:
        result = judged(session.twin, (*without, *had, *unseen))
    except InputError as error:
        if session.suspects:
            raise mislabelled(acquisition, session.suspects) from error
        raise
    if had and not session.suspects and is_to_be_asked(result, session.twin.effects):
        if progress is not None:
            progress("effects of the twin sought anew")
        rest = tuple(item for item in session.twin.effects if item not in lasting(session.twin.effects))
        anew = judged(replace(session.twin, effects=rest), (*without, *unseen))
        result = with_sought_anew(result, anew, session.twin.effects)
    result = replace(result, warnings=(*session.left_out, *result.warnings), notes=(*session.notes, *result.notes))
    still = {effect: why for effect, why in had.items() if effect not in result.named}
    result = replace(result, not_tested={**still, **result.not_tested})
    cleared = [item for item in session.suspects if _clears(result, item)]
    notes = tuple(
        f"{item.text}, or with {' and '.join(result.named)}, which explains the rest as well" for item in cleared
    )
    result = replace(result, notes=(*result.notes, *notes))
    suspects = tuple(item for item in session.suspects if item not in cleared)
    if suspects:
        result = _doubted(result, session.twin, suspects)
    if session.factor == 1:
        return result
    if twin is None:
        if progress is not None:
            progress("calibration with all pixels")
        twin = calibrated_twin(session.all_pixels, rng=rng)
    return in_pixels(result, twin=twin, factor=session.factor)


def problem_of(
    session: PreparedSession,
    twin: Twin,
    *,
    without: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Problem:
    """What inference is asked about a prepared session, with a twin and the catalogue less the effects `without`."""
    return build_problem(
        session.acquisition,
        twin,
        variants=catalogue_variants(without=without, side=session.factor),
        calibrated_elsewhere=session.calibrated_elsewhere,
        exposed=session.exposed,
        ends_at_zero=session.ends_at_zero,
        spectral_point=session.spectral_point,
        side=session.factor,
        progress=progress,
    )


def _clears(diagnosis: Diagnosis, suspect: Suspect) -> bool:
    """Whether an explanation of the whole session says why a label looks wrong."""
    return diagnosis.verdict in EXPLAINED and not set(suspect.or_effects).isdisjoint(diagnosis.named)


def _doubted(diagnosis: Diagnosis, twin: Twin, suspects: tuple[Suspect, ...]) -> Diagnosis:
    """The diagnosis of a session whose labels look wrong: no effect is named, whatever the frames would say under them."""
    known = {item.effects for item in diagnosis.hypotheses}
    hypotheses = [
        replace(item, probability=1.0 if item.effects == (UNKNOWN,) else 0.0) for item in diagnosis.hypotheses
    ]
    if (UNKNOWN,) not in known:
        hypotheses.append(Hypothesis(effects=(UNKNOWN,), probability=1.0, log_evidence=0.0))
    return replace(
        diagnosis,
        verdict="unknown_effect",
        hypotheses=tuple(sorted(hypotheses, key=lambda item: -item.probability)),
        causes=(),
        probability_no_gap=0.0,
        probability_unknown=1.0,
        unknown_location="labels of the series",
        gap=replace(diagnosis.gap, after=diagnosis.gap.before, shrinks_by=None),
        held_out=tuple((axis, before, before, floor) for axis, before, _, floor in diagnosis.held_out),
        ambiguous_with=(),
        next_measurement=None,
        twin=twin,
        added=(),
        named=(),
        warnings=(*(item.text for item in suspects), *diagnosis.warnings),
        mislabelled=suspects,
    )
