"""POD fits against R: glm, brglm2 and lme4, on hit/miss data drawn here.

    python validation/pod_against_r.py

Needs Rscript with the packages lme4 and brglm2 (Debian: r-base-core r-cran-lme4 r-cran-brglm2); without them it says
so and ends well. Limits: coefficients and standard errors of fixed-effect fits 1e-6, bounds on a90 1e-4, mixed models
1e-3, each relative. R has no loglog link: it is cloglog of the misses on the size with its sign turned.
"""

import csv
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from raytwin.pod import LINKS, fit_pod
from raytwin.pod.mixed import fit_mixed

R_PROGRAM = r"""
suppressMessages({library(brglm2); library(lme4)})
args <- commandArgs(TRUE)
d <- read.csv(args[1]); m <- read.csv(args[2])
number <- function(v) paste(formatC(as.numeric(v), digits = 15, format = "g"), collapse = ",")
put <- function(name, v) cat(name, ":", number(v), "\n", sep = "")
control <- glm.control(epsilon = 1e-14, maxit = 200)
for (link in c("cloglog", "loglog", "logit", "probit")) {
  flip <- link == "loglog"
  family <- binomial(if (flip) "cloglog" else link)
  y <- if (flip) 1 - d$hit else d$hit
  x <- if (flip) -d$size else d$size
  fit <- glm(y ~ x, family = family, control = control)
  turn <- if (flip) c(-1, 1) else c(1, 1)
  put(paste0("ml_", link), c(turn * coef(fit), sqrt(diag(vcov(fit))), deviance(fit)))
  target <- if (flip) family$linkfun(0.1) else family$linkfun(0.9)
  a90 <- (target - coef(fit)[1]) / coef(fit)[2]
  rise <- function(a) {
    held <- suppressWarnings(glm(y ~ 0 + I(x - a), family = family, offset = rep(target, length(y)),
                                 start = coef(fit)[2], control = control))
    deviance(held) - deviance(fit)
  }
  away <- if (flip) -1 else 1
  bound <- function(q) {
    ends <- sort(c(a90, a90 + away * 0.6 * diff(range(x))))
    uniroot(function(a) rise(a) - q, ends, tol = 1e-12)$root
  }
  put(paste0("bounds_", link), (if (flip) -1 else 1) * c(bound(qchisq(0.90, 1)), bound(qchisq(0.95, 1))))
  firth <- glm(y ~ x, family = family, method = "brglmFit",
               control = brglmControl(type = "AS_mean", epsilon = 1e-13, maxit = 5000))
  put(paste0("firth_", link), c(turn * coef(firth), sqrt(diag(vcov(firth)))))
  ym <- if (flip) 1 - m$hit else m$hit
  xm <- if (flip) -m$size else m$size
  strict <- glmerControl(optimizer = "bobyqa", optCtrl = list(maxfun = 1e6, rhoend = 1e-9), tolPwrss = 1e-12)
  mixed <- glmer(ym ~ xm + (1 | network) + (1 | image), data = m, family = family, control = strict)
  sds <- sqrt(unlist(VarCorr(mixed)))
  put(paste0("mixed_", link), c(turn * fixef(mixed), sqrt(diag(as.matrix(vcov(mixed)))), sds[["network"]],
                                sds[["image"]], -2 * as.numeric(logLik(mixed))))
}
"""


def drawn_data(seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Independent trials (n = 120), and 12 networks on 60 images with effects of both."""
    random = np.random.default_rng(seed)
    size = random.uniform(0.02, 0.4, 120)
    single = {"size": size, "hit": (random.random(120) < 1 / (1 + np.exp(4 - 30 * size))).astype(int)}
    x = np.repeat(random.uniform(0.02, 0.4, 60)[None], 12, axis=0)
    network, image = np.indices(x.shape)
    eta = -2.0 + 12 * x + random.normal(0, 0.4, 12)[:, None] + random.normal(0, 0.8, 60)[None]
    hit = (random.random(x.shape) < -np.expm1(-np.exp(eta))).astype(int)
    return single, {"size": x.ravel(), "hit": hit.ravel(), "network": network.ravel(), "image": image.ravel()}


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(
            [repr(v) if isinstance(v, float) else v for v in row]
            for row in zip(*(c.tolist() for c in columns.values()), strict=True)
        )


def answers_of_r(single: dict[str, np.ndarray], mixed: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        write_columns(Path(folder) / "single.csv", single)
        write_columns(Path(folder) / "mixed.csv", mixed)
        (Path(folder) / "fits.R").write_text(R_PROGRAM, encoding="utf-8")
        done = subprocess.run(
            ["Rscript", "--vanilla", "fits.R", "single.csv", "mixed.csv"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stderr)
    pairs = (line.split(":") for line in done.stdout.splitlines() if ":" in line)
    return {name: np.array([float(v) for v in values.split(",")]) for name, values in pairs}


def own_answers(single: dict[str, np.ndarray], mixed: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    found = {}
    for name, link in LINKS.items():
        fit = fit_pod(single["size"], single["hit"], link=name)
        found[f"ml_{name}"] = np.array([fit.c0, fit.c1, fit.se0, fit.se1, fit.deviance], dtype=float)
        found[f"bounds_{name}"] = np.array(
            [fit.a90_95.likelihood_ratio, fit.a90_95_two_sided.likelihood_ratio], dtype=float
        )
        firth = fit_pod(single["size"], single["hit"], link=name, method="firth")
        found[f"firth_{name}"] = np.array([firth.c0, firth.c1, firth.se0, firth.se1], dtype=float)
        size = mixed["size"]
        effects = fit_mixed(
            np.stack((np.ones_like(size), size), axis=1),
            mixed["hit"].astype(float),
            1.0 - mixed["hit"],
            factors=[mixed["network"], mixed["image"]],
            link=link,
        )
        errors = np.sqrt(np.diag(effects.covariance)[:2])
        found[f"mixed_{name}"] = np.concatenate((effects.coefficients, errors, effects.sd, [effects.deviance]))
    return found


LIMITS = {"ml": 1e-6, "firth": 1e-6, "bounds": 1e-4, "mixed": 1e-3}


def main() -> int:
    if shutil.which("Rscript") is None:
        print("skipped: Rscript is not installed (Debian: apt install r-base-core r-cran-lme4 r-cran-brglm2)")
        return 0
    asked = 'cat(all(c("lme4", "brglm2") %in% rownames(installed.packages())))'
    if (
        "TRUE"
        not in subprocess.run(["Rscript", "--vanilla", "-e", asked], capture_output=True, text=True, check=False).stdout
    ):
        print("skipped: R lacks lme4 or brglm2 (Debian: apt install r-cran-lme4 r-cran-brglm2)")
        return 0
    worst: dict[str, float] = {}
    for seed in (1, 2, 3):
        single, mixed = drawn_data(seed)
        theirs, ours = answers_of_r(single, mixed), own_answers(single, mixed)
        for name, values in ours.items():
            apart = float(np.max(np.abs(values - theirs[name]) / np.maximum(np.abs(theirs[name]), 1e-2)))
            worst[name] = max(worst.get(name, 0.0), apart)
    for name, apart in worst.items():
        limit = LIMITS[name.split("_")[0]]
        print(
            f"{name:<16} largest relative difference {apart:.1e}  limit {limit:.0e}  {'ok' if apart <= limit else 'FAILED'}"
        )
    print(json.dumps(worst))
    return int(any(apart > LIMITS[name.split("_")[0]] for name, apart in worst.items()))


if __name__ == "__main__":
    sys.exit(main())
