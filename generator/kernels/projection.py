"""Polychromatic projection: what reaches, or is worth something in, each pixel behind given thicknesses.

The sum over energies is done as it stands, without table or interpolation, in single precision; thousands of pixels
share each energy's coefficients.
"""

import math
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from .kernels import BACKENDS, is_tensor

# single precision holds a transmission down to 1e-38; from here on it is 0 within the stated error
_LONGEST_MM = 1e30


def _spectrum_arrays(mu_per_mm: ArrayLike, weights: ArrayLike, materials: int) -> tuple[Any, Any]:
    mu = np.atleast_2d(np.asarray(mu_per_mm, dtype=np.float64))
    weight = np.atleast_2d(np.asarray(weights, dtype=np.float64))
    if mu.ndim != 2 or weight.ndim != 2 or mu.shape[0] != materials or mu.shape[1] != weight.shape[1]:
        raise InputError(
            "mu_per_mm and weights",
            received=f"arrays of {np.shape(mu_per_mm)} and {np.shape(weights)}",
            expected=f"({materials}, energies) 1/mm and (moments, energies), of the same energies",
        )
    if not (np.all(mu >= 0) and np.all(np.isfinite(mu))):
        raise InputError("mu_per_mm", received=_worst(mu), expected="finite attenuation of 0 or more, 1/mm")
    if not (np.all(weight >= 0) and np.all(np.isfinite(weight))):
        raise InputError("weights", received=_worst(weight), expected="finite weights of 0 or more")
    if not np.all(weight.sum(axis=1) < 3e38):
        raise InputError("weights", received=f"a sum of {weight.sum(axis=1).max():.3g}", expected="less than 3e38")
    return mu, weight


def _worst(values: NDArray[np.floating]) -> str:
    wrong = values[~(np.isfinite(values) & (values >= 0))]
    return f"{float(wrong.flat[0]):g} in {wrong.size} of {values.size} places"


def checked_thickness(thickness_mm: ArrayLike, *, allow_negative: bool) -> Any:
    """Thicknesses (material, ...) as float32, finite and, unless allowed otherwise, not negative; mm.

    Raises:
        InputError: NaN, infinity, a negative thickness, or no axis of materials.
    """
    given: Any = thickness_mm.detach() if is_tensor(thickness_mm) else np.asarray(thickness_mm)  # type: ignore[union-attr]
    if given.ndim < 1 or not (is_tensor(given) or given.dtype.kind in "fiub"):
        raise InputError(
            "thickness_mm",
            received=f"{given.dtype} of shape {tuple(given.shape)}",
            expected="numbers of shape (material, row, column), mm",
        )
    if math.prod(given.shape):
        lowest, highest = float(given.min()), float(given.max())  # NaN in any place makes both NaN
        if not (math.isfinite(lowest) and math.isfinite(highest)):
            raise InputError(
                "thickness_mm",
                received=f"{int((~(abs(given) < math.inf)).sum())} NaN or infinite",
                expected="finite mm",
            )
        if lowest < 0 and not allow_negative:
            raise InputError(
                "thickness_mm",
                received=f"{lowest:g} mm in {int((given < 0).sum())} places",
                expected="0 mm or more",
                remedy="cut at 0, or allow negative thicknesses where they come from noisy measurements",
            )
        if max(-lowest, highest) > _LONGEST_MM:
            given = given.clip(-_LONGEST_MM, _LONGEST_MM)
    return given.float().contiguous() if is_tensor(given) else np.ascontiguousarray(given, dtype=np.float32)


@overload
def project_polychromatic(
    thickness_mm: ArrayLike,
    mu_per_mm: ArrayLike,
    weights: ArrayLike,
    *,
    allow_negative: bool = False,
    backend: Literal["cpu"] = "cpu",
    device: str | None = None,
) -> NDArray[np.float32]: ...


@overload
def project_polychromatic(
    thickness_mm: ArrayLike,
    mu_per_mm: ArrayLike,
    weights: ArrayLike,
    *,
    allow_negative: bool = False,
    backend: str,
    device: str | None = None,
) -> Any: ...


