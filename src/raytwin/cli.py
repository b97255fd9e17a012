"""`raytwin`, the one command. Each subcommand is a module of `raytwin.commands`, imported only when it is asked for."""

import argparse
import errno
import importlib
import os
import sys
import traceback
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from . import __version__
from ._log import kept_in, taken_out
from .errors import InputError, RaytwinError
from .files import check_not_read

# name -> (module in raytwin.commands, one line for `raytwin --help`)
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the main job end to end on the virtual lab"),
    "table": ("table", "the paper's table: a90 at each exposure, generated against measured"),
    "spectrum": ("spectrum", "tube spectrum behind filters"),
    "mu": ("mu", "effective attenuation of a material"),
    "check": ("check", "what measurements allow, what is suspicious, what to measure next"),
    "calibrate": ("calibrate", "measured flat and dark series -> calibrated twin"),
    "contrast": ("contrast", "contrast of a foreign object in a product, and maps of it"),
    "observe": ("observe", "POD and a90 at a setting from the twin alone, by a model observer"),
    "predict": ("predict", "flatfield at a setting, measured or not"),
    "validate": ("validate", "predictions against measured flats"),
    "generate": ("generate", "dual-energy images at a setting, from reference images"),
    "train": ("train", "segmentation networks on a dataset"),
    "detect": ("detect", "hit or miss of every network on every image"),
    "pod": ("pod", "probability-of-detection curve with a90 and its bounds"),
    "compare": ("compare", "are two POD curves the same?"),
    "plan": ("plan", "how many images and networks a POD study needs"),
    "sweep": ("sweep", "the chain over many settings, so that one is chosen by its a90"),
    "diagnose": ("diagnose", "where the sim-to-real gap lies, which effect causes it, how far it shrinks"),
    "blind-check": ("blind_check", "the diagnosis on sealed cases of the virtual lab"),
    "lab": ("lab", "a session measured in the virtual lab"),
    "import": ("import_", "other file layouts -> an acquisition or dataset file"),
    "explore": ("explore", "a page of settings in the browser: what changes with kV, filter, exposure, product"),
    "export": ("export", "a twin for other simulators, images for other trainers and viewers"),
    "report": ("report", "a twin, a dataset or a table of hits as one page"),
    "completion": ("completion", "completion of commands and options in bash, zsh or tcsh"),
    "info": ("info", "what is installed; or a twin in a table"),
}

# what `raytwin` alone prints: the way from a first try to an answer
_WAY = """raytwin: a calibrated digital twin of an X-ray inspection line.

  raytwin demo                          the main job end to end on the virtual lab, in minutes

With measurements of your own:
  raytwin check FOLDER                            what they allow, what looks wrong, what is missing
  raytwin import images FOLDER -o session.h5      your files -> an acquisition file
  raytwin calibrate session.h5 -o twin.h5         darks and flats -> the twin
  raytwin info twin.h5                            the twin in a table
  raytwin predict twin.h5 --kv 60 --power-w 30 --exposure-ms 20
  raytwin explore twin.h5                         all of it on a page in the browser
  raytwin diagnose session.h5 -o diagnosis        where and why measured and simulated differ

Before any measurement:
  raytwin spectrum --kv 60 --filter Al:2.5
  raytwin contrast --product water:30 --object Al:0.5 --low SETTING --high SETTING

`raytwin --help` lists all commands, `raytwin COMMAND --help` one of them; `import raytwin` has the same in Python.
"""


# commands that read HDF5 files of others: the library itself may die at damaged ones
READING = frozenset(
    {
        "check",
        "calibrate",
        "validate",
        "diagnose",
        "import",
        "predict",
        "generate",
        "contrast",
        "observe",
        "detect",
        "explore",
        "export",
        "report",
    }
)


# arguments of commands that name files to write
WRITTEN = frozenset({"output", "out", "export", "plot", "report", "save"})


# what the system may refuse, and what to do about it
_REMEDY_OF_SYSTEM = {
    errno.EACCES: "expected a file or folder that you may read and write; change its permissions or give another",
    errno.EPERM: "expected a file or folder that you may read and write; change its permissions or give another",
    errno.EROFS: "expected a place that can be written; give another",
    errno.ENOSPC: "expected room on the disk; delete something or give another place",
    errno.EDQUOT: "expected room within your quota; delete something or give another place",
}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a number, without its unit") from None


def _whole_number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number") from None


class _Parser(argparse.ArgumentParser):
    """Bad usage is one clear line and exit code 2."""

    def __init__(self, *arguments: Any, **words: Any) -> None:
        super().__init__(*arguments, **words)
        self.register("type", float, _number)
        self.register("type", int, _whole_number)

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"{self.prog}: error: {message} (see `{self.prog} --help`)\n")


