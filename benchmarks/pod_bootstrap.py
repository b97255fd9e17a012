"""1000 bootstrap refits of 82 hit/miss trials: the batched solver against a loop over statsmodels, and one bound.

    OMP_NUM_THREADS=1 python benchmarks/pod_bootstrap.py

Both fit the same resamples in the same run, one thread; the ratio of the two medians is the figure to quote.
"""

import time
import warnings

import numpy as np
import statsmodels.api as sm

from raytwin.pod import LINKS, check_trials, fit_many
from raytwin.pod.hit_miss import Z_ONE_SIDED, fit_pooled
from raytwin.pod.likelihood import size_bound

REPLICATES, TRIALS = 1000, 82


def main() -> None:
    random = np.random.default_rng(1)
    size = np.sort(random.uniform(0.02, 0.3, TRIALS))
    hit = (random.random(TRIALS) < -np.expm1(-np.exp(-3 + 25 * size))).astype(float)
    counts = random.multinomial(TRIALS, np.full(TRIALS, 1 / TRIALS), size=REPLICATES).astype(float)
    hits, misses = counts * hit, counts * (1 - hit)
    design = sm.add_constant(size)
    ratios = []
    for turn in range(3):
        begin = time.perf_counter()
        batched = fit_many(size, hits, misses, link="cloglog")
        batch_s = time.perf_counter() - begin
        begin = time.perf_counter()
        looped = np.empty((REPLICATES, 2))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for k in range(REPLICATES):
                model = sm.GLM(
                    hit, design, family=sm.families.Binomial(link=sm.families.links.CLogLog()), freq_weights=counts[k]
                )
                looped[k] = model.fit().params
        loop_s = time.perf_counter() - begin
        apart = np.nanmax(np.abs(batched - looped) / np.abs(looped))
        ratios.append(loop_s / batch_s)
        print(
            f"run {turn + 1}: batched {1e3 * batch_s:.1f} ms, statsmodels loop {1e3 * loop_s:.0f} ms,"
            f" ratio {ratios[-1]:.0f}, largest relative difference {apart:.1e}"
        )
    curve = fit_pooled(check_trials(size, hit), link=LINKS["cloglog"], log_size=False, method="ml").curve
    if curve is None:
        raise SystemExit("the data of the benchmark have no curve")
    start = (LINKS["cloglog"].eta_from_pod(0.9) - curve.coefficients[0]) / curve.coefficients[1]
    times = []
    for _ in range(200):
        begin = time.perf_counter()
        size_bound(curve, eta=LINKS["cloglog"].eta_from_pod(0.9), quantile=Z_ONE_SIDED**2, upper=True, start=start)
        times.append(time.perf_counter() - begin)
    bound_ms = 1e3 * np.median(times)
    print(f"median ratio {np.median(ratios):.0f}; one likelihood-ratio bound {bound_ms:.2f} ms (median of 200)")


if __name__ == "__main__":
    main()
