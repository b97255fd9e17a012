"""Completion of commands and options in the shell: prints a script that the shell reads."""

import argparse
import sys

EXAMPLE = """examples:
  raytwin completion bash > ~/.local/share/bash-completion/completions/raytwin
  raytwin completion zsh > ~/.zfunc/_raytwin
"""

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin completion`."""
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help="bash, zsh or tcsh")
    parser.add_argument("--json", action="store_true", help="print the script as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin completion`."""
    import shtab

    from ..cli import whole_parser
    from ._answer import answer

    script = shtab.complete(whole_parser(), arguments.shell)
    if arguments.json:
        answer({"shell": arguments.shell, "script": script}, as_json=True, text="")
    else:
        sys.stdout.write(script.rstrip("\n") + "\n")
    return 0
