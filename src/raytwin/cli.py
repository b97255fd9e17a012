"""`raytwin`, the one command. Each subcommand is a module of `raytwin.commands`, imported only when it is asked for."""

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Sequence

from . import __version__
from .errors import RaytwinError

# name -> (module in raytwin.commands, one line for `raytwin --help`)
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the main job end to end on the virtual lab"),
    "spectrum": ("spectrum", "tube spectrum behind filters"),
    "mu": ("mu", "effective attenuation of a material"),
    "check": ("check", "what measurements allow, what is suspicious, what to measure next"),
    "calibrate": ("calibrate", "measured flat and dark series -> calibrated twin"),
    "contrast": ("contrast", "contrast of a foreign object in a product, and maps of it"),
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
}


# commands that read HDF5 files of others: the library itself may die at damaged ones
READING = frozenset(
    {"check", "calibrate", "validate", "diagnose", "import", "predict", "generate", "contrast", "detect"}
)


class _Parser(argparse.ArgumentParser):
    """Bad usage is one clear line and exit code 2."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"{self.prog}: error: {message} (see `{self.prog} --help`)\n")


def _parser(selected: str | None) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="raytwin",
        description="A calibrated digital twin of an X-ray inspection line.",
        epilog="`raytwin COMMAND --help` shows a command's options and an example.",
    )
    parser.add_argument("--version", action="version", version=f"raytwin {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (module_name, line) in COMMANDS.items():
        if name == selected:
            module = importlib.import_module(f".commands.{module_name}", __package__)
            command = commands.add_parser(
                name,
                help=line,
                description=module.__doc__,
                epilog=module.EXAMPLE,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            module.add_arguments(command)
            command.set_defaults(run=module.run)
        else:
            commands.add_parser(name, help=line, add_help=False)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 success, 1 internal failure, 2 bad input."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    selected = next((word for word in words if not word.startswith("-")), None)
    if arguments is None and selected in READING:
        from ._guard import code_of_child

        code_there = code_of_child(words)
        if code_there is not None:
            return code_there
    try:
        parsed = _parser(selected if selected in COMMANDS else None).parse_args(words)
        code: int = parsed.run(parsed)
        sys.stdout.flush()
        return code
    except RaytwinError as error:
        sys.stderr.write(f"raytwin {selected}: error: {' '.join(str(error).split())}\n")
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"raytwin {selected}: interrupted\n")
        return 1
    except Exception as error:
        traceback.print_exc()
        sys.stderr.write(f"raytwin {selected}: internal failure: {type(error).__name__}: {error}\n")
        return 1


if __name__ == "__main__":
    sys.exit(main())
