"""The forward model asked again once a problem stands: further variants, and nuisances where effects have been found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...generator.effects import AppliedEffect
from ..arrays import BoolArray, FloatArray
from ..model.changes import Change, Variant
from ..model.curves import LEAST_RESPONSE, places_of
from ..model.forward_model import strength_rows
from ..model.responses import Asked, SessionModel
from ..session.even_maps import full_size
from .nuisance_columns import Columns, nuisances_of_series
from .series_block import SeriesBlock
from .surroundings import border_inflow


@dataclass(frozen=True, slots=True, kw_only=True)
class AskedAgain:
    """A session's forward model and the probes of its series."""

    session: SessionModel
    series: tuple[SeriesBlock, ...]  # in order of time
    steps: tuple[Change, ...]  # of nuisances that lie in the twin
    done: Mapping[str, FloatArray]  # (probe,): what the base's own effects do, by id
    factors: Columns  # (probe,): nuisances of the base, by name

    def respond(self, variants: Sequence[Variant], wanted: BoolArray | None = None) -> dict[int, FloatArray]:
        """Responses (strength, probe) of further variants, by their place among them; failed ones are left out.

        Series without any of the probes that are wanted (probe,) are not asked: their probes are 0.
        """
        model = self.session.model
        changes = [model.change(item, strength) for item in variants for strength in item.strengths]
        there = []
        for item in variants:
            if item.beside is not None and item.beside not in there:
                there.append(item.beside)
        asked = [self.session.ask(change) for change in (*changes, *(model.with_found([item]) for item in there))]
        responses = np.zeros((len(asked), sum(map(len, self.series))))
        for one, place in zip(self.series, places_of(self.series), strict=True):
            if wanted is None or wanted[place].any():
                responses[:, place] = one.probes.responses(self.session.moved(one.probes.series, asked))
        names = np.repeat([one.probes.series.name for one in self.series], [len(one) for one in self.series])

        def of(variant: Variant, rows: slice) -> FloatArray:
            found = responses[rows] + self.done.get(variant.effect, 0.0)
            if variant.beside is not None:
                found = found - responses[len(changes) + there.index(variant.beside)]
            return np.where(np.isin(names, variant.series), found, 0.0) if variant.series else found

        return {
            number: of(variants[number], rows)
            for number, rows in enumerate(strength_rows(variants))
            if not any(one.failed for one in (*asked[rows], *asked[len(changes) :]))
        }

    def border_inflow(self, effect: AppliedEffect) -> FloatArray | None:
        """What borders may let in of an effect by chance, see `border_inflow`."""
        return border_inflow(self.session, [one.probes for one in self.series], effect)

    def factors_with(self, effects: Sequence[AppliedEffect]) -> Columns:
        """Responses (probe,) to nuisances by name where effects have been found; the base's where they change nothing.

        Behind a voltage that is 3 % higher there is a third more light, and a third more of it strays.
        """
        found = self.session.ask(self.session.model.with_found(effects))
        columns = {name: column.copy() for name, column in self.factors.items()}
        if found.failed:
            return columns
        beside = {
            step.label: change for step in self.steps if (change := step.in_presence_of(found.change)) is not None
        }
        asked = {label: self.session.ask(change) for label, change in beside.items()}
        for one, place in zip(self.series, places_of(self.series), strict=True):
            for name, column in self._of_series(one, found, asked).items():
                columns.setdefault(name, np.zeros(len(next(iter(columns.values())))))[place] = column
        return notable(columns)

    def _of_series(self, one: SeriesBlock, found: Asked, asked: Mapping[str, Asked]) -> Columns:
        """Responses (probe,) of one series to nuisances; none where the effects do not change what it shows."""
        at, *others = self.session.moved(one.probes.series, [found, *asked.values()])
        if at is None or not np.any(one.probes.responses([at])):
            return {}
        known = {label: item for label, item in zip(asked, others, strict=True) if item is not None}
        steps = one.probes.responses([at, *known.values()])
        columns = {
            label: (step - steps[0]) / asked[label].change.step_sd for label, step in zip(known, steps[1:], strict=True)
        }
        here = replace(one.probes, series=self.session.under(one.probes.series, found))
        signal = np.asarray(one.signal_DN, np.float64) + full_size(at[0], one.signal_DN.shape)
        redrawn = one.scenes.drawn(self.session, here.series, found)
        return columns | nuisances_of_series(self.session, here, signal, redrawn)


def notable(columns: Columns) -> Columns:
    """Nuisances (probe,) that any probe shows."""
    return {name: column for name, column in columns.items() if float(np.max(np.abs(column))) > LEAST_RESPONSE}
