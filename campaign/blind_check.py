"""Sealed cases: labels drawn and hashed, sessions measured and diagnosed, answers closed, labels opened.

Order of events. (1) Labels are drawn from the seed; a random salt is drawn once; the SHA-256 of both is written to
`seal.json`. Labels themselves are nowhere on disk. (2) Each case is measured into a folder of its own under a name that
says nothing, and another process that gets that file alone diagnoses it (blind_judge). (3) When every answer is in, the
answers are hashed (`answers.json`). (4) Only then are the labels written (`labels.json`) and checked against the seal.

A run that was killed goes on where it stopped: the salt is kept in a private folder until the labels are opened, and
options that differ from the first run's are refused.
"""

import contextlib
import json
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, RaytwinError
from ..files import only_one, sha256_of_file, whole_file
from ._children import THREAD_VARIABLES, ChildError, Children, KilledError, StoppedError
from ._plain import canonical, digest
from .blind_cases import BlindCase, draw_cases, is_development_seed, names_of_sets, seal_of, sealed_text
from .blind_code import check_frozen_code, code_digest, freeze_code, same_code

CASE_TIMEOUT_S = 3600.0
_ERROR_LINES = 400  # characters of an error that are kept
_SECOND = "second.h5"
_KEPT_VARIABLES = ("PATH", "HOME", "LANG", "LC_ALL", "PYTHONPATH", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "SYSTEMROOT")


