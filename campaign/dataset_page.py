"""Page of a dataset: what it holds, and some of its images."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..acquisition.dataset_io import SPLITS, Dataset
from ..reports import AFTER, Chart, KeyFigure, Picture, ResultPage, Section, SortedTable, Step
from ..reports.chart import Bars
from ..results import counted

_EXAMPLES = 3  # pairs: of the least, the middling and the largest contrast
_GROUPS = 12


def dataset_page(dataset: Dataset, *, warnings: Sequence[str] = ()) -> ResultPage:
    """Counts by split, product and object, the contrasts, and example pairs of little, middling and much contrast."""
    rows = dataset.rows
    with_object = [number for number, row in enumerate(rows) if row.foreign_object]
    splits = Counter(row.split for row in rows)
    rows_px, columns_px = dataset.shape
    settings = list(dict.fromkeys(row.setting for row in rows if row.setting))
    lines = [
        f"{counted(len(rows), 'pair')} of {rows_px} x {columns_px} pixels, {len(with_object)} with a foreign object."
    ]
    lines.append("Split: " + ", ".join(f"{splits[name]} {name}" for name in SPLITS if splits[name]) + ".")
    key = [
        KeyFigure(value=str(len(rows)), text="image pairs"),
        KeyFigure(value=str(len(with_object)), text="with a foreign object"),
    ]
    contrast = dataset.column("contrast")
    known = np.flatnonzero(np.isfinite(contrast))
    charts = []
    if known.size:
        low, high = float(contrast[known].min()), float(contrast[known].max())
        key.append(KeyFigure(value=f"{low:.3g} to {high:.3g}", text="contrast of the objects"))
        charts.append(_histogram(contrast[known], "contrast"))
    size = dataset.column("size_mm")
    if np.isfinite(size).any():
        charts.append(_histogram(size[np.isfinite(size)], "size_mm"))
    ordered = known[np.argsort(contrast[known], kind="stable")] if known.size else np.arange(len(rows))
    chosen = (
        list(dict.fromkeys(int(ordered[place]) for place in np.linspace(0, len(ordered) - 1, _EXAMPLES).astype(int)))
        if len(ordered)
        else []
    )
    table = SortedTable(
        header=("product", "foreign object", "split", "pairs"),
        rows=tuple(
            (product or "–", thing or "none", split, str(count))
            for (product, thing, split), count in sorted(
                Counter((row.product, row.foreign_object, row.split) for row in rows).items()
            )
        ),
        words=frozenset({0, 1, 2}),
    )
    provenance = SortedTable(
        header=("attribute", "value"),
        rows=tuple((name, str(value)) for name, value in sorted(dataset.attributes.items())),
        words=frozenset({0, 1}),
    )
    return ResultPage(
        heading="Image pairs",
        answer=tuple(lines),
        key_figures=tuple(key),
        proof=tuple(picture for number in chosen for picture in _pictures(dataset, number)),
        steps=(
            Step(text="Train networks on the pairs.", command="raytwin train DATASET -o runs --networks 3"),
            Step(text="Hand them to another trainer.", command="raytwin export DATASET --to coco -o coco"),
        ),
        sections=(
            *([Section(title=f"Warnings ({len(warnings)})", items=tuple(warnings))] if warnings else []),
            Section(title="What is in it", figures=tuple(charts), table=table),
            Section(title=f"Settings ({len(settings)})", items=tuple(settings), folded=len(settings) > 1),
            Section(title="How it was made", table=provenance, folded=True),
        ),
    )


def _histogram(values: "np.ndarray", name: str) -> Chart:
    counts, edges = np.histogram(values, bins=min(_GROUPS, max(2, len(np.unique(values)))))
    middle = 0.5 * (edges[1:] + edges[:-1])
    title = {"contrast": "contrast ΔR", "size_mm": "size, mm"}[name]
    return Chart(
        name=f"histogram_of_{name}",
        title=f"Objects by {title}",
        alt=f"Number of pairs in groups of like {title.partition(',')[0]}.",
        marks=[
            Bars(
                y=middle,
                length=counts,
                thickness=0.9 * float(edges[1] - edges[0]),
                colour=AFTER,
                names=[f"{a:.3g} to {b:.3g}" for a, b in pairwise(edges)],
            )
        ],
        x_label="pairs",
        y_label=title,
        x_ends=(0.0, 1.08 * float(counts.max())),
    )


def _pictures(dataset: Dataset, number: int) -> tuple[Picture, Picture]:
    """Low and high kV of a pair, the foreign object outlined."""
    pair, mask, row = dataset.images(number), dataset.foreign_object_masks(number), dataset.rows[number]
    told = f", {row.foreign_object}" if row.foreign_object else ""
    told += f", contrast {row.contrast:.3g}" if np.isfinite(row.contrast) else ""
    found = []
    for image, beam in zip(pair, ("low", "high"), strict=True):
        low, high = (float(value) for value in np.percentile(image, [0.5, 99.5]))
        found.append(
            Picture(
                name=f"{row.image}_{beam}",
                title=f"{row.image}, {beam} kV",
                alt=f"-log(I / I0) at the {beam} voltage{told}.",
                values=image.astype(np.float64),
                label="-log(I / I0)",
                ends=(low, high if high > low else low + 1.0),
                grey=True,
                outline=mask,
                height_px=280,
            )
        )
    return found[0], found[1]
