"""Where the gap between a session and its twin lies, which effect explains it, and how far it shrinks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from ..acquisition.acquisition_io import AcquisitionFile
from ..checks.findings import Finding
from ..errors import InputError
from ..generator.line.twin import Twin
from .judgement.answer import Diagnosis, in_pixels
from .judgement.judgement import judge
from .problem.assemble import problem_of
from .session.preparation import calibrated_twin, findings_left, mislabelled, prepare_session


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
        wrong: tuple[Finding, ...] = ()
        while True:
            session = prepare_session(acquisition, twin=twin, rng=rng, contradicted=wrong, progress=progress)
            left = session.findings
            try:
                problem = problem_of(session, without=(*without, *session.out_of_question), progress=progress)
                result = judge(problem, session.twin, rng=rng, progress=progress)
            except InputError as error:
                if not left and session.contradicted:
                    raise mislabelled(acquisition, session.contradicted) from error
                if not left:
                    raise
            else:
                if left and result.added:
                    left = findings_left(session, problem.explained_by(result.added))
                if not left:
                    break
            wrong = (*session.contradicted, *left)
        cleared = (f"{item.line}; what was found makes it look so" for item in session.findings)
        result = replace(
            _with_findings(result, (*session.contradicted, *session.other_findings)),
            warnings=(*session.left_out, *result.warnings),
            notes=(*session.notes, *result.notes, *cleared),
        )
        if session.factor == 1:
            return result
        if twin is None:
            if progress is not None:
                progress("calibration with all pixels")
            twin = calibrated_twin(session.all_pixels, rng=rng)
        return in_pixels(result, twin=twin, factor=session.factor)


def _with_findings(diagnosis: Diagnosis, findings: tuple[Finding, ...]) -> Diagnosis:
    """The diagnosis of a session in which some series contradict what they state: that the others have no gap is not all."""
    if not findings or diagnosis.verdict != "no_gap":
        return replace(diagnosis, findings=findings)
    place = ", ".join(findings[0].names)
    return replace(diagnosis, verdict="unknown_effect", unknown_location=place, findings=findings)