@dataclass(frozen=True, slots=True, kw_only=True)
class BlindOptions:
    """What decides the cases and their answers.

    Fields: cases; seed; size (rows and columns); frames a series (None: usual); without: effects left out of the catalogue
    for all; leave_one_out: every case has one effect, which is left out for it; only: sets or ids that effects are drawn
    from (empty: all); train_cases: how many more to teach the baselines; second_day: the line is measured on another day too, to see
    how far the improved twin shrinks the gap there.
    """

    cases: int
    seed: int
    size: int = 128
    frames: int | None = None
    without: tuple[str, ...] = ()
    leave_one_out: bool = False
    only: tuple[str, ...] = ()
    train_cases: int = 0
    second_day: bool = False

    def __post_init__(self) -> None:
        from ..generator.effects import EFFECTS

        for name, value, low in (
            ("-n", self.cases, 1),
            ("--seed", self.seed, 0),
            ("--train-cases", self.train_cases, 0),
        ):
            if value < low:
                raise InputError(name, received=value, expected=f"a whole number of {low} or more")
        if not 48 <= self.size <= 4096:
            raise InputError("--size", received=self.size, expected="48 to 4096 pixels")
        if self.frames is not None and self.frames < 4:
            raise InputError("--frames", received=self.frames, expected="4 or more")
        for name in self.without:
            if name not in EFFECTS:
                raise InputError("--without", received=name, expected="one of " + ", ".join(EFFECTS))
        names_of_sets(self.only)

    def draw(self) -> tuple[BlindCase, ...]:
        """All cases, those that are judged first, then those that teach."""
        names = names_of_sets(self.only) or None
        judged = draw_cases(seed=self.seed, stream="case", count=self.cases, names=names, singles=self.leave_one_out)
        return judged + draw_cases(seed=self.seed, stream="train", count=self.train_cases, names=names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What is done with one case: `measure(label, session)` writes a file, `judge(session, without, features_only)` reads it.

    The second gets nothing of the label. It returns what blind_judge writes and leaves `statistics.npz` (or nothing) beside
    the session. `measure_again` writes a session of another day, `second.h5` beside the first. `stop` ends what runs.
    """

    measure: Callable[[Mapping[str, Any], Path], None]
    judge: Callable[[Path, Sequence[str], bool], dict[str, Any]]
    measure_again: Callable[[Mapping[str, Any], Path], None] = lambda label, session: None
    stop: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedCheck:
    """Labels and answers, case by case. Fields: seal; options; labels; answers; folder; versions (of the code that answered)."""

    seal: str
    options: BlindOptions
    labels: tuple[dict[str, Any], ...]
    answers: tuple[dict[str, Any], ...]
    folder: Path
    versions: tuple[str, ...]


class Processes:
    """Measuring and diagnosing in processes of their own; `stop` ends those that run."""

    def __init__(self, options: BlindOptions, *, code: Path | None = None) -> None:
        """`code`: folder of the frozen package (None: as it is installed)."""
        self._options = options
        self._code = code
        self._children = Children()

    def work(self) -> Work:
        """These processes as a worker's steps."""
        return Work(measure=self.measure, judge=self.judge, measure_again=self.measure_again, stop=self.stop)

    def measure(self, label: Mapping[str, Any], session: Path) -> None:
        """Measure a case. Raises RuntimeError with the process' last line when it fails."""
        self._measure(label, session, day=0)

    def measure_again(self, label: Mapping[str, Any], session: Path) -> None:
        """Measure a case on another day."""
        self._measure(label, session, day=1)

    def _measure(self, label: Mapping[str, Any], session: Path, *, day: int) -> None:
        task = {
            "label": label,
            "path": str(session),
            "size": self._options.size,
            "frames": self._options.frames,
            "session": day,
        }
        self._run("blind_measure", [], folder=session.parent, given=json.dumps(task))

    def judge(self, session: Path, without: Sequence[str], features_only: bool) -> dict[str, Any]:
        """Diagnose a session. Raises RuntimeError with the process' last line when it fails."""
        words = [session.name, *(word for name in without for word in ("--without", name))]
        if features_only:
            words.append("--features-only")
        if (session.parent / _SECOND).exists():
            words += ["--second", _SECOND]
        self._run("blind_judge", words, folder=session.parent, given="")
        result: dict[str, Any] = json.loads((session.parent / "answer.json").read_text(encoding="utf-8"))
        return result

    def stop(self) -> None:
        """End every process that runs; later ones are not started."""
        self._children.stop()

    def _run(self, module: str, words: Sequence[str], *, folder: Path, given: str) -> None:
        environment = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
        environment |= dict.fromkeys(THREAD_VARIABLES, "1") | {"TMPDIR": str(folder)}
        if self._code is not None:
            environment["PYTHONPATH"] = os.pathsep.join(
                filter(None, (str(self._code), environment.get("PYTHONPATH", "")))
            )

        def once() -> None:
            self._children.run(
                module, words, given=given, environment=environment, folder=folder, timeout_s=CASE_TIMEOUT_S
            )

        try:
            try:
                once()
            except KilledError:
                # somebody else's doing, such as a machine short of memory: what the case holds plays no part in it
                once()
        except ChildError as error:
            raise RuntimeError(f"{module}: {error}") from None


def begin_check(folder: Path, options: BlindOptions, *, development: bool = False) -> tuple[str, tuple[BlindCase, ...]]:
    """Draw and seal the labels, or find the seal of a run that was stopped.

    Args:
        folder: of the check; made where it does not exist.
        options: of the check.
        development: a seed that was used while developing is allowed.

    Returns:
        The seal (64 hexadecimal digits) and the cases.

    Raises:
        InputError: the folder holds something else or a check with other options; a development seed.
    """
    if is_development_seed(options.seed) and not development:
        raise InputError(
            "--seed",
            received=options.seed,
            expected="a seed that was not used while the diagnosis was developed (docs/notebook/development_seeds.md)",
            remedy="take another, or say --development; the report then says that it proves nothing",
        )
    if folder.exists() and not folder.is_dir():
        raise InputError("-o", received=f"{folder}, a file", expected="a folder, which may not exist yet")
    cases = options.draw()
    seal_path = folder / "seal.json"
    if not seal_path.exists():
        if folder.exists() and any(path.name != ".private" for path in folder.iterdir()):
            raise InputError(
                "-o", received=f"{folder}, with other files", expected="an empty folder or a check begun before"
            )
        private = folder / ".private"
        private.mkdir(parents=True, exist_ok=True)
        private.chmod(0o700)
        # the seed stands nowhere in the folder before the labels are opened
        salt = secrets.token_hex(32)
        with whole_file(private / "salt") as temporary:
            temporary.write_text(salt, encoding="ascii")
        seal = seal_of(cases, salt)
        page = {
            "format": "raytwin-blind-check",
            "version": 1,
            "sha256": seal,
            "of": "canonical JSON of {labels, salt}: keys sorted, no blanks",
            "options_sha256": _options_digest(options, salt),
            "cases": options.cases,
            "train_cases": options.train_cases,
            "code_sha256": code_digest(),
            "sealed_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
        _write_json(seal_path, page)
        return seal, cases
    page = _read_json(seal_path, "sha256", "code_sha256")
    salt = _salt(folder)
    if page.get("options_sha256") != _options_digest(options, salt):
        raise InputError(
            "-o",
            received=f"{folder}, a check with other options",
            expected="the options that it was begun with",
            remedy="repeat them, or take another folder",
        )
    if page["sha256"] != seal_of(cases, salt):
        raise InputError(
            "-o",
            received=f"{folder}, sealed with other labels",
            expected="labels that this version draws from the seed",
            remedy="go on with the version that began the check",
        )
    return str(page["sha256"]), cases


@contextlib.contextmanager
def frozen_code(folder: Path) -> Iterator[Path]:
    """The code of a check, copied when it begins and kept over stops until its answers are all in.

    Raises:
        InputError: the copy is gone and the code has changed since.
        RaytwinError: the code cannot be imported.
    """
    note = folder / ".private" / "code"
    expected = str(_read_json(folder / "seal.json")["code_sha256"])
    if note.exists():
        kept = Path(note.read_text(encoding="utf-8"))
        if (kept / "raytwin").is_dir() and code_digest(kept / "raytwin") == expected:
            check_frozen_code(kept)
            yield kept
            _drop_code(kept, note, folder)
            return
    if not any((folder / "answers").glob("*.json")):
        # nothing was answered yet: a check that could not start may start with code that was mended
        expected = code_digest()
        _write_json(folder / "seal.json", _read_json(folder / "seal.json") | {"code_sha256": expected})
    same_code(expected, folder)
    place = freeze_code(Path(tempfile.mkdtemp(prefix="raytwin-code-")))
    try:
        if code_digest(place / "raytwin") != expected:
            raise RaytwinError("the code was changed while it was copied; try again")
        check_frozen_code(place)
    except RaytwinError:
        shutil.rmtree(place, ignore_errors=True)
        raise
    if note.parent.exists():
        with whole_file(note) as temporary:
            temporary.write_text(str(place), encoding="utf-8")
    yield place
    _drop_code(place, note, folder)


def _drop_code(place: Path, note: Path, folder: Path) -> None:
    """Remove the copy; not reached after a stop, so that the run can go on with it."""
    if place.name.startswith("raytwin-code-") and (folder / "answers").exists():
        shutil.rmtree(place, ignore_errors=True)
        note.unlink(missing_ok=True)


def run_check(
    folder: Path,
    options: BlindOptions,
    cases: Sequence[BlindCase],
    work: Work,
    *,
    workers: int = 1,
    keep_sessions: bool = False,
    begin: Callable[[int], None] = lambda count: None,
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Measure and diagnose every case that has no answer yet; answers lie in `answers/` one by one.

    Args:
        folder: where `begin_check` sealed the labels.
        options: of the check.
        cases: as drawn.
        work: the two steps of a case.
        workers: cases at once.
        keep_sessions: acquisition files stay in `sessions/`.
        begin: called with the number of cases left.
        advance: called after each case.
    """
    answers = folder / "answers"
    answers.mkdir(exist_ok=True)
    with only_one(folder, "a check"), _workplace(folder) as place:
        left = unanswered(folder, cases)
        begin(len(left))
        if (folder / "answers.json").exists() and left:
            raise InputError(
                str(folder / "answers.json"),
                received=f"answers closed, {len(left)} of them gone",
                expected="all the answers that were closed",
                remedy="a check that was opened cannot be diagnosed again; take another folder",
            )

        def one(case: BlindCase) -> None:
            _run_case(folder, case, work, options, place=place, keep_session=keep_sessions)

        with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
            waiting = {pool.submit(one, case) for case in left}
            try:
                while waiting:
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    for future in done:
                        future.result()
                        advance()
            except BaseException:
                for future in waiting:
                    future.cancel()
                work.stop()
                raise


def open_check(folder: Path, options: BlindOptions, cases: Sequence[BlindCase]) -> OpenedCheck:
    """Close the answers, open the labels, and check both against their hashes.

    Raises:
        InputError: an answer is missing, or was changed after the labels were opened, or the seal does not fit.
    """
    missing = unanswered(folder, cases)
    if missing:
        raise InputError(
            str(folder), received=f"{len(missing)} cases without an answer", expected="an answer to every case"
        )
    hashes = _hashes_of_answers(folder, cases)
    closed = folder / "answers.json"
    if not closed.exists():
        _write_json(closed, {"sha256": digest(hashes), "answers": hashes})
    kept = _read_json(closed, "answers")["answers"]
    touched = [name for name in {**hashes, **kept} if kept.get(name) != hashes.get(name)]
    if not any(name.endswith(".npz") for name in kept):
        # checks of earlier versions closed the answers without the inner products beside them
        touched = [name for name in touched if not name.endswith(".npz")]
    if touched:
        raise InputError(
            str(folder / "answers"),
            received=f"{', '.join(touched[:3])}{' ...' if len(touched) > 3 else ''}: not those that were closed before the"
            " labels were opened",
            expected="untouched answers",
            remedy="run the check again in another folder",
        )
    salt = _salt(folder)
    seal = str(_read_json(folder / "seal.json", "sha256")["sha256"])
    if seal_of(cases, salt) != seal:
        raise InputError(
            str(folder / "seal.json"), received=seal, expected="the hash of the labels that the seed draws"
        )
    labels = folder / "labels.json"
    if not labels.exists():
        with whole_file(labels) as temporary:
            temporary.write_bytes(sealed_text(cases, salt))
    elif sha256_of_file(labels) != seal:
        raise InputError(
            str(labels),
            received=f"text that hashes to {sha256_of_file(labels)[:12]}",
            expected=f"the labels that were sealed, {seal[:12]}",
            remedy="put the file back as it was written",
        )
    shutil.rmtree(folder / ".private", ignore_errors=True)
    answers = tuple(_read_json(answer_path(folder, case)) for case in cases)
    versions = sorted({str(item["code_sha256"]) for item in answers if item.get("code_sha256")})
    return OpenedCheck(
        seal=seal,
        options=options,
        labels=tuple(case.label() for case in cases),
        answers=answers,
        folder=folder,
        versions=tuple(versions),
    )


def _hashes_of_answers(folder: Path, cases: Sequence[BlindCase]) -> dict[str, str]:
    """SHA-256 of every answer, and of the inner products beside it where there are any, by file name."""
    pairs = ((answer_path(folder, case), statistics_path(folder, case.stream, case.index)) for case in cases)
    files = [path for pair in pairs for path in pair if path.exists()]
    return {path.name: sha256_of_file(path) for path in files}


def unanswered(folder: Path, cases: Sequence[BlindCase]) -> list[BlindCase]:
    """The cases that have no answer yet."""
    return [case for case in cases if not answer_path(folder, case).exists()]


def answer_path(folder: Path, case: BlindCase) -> Path:
    """Where the answer to a case lies."""
    return folder / "answers" / f"{case.stream}_{case.index:05d}.json"


def statistics_path(folder: Path, stream: str, index: int) -> Path:
    """Where the inner products of a case's session lie, if it has any."""
    return folder / "answers" / f"{stream}_{index:05d}.npz"


def withheld(case: BlindCase, options: BlindOptions) -> tuple[str, ...]:
    """Effects that the diagnosis of a case may not name."""
    own = tuple(item.id for item in case.case.requests) if options.leave_one_out and case.stream == "case" else ()
    return tuple(dict.fromkeys((*options.without, *own)))


def _run_case(
    folder: Path, case: BlindCase, work: Work, options: BlindOptions, *, place: Path, keep_session: bool
) -> None:
    # the name of the folder is drawn, so that it says nothing about the case
    own = Path(tempfile.mkdtemp(dir=place))
    session = own / "session.h5"
    try:
        result: dict[str, Any]
        begun = time.perf_counter()
        try:
            work.measure(case.label(), session)
            if options.second_day and case.stream == "case":
                work.measure_again(case.label(), own / _SECOND)
            measured_s = time.perf_counter() - begun
            result = work.judge(session, withheld(case, options), case.stream == "train")
            result |= {"error": "", "measured_s": measured_s, "acquisition_sha256": sha256_of_file(session)}
        except (StoppedError, KeyboardInterrupt, SystemExit):
            raise
        except Exception as error:
            result = {"error": " ".join(str(error).split())[:_ERROR_LINES] or type(error).__name__}
        if keep_session and session.exists():
            (folder / "sessions").mkdir(exist_ok=True)
            shutil.move(session, folder / "sessions" / f"{case.stream}_{case.index:05d}.h5")
        statistics = own / "statistics.npz"
        if statistics.exists():
            with whole_file(statistics_path(folder, case.stream, case.index)) as temporary:
                shutil.copyfile(statistics, temporary)
        # last: a case is done when its answer is there
        _write_json(answer_path(folder, case), result)
    finally:
        shutil.rmtree(own, ignore_errors=True)


@contextlib.contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """A folder outside the check's own for sessions; what a killed run left there is removed first."""
    private = folder / ".private"
    note = private / "workplace"
    if note.exists():
        old = Path(note.read_text(encoding="utf-8"))
        if old.name.startswith("raytwin-blind-"):
            shutil.rmtree(old, ignore_errors=True)
    place = Path(tempfile.mkdtemp(prefix="raytwin-blind-"))
    if private.exists():
        with whole_file(note) as temporary:
            temporary.write_text(str(place), encoding="utf-8")
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _salt(folder: Path) -> str:
    private = folder / ".private" / "salt"
    if private.exists():
        return private.read_text(encoding="ascii")
    labels = folder / "labels.json"
    if labels.exists():
        return str(_read_json(labels, "salt")["salt"])
    raise InputError(
        str(folder),
        received="a seal without its salt",
        expected="a check as it was left: its hidden folder .private while it runs, labels.json afterwards",
        remedy="begin again in another folder",
    )


def _options_digest(options: BlindOptions, salt: str) -> str:
    return digest({"salt": salt, "options": asdict(options)})


def _read_json(path: Path, *words: str) -> dict[str, Any]:
    """The JSON object of a file, which has these words."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        value = None
    missing = [word for word in words if not isinstance(value, dict) or word not in value]
    if not isinstance(value, dict) or missing:
        raise InputError(
            str(path),
            received=f"no {missing[0]} in it" if isinstance(value, dict) else "no JSON object",
            expected="what a blind check wrote",
            remedy="put the file back as it was written, or begin again in another folder",
        )
    return value


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    with whole_file(path) as temporary:
        temporary.write_bytes(canonical(value))
