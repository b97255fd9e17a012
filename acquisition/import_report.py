"""What an import read, what it skipped and why."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Skipped:
    """One thing that was not taken over: what (a file, a frame range, a row) and why."""

    what: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportReport:
    """The account of one import.

    Fields: layout; source; written (the new file); format (`acquisition` or `dataset`); read (one entry a series or
    setting: name and what is known of it); frames (images or frames in all); skipped; notes (assumptions that were
    made, and what cannot be done with what is missing).
    """

    layout: str
    source: str
    written: str
    format: str
    read: tuple[Mapping[str, Any], ...]
    frames: int
    skipped: tuple[Skipped, ...] = ()
    notes: tuple[str, ...] = ()
