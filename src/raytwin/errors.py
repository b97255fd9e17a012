"""The errors of raytwin: one small family. A message says what was given, what was expected and what to do."""

import numbers


class RaytwinError(Exception):
    """Base of every error that raytwin raises on purpose."""


class InputError(RaytwinError, ValueError):
    """An argument or a file holds something that cannot be used."""

    def __init__(self, argument: str, *, received: object, expected: str, remedy: str = "") -> None:
        """
        Args:
            argument: name of the argument, option, file or dataset at fault.
            received: what was given (shown shortened to one line).
            expected: what would have been right, in lab words with units.
            remedy: what the user can do about it; empty where `expected` already says it.
        """
        self.argument = argument
        self.received = received
        self.expected = expected
        self.remedy = remedy
        super().__init__(self.message())

    def message(self, *, argument: str | None = None) -> str:
        """The message, on request with another name of the argument, such as a command's option."""
        given = " ".join(str(self.received).split())
        if len(given) > 160:
            given = given[:157] + "..."
        text = f"{argument or self.argument}: got {given}; expected {self.expected}"
        return f"{text}; {self.remedy}" if self.remedy else text


LARGEST = 1e12  # in the units of this package no length, time, load, dose or number of photons of a line comes near


def check_number(argument: str, value: object, *, unit: str = "") -> None:
    """Refuse what is no real number.

    Raises:
        InputError: a text, None, an array or another object.
    """
    if not isinstance(value, numbers.Real):
        raise InputError(argument, received=repr(value), expected=f"a number, in {unit}" if unit else "a number")


def check_whole(argument: str, value: object, *, least: int) -> None:
    """Refuse what is no whole number, or below the least.

    Raises:
        InputError: another number, a truth value, a text or another object.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
        raise InputError(argument, received=repr(value), expected=f"a whole number, {least} or more")


class FileFormatError(InputError):
    """A file is truncated, of another format, or lacks what its format requires."""


class FitError(RaytwinError):
    """A fit could not be made or did not converge; the message says why."""


class MissingDependencyError(RaytwinError, ImportError):
    """An optional library is needed and absent; the message holds the command that installs it."""
