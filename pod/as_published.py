"""The paper's treatment, for comparison: one curve per network, averaged; mean and spread of a90 over networks.

What the authors' code does, and what is kept of it here:

| authors' code | here |
|---|---|
| logit link, where the paper says complementary log-log | kept (`link` chooses) |
| contrasts of 0.2 and above are dropped | kept (`largest_contrast`; None keeps all) |
| a fit that fails enters the average as -1 | not repeated: failed fits are left out and counted |
| the spread over networks is the only uncertainty | kept; it leaves out that the images are a sample too |

`fit_pod` with crossed random effects is raytwin's own answer.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .bootstrap import fit_many, sizes_at
from .links import link_from_name
from .trials import Trials


@dataclass(frozen=True, slots=True, kw_only=True)
class AsPublished:
    """Mean and standard deviation over networks of a90 (contrast) and of the coefficients; None without any fit.

    n_fitted, n_failed: networks with a rising curve, and without (all hits, all misses, no overlap, falling).
    """

    link: str
    a90_mean: float | None
    a90_sd: float | None
    c0_mean: float | None
    c1_mean: float | None
    n_fitted: int
    n_failed: int


def fit_as_published(table: Trials, *, link: str = "logit", largest_contrast: float | None = 0.2) -> AsPublished:
    """a90 of each network's own curve, averaged; in the unit of the size column.

    Args:
        table: trials with networks.
        link: the link's name.
        largest_contrast: sizes from here on are dropped; None = none.

    Raises:
        InputError: the table knows no networks, or nothing is left below `largest_contrast`.
    """
    if table.network is None:
        raise InputError(
            "network", received="no such column", expected="a column network: the curves are one per network"
        )
    shape = link_from_name(link)
    keep = np.ones(len(table.size), bool) if largest_contrast is None else table.size < largest_contrast
    if not keep.any():
        raise InputError("size", received="no rows left", expected=f"sizes below {largest_contrast:g}")
    size, network = table.size[keep], table.network[keep]
    distinct, where = np.unique(size, return_inverse=True)
    count = int(table.network.max()) + 1
    hits, misses = np.zeros((count, len(distinct))), np.zeros((count, len(distinct)))
    np.add.at(hits, (network, where), table.hits[keep])
    np.add.at(misses, (network, where), table.misses[keep])
    coefficients = fit_many(distinct, hits, misses, link=link)
    a90 = sizes_at(coefficients, shape.eta_from_pod(0.9), log_size=False)
    good = np.isfinite(a90)
    fitted = int(good.sum())
    return AsPublished(
        link=link,
        a90_mean=float(a90[good].mean()) if fitted else None,
        a90_sd=float(a90[good].std(ddof=1)) if fitted > 1 else None,
        c0_mean=float(coefficients[good, 0].mean()) if fitted else None,
        c1_mean=float(coefficients[good, 1].mean()) if fitted else None,
        n_fitted=fitted,
        n_failed=count - fitted,
    )
