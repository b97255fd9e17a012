"""The paper's treatment, for comparison: one curve per network, averaged; mean and spread of a90 over networks.

What the authors' code does, and what is kept of it here:

| authors' code | here |
|---|---|
| logit link, where the paper says complementary log-log | kept |
| contrasts of 0.2 and above are dropped | kept |
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

_LINK = "logit"
_LARGEST_CONTRAST = 0.2


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


def fit_as_published(table: Trials) -> AsPublished:
    """a90 of each network's own curve, averaged; in the unit of the size column.

    Args:
        table: trials with networks.

    Raises:
        InputError: the table knows no networks, or nothing is left below a contrast of 0.2.
    """
    if table.network is None:
        raise InputError(
            "network", received="no such column", expected="a column network: the curves are one per network"
        )
    keep = table.size < _LARGEST_CONTRAST
    if not keep.any():
        raise InputError("size", received="no rows left", expected=f"sizes below {_LARGEST_CONTRAST:g}")
    size, network = table.size[keep], table.network[keep]
    distinct, where = np.unique(size, return_inverse=True)
    count = int(table.network.max()) + 1
    hits, misses = np.zeros((count, len(distinct))), np.zeros((count, len(distinct)))
    np.add.at(hits, (network, where), table.hits[keep])
    np.add.at(misses, (network, where), table.misses[keep])
    coefficients = fit_many(distinct, hits, misses, link=_LINK)
    a90 = sizes_at(coefficients, link_from_name(_LINK).eta_from_pod(0.9), log_size=False)
    good = np.isfinite(a90)
    fitted = int(good.sum())
    return AsPublished(
        link=_LINK,
        a90_mean=float(a90[good].mean()) if fitted else None,
        a90_sd=float(a90[good].std(ddof=1)) if fitted > 1 else None,
        c0_mean=float(coefficients[good, 0].mean()) if fitted else None,
        c1_mean=float(coefficients[good, 1].mean()) if fitted else None,
        n_fitted=fitted,
        n_failed=count - fitted,
    )