def project_polychromatic(
    thickness_mm: ArrayLike,
    mu_per_mm: ArrayLike,
    weights: ArrayLike,
    *,
    allow_negative: bool = False,
    backend: str = "cpu",
    device: str | None = None,
) -> Any:
    """Weighted sums over energies behind an object (k, row, column), in the unit of the weights.

    result_k = sum_E weights_k(E) exp(-sum_m mu_m(E) t_m)

    Relative error below 1e-4 (2e-6 as a rule) where exp() of the most penetrating energy is above 1e-30; single precision
    ends there, and a much thicker object gives 0. Zero thickness gives the sum of the weights, rounded once.

    Args:
        thickness_mm: path lengths (material, row, column), or (material, ...) of any shape behind it, mm; with torch also a
            tensor, which need not leave its device.
        mu_per_mm: linear attenuation (material, energy), 1/mm.
        weights: (k, energy) or (energy,): what a photon spectrum is worth, for example N m1 for the signal, N m2 for
            the variance and N D for the photons absorbed; 0 or more.
        allow_negative: take negative thicknesses as they stand (a solution of noisy measurements has them).
        backend: `cpu` (compiled), `torch` or `torch_compiled` (its steps joined by torch's compiler).
        device: torch's name of the device; None for `cuda` where there is one, else `cpu`.

    Returns:
        float32 (k, ...), an array or with `torch` a tensor on the device; k = 1 for weights (energy,).

    Raises:
        InputError: NaN, infinite or negative thickness, coefficients or weights, or shapes that do not fit.

    Checked against: the sum in double precision, tests/test_generator_projection.py.
    """
    thickness = checked_thickness(thickness_mm, allow_negative=allow_negative)
    materials, shape = thickness.shape[0], thickness.shape[1:]
    mu, weight = _spectrum_arrays(mu_per_mm, weights, materials)
    scale = weight.sum(axis=1)
    pixels = int(np.prod(shape))
    if backend not in BACKENDS:
        raise InputError("backend", received=backend, expected="one of " + ", ".join(BACKENDS))
    if backend != "cpu":
        from ._torch_kernels import project

        share = weight / np.where(scale > 0, scale, 1.0)[:, None]
        shares = project(
            thickness.reshape(materials, pixels),
            mu * math.log2(math.e),
            share,
            device=device,
            fused=backend == "torch_compiled",
        )
        return (shares * shares.new_tensor(scale)[:, None]).reshape(len(weight), *shape)
    if is_tensor(thickness):
        raise InputError(
            "backend",
            received="cpu for torch tensors",
            expected="torch or torch_compiled",
            remedy="or give numpy arrays",
        )
    result = np.empty((len(weight), pixels), dtype=np.float32)
    if materials == 0:
        result[:] = scale[:, None]
    elif pixels:
        _project(thickness.reshape(materials, pixels), mu, weight, scale, result)
    return result.reshape(len(weight), *shape)


def _project(
    thickness: NDArray[np.float32],
    mu: NDArray[np.float64],
    weight: NDArray[np.float64],
    scale: NDArray[np.float64],
    result: NDArray[np.float32],
) -> None:
    """Fill result (k, pixel): the kernel takes two or more materials, MOMENTS weights and TOGETHER energies a step."""
    from ._projection_kernel import FEW_TERMS, MOMENTS, TOGETHER, sum_exponentials, sum_exponentials_alone

    used = np.any(weight > 0, axis=0)
    mu, weight = mu[:, used], weight[:, used]
    if len(thickness) == 1:
        thickness = np.concatenate([thickness, np.zeros_like(thickness)])
        mu = np.concatenate([mu, np.zeros_like(mu)])
    missing = -mu.shape[1] % TOGETHER
    depth = np.pad(mu * math.log2(math.e), ((0, 0), (0, missing))).astype(np.float32)
    # weights of any unit fit single precision as shares of their sum; the sum comes back in double precision
    share = np.pad(weight / np.where(scale > 0, scale, 1.0)[:, None], ((0, 0), (0, missing)))
    few = thickness.shape[1] * depth.shape[1] < FEW_TERMS
    summed = sum_exponentials_alone if few else sum_exponentials
    for start in range(0, len(weight), MOMENTS):
        stop = min(start + MOMENTS, len(weight))
        padded = np.zeros((MOMENTS, depth.shape[1]), dtype=np.float32)
        padded[: stop - start] = share[start:stop]
        ones = np.ones(stop - start, dtype=np.float32)
        summed(thickness, depth, padded, ones, result[start:stop])
        for k in range(start, stop):
            result[k] *= np.float32(scale[k])
