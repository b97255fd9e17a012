"""Where the gap between a session and its twin lies, which effect explains it, and how far it shrinks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from ..acquisition.acquisition_io import AcquisitionFile
from ..errors import InputError
from ..generator.line.twin import Twin
from .checks.preparation import calibrated_twin, mislabelled, prepare_session, suspects_left
from .checks.readings import Suspect
from .inference.inference import UNKNOWN, Hypothesis
from .judgement.answer import Diagnosis, in_pixels
from .judgement.judgement import judge
from .problem.assemble import problem_of
from .session.coarse import unseen_in_squares


def diagnose(
    acquisition: AcquisitionFile,
    *,
    twin: Twin | None = None,
    rng: np.random.Generator,
    without: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Diagnose a session.

    Args:
        acquisition: open acquisition file, anything from two flats with darks to the full protocol; frames of more than
            LARGEST_PIXELS are compared as means of squares of pixels.
        twin: calibrated elsewhere; absent, the session's own calibrating series make it. Effects that it has are part of what is
            expected: the gap is what they leave. One that the session shows at another strength is named with that strength.
        rng: source of randomness.
        without: effects to leave out of the catalogue.
        progress: called with the name of each stage.

    Raises:
        InputError: nothing in the session can be judged.
    """
    # thousands of small matrices: threads would wait for each other longer than they work
    with threadpool_limits(limits=1, user_api="blas"):
        return _diagnosed(acquisition, twin, rng, without, progress)


def _diagnosed(
    acquisition: AcquisitionFile,
    twin: Twin | None,
    rng: np.random.Generator,
    without: Sequence[str],
    progress: Callable[[str], None] | None,
) -> Diagnosis:
    session = prepare_session(acquisition, twin=twin, rng=rng, progress=progress)
    unseen = unseen_in_squares() if session.factor > 1 else {}
    try:
        problem = problem_of(session, session.twin, without=(*without, *unseen), progress=progress)
        result = judge(problem, session.twin, rng=rng, progress=progress)
    except InputError as error:
        if session.suspects:
            raise mislabelled(acquisition, session.suspects) from error
        raise
    result = replace(result, warnings=(*session.left_out, *result.warnings), notes=(*session.notes, *result.notes))
    suspects = session.suspects
    if suspects and result.added:
        suspects = suspects_left(session, problem.explained_by(result.added))
    if suspects:
        result = _doubted(result, session.twin, suspects)
    elif session.suspects:
        cleared = (f"{item.text}; what was found makes it look so" for item in session.suspects)
        result = replace(result, notes=(*result.notes, *cleared))
    if session.stops:
        result = _cut_off(result, session.stops)
    if session.factor == 1:
        return result
    if twin is None:
        if progress is not None:
            progress("calibration with all pixels")
        twin = calibrated_twin(session.all_pixels, rng=rng)
    return in_pixels(result, twin=twin, factor=session.factor)


def _cut_off(diagnosis: Diagnosis, stops: str) -> Diagnosis:
    """The diagnosis of a session whose numbers stop early in some series: something is missing, whatever the others say."""
    none = sum(item.probability for item in diagnosis.hypotheses if not item.effects)
    hypotheses = [
        replace(
            item,
            probability=item.probability + none
            if item.effects == (UNKNOWN,)
            else item.probability * bool(item.effects),
        )
        for item in diagnosis.hypotheses
    ]
    words = {"no_gap": "unknown_effect", "explained": "explained_in_part"}
    return replace(
        diagnosis,
        verdict=words.get(diagnosis.verdict, diagnosis.verdict),
        hypotheses=tuple(sorted(hypotheses, key=lambda item: -item.probability)),
        probability_no_gap=0.0,
        probability_unknown=diagnosis.probability_unknown + none,
        unknown_location="level of the saturated series"
        if diagnosis.verdict == "no_gap"
        else diagnosis.unknown_location,
        notes=(stops, *diagnosis.notes),
    )


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
