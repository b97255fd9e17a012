"""Effects that a twin has already: part of what is expected of a session, or sought again."""

from collections.abc import Sequence

from ...generator.effects import AppliedEffect, effect_of

# what these do to mean frames by chance is in no law: they are sought again, and take the place of those the twin has
_IN_NO_LAW = ("output", "pixels", "lines", "offset")


def lasting(effects: Sequence[AppliedEffect]) -> tuple[AppliedEffect, ...]:
    """Effects of a twin that are part of what is expected of a session."""
    return tuple(item for item in effects if effect_of(item).variation.random not in _IN_NO_LAW)


def with_found(effects: Sequence[AppliedEffect], added: Sequence[AppliedEffect]) -> tuple[AppliedEffect, ...]:
    """A twin's effects and those that were found, which take the place of the same ones."""
    found = {item.id for item in added}
    return (*(item for item in effects if item.id not in found), *added)