def whole_parser() -> argparse.ArgumentParser:
    """The parser with the options of every command."""
    return _parser(*COMMANDS)


def _parser(*selected: str) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="raytwin",
        description="A calibrated digital twin of an X-ray inspection line.",
        epilog="`raytwin COMMAND --help` shows a command's options and an example.",
    )
    parser.add_argument("--log", metavar="FILE", help="keep what the command says in a file, too (before COMMAND)")
    parser.add_argument("--version", action="version", version=f"raytwin {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (module_name, line) in COMMANDS.items():
        if name in selected:
            module = importlib.import_module(f".commands.{module_name}", __package__)
            command = commands.add_parser(
                name,
                help=line,
                description=module.__doc__,
                epilog=module.EXAMPLE,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            module.add_arguments(command)
            command.set_defaults(run=module.run, option_of_argument=_options(command), actions=tuple(command._actions))
        else:
            commands.add_parser(name, help=line, add_help=False)
    return parser


def _near(word: str, options: Collection[str]) -> str:
    """Which option a misspelt one may mean, as a question; empty where none is near."""
    near = get_close_matches(word.partition("=")[0], options, n=1, cutoff=0.75) if word.startswith("--") else []
    return f"did you mean {near[0]}?" if near else ""


def _options(command: argparse.ArgumentParser) -> dict[str, str]:
    """Python's name of an argument -> the option that sets it, those of commands below it as well, for messages."""
    found: dict[str, str] = {}
    for action in command._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                found |= _options(below)
        elif action.option_strings:
            found[action.dest] = action.option_strings[0]
    return found


def _as_options(argument: str, options: Mapping[str, str]) -> str:
    """Names of Python arguments as the options that set them; any other text as it is."""
    names = argument.replace(" and ", ", ").split(", ")
    if not all(name in options for name in names):
        return argument
    for name in names:
        argument = argument.replace(name, options[name])
    return argument


def _check_written(given: Mapping[str, object]) -> None:
    """Refuse a file to write that another argument reads.

    Raises:
        InputError: such a file.
    """
    rest = [value for name, value in given.items() if name not in WRITTEN]
    read = [one for value in rest for one in (value if isinstance(value, list | tuple) else [value])]
    for name in WRITTEN & given.keys():
        check_not_read(given[name], read=read, argument=name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 success, 1 internal failure, 2 bad input."""
    try:
        file, words = taken_out(sys.argv[1:] if arguments is None else arguments)
        if not words:
            sys.stdout.write(_WAY)
            return 0
        if arguments is None and words[0] in READING:
            from ._guard import code_of_child

            code_there = code_of_child(words)
            if code_there is not None:
                return code_there
        with kept_in(file, words, version=__version__) as write_line:
            code = _main(words)
            write_line(f"exit code {code}")
            return code
    except InputError as error:
        sys.stderr.write(f"raytwin: error: {error}\n")
        return 2


def _main(words: list[str]) -> int:
    selected = next((word for word in words if not word.startswith("-")), None)
    if selected is not None and selected not in COMMANDS:
        near = get_close_matches(selected, COMMANDS, n=1, cutoff=0.5)
        hint = f"; did you mean `raytwin {near[0]}`?" if near else ""
        known = ", ".join(COMMANDS)
        sys.stderr.write(f"raytwin: error: got {selected!r}; expected a command: {known}{hint}\n")
        return 2
    options: dict[str, str] = {}
    try:
        parsed, unknown = _parser(*([selected] if selected is not None else [])).parse_known_args(words)
        if unknown:
            taken = {option for action in parsed.actions for option in action.option_strings}
            raise InputError(
                unknown[0],
                received="an option or a word that this command does not take",
                expected=f"the options of `raytwin {selected} --help`",
                remedy=_near(unknown[0], taken),
            )
        options = parsed.option_of_argument
        _check_written(vars(parsed))
        code: int = parsed.run(parsed)
        sys.stdout.flush()
        return code
    except RaytwinError as error:
        message = str(error)
        if isinstance(error, InputError):
            message = error.message(argument=_as_options(error.argument, options))
        sys.stderr.write(f"raytwin {selected}: error: {' '.join(message.split())}\n")
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"raytwin {selected}: interrupted\n")
        return 1
    except OSError as error:
        remedy = _REMEDY_OF_SYSTEM.get(error.errno or 0)
        if remedy is None:
            return _failed(selected, error)
        place = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"raytwin {selected}: error: {place}got {error.strerror!r} from the system; {remedy}\n")
        return 2
    except Exception as error:
        return _failed(selected, error)


def _failed(selected: str | None, error: Exception) -> int:
    traceback.print_exc()
    sys.stderr.write(f"raytwin {selected}: internal failure: {type(error).__name__}: {error}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
