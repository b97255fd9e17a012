"""The answer of a check."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..results import Result, Table, frame, plain
from .findings import Finding, Severity

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesRow:
    """One series in the table of a check.

    Fields: name; kind; setting (in words; empty: nothing is known); frames; averaged; shape (row, column); level_DN (median
    of its mean frame; None: not read); noise_DN (temporal, of one frame as stored; None: not known); serves_for (what it is
    good for).
    """

    name: str
    kind: str
    setting: str
    frames: int
    averaged: int
    shape: tuple[int, int]
    level_DN: float | None
    noise_DN: float | None
    serves_for: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: getattr(self, name) for name in self.__slots__} | {
            "shape": list(self.shape),
            "serves_for": list(self.serves_for),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowed:
    """One thing that can be learnt or done, or cannot: what; possible; why (from which series, or what is missing)."""

    what: str
    possible: bool
    why: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"what": self.what, "possible": self.possible, "why": self.why}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class CheckResult(Result):
    """The answer of a check.

    Fields: path; what (`acquisition`, `twin`, or the layout of a folder); series; findings (errors first); allows;
    next_measurements (most useful first); draft (a sidecar to start from, of a folder that has none; else empty).
    """

    path: str
    what: str
    series: tuple[SeriesRow, ...]
    findings: tuple[Finding, ...]
    allows: tuple[Allowed, ...]
    next_measurements: tuple[str, ...]
    draft: str = ""

    @property
    def counts(self) -> dict[str, int]:
        """Findings by severity."""
        return {str(one): sum(item.severity is one for item in self.findings) for one in Severity}

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a finding: code, series, text, severity."""
        return frame(self.to_dict()["findings"], columns=("code", "series", "text", "severity"))

    def _table(self) -> Table:
        counts = self.counts
        told = ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items())
        able = [item for item in self.allows if item.possible]
        rows = tuple((str(item.severity), item.series, item.text) for item in self.findings)
        title = f"{self.path}: {self.what}, {len(self.series)} series; {told}"
        notes = [
            f"{len(able)} of {len(self.allows)} things are possible",
            *(f"next: {text}" for text in self.next_measurements[:2]),
        ]
        return Table(
            title=title, header=("severity", "series", "finding") if rows else (), rows=rows, notes=tuple(notes)
        )

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin check --json` prints."""
        found: dict[str, Any] = plain(self._answer())
        return found

    def _answer(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "what": self.what,
            "series": [row.to_dict() for row in self.series],
            "findings": [item.to_dict() for item in self.findings],
            "allows": [item.to_dict() for item in self.allows],
            "next_measurements": list(self.next_measurements),
            "draft": self.draft or None,
        }
