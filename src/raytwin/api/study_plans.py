"""A POD study planned: how many images and networks it needs, and which sizes to make."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..results import Result, Table, axes_or_new, counted, number_text, plain
from .curves import PodCurve, fit_of_hits, fit_pod

if TYPE_CHECKING:
    import numpy as np
    import pandas

    from ..pod import Plan, PodFit, Precision
    from ..pod.planning import AssumedCurve
    from .curves import TableLike


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PodPlan(Result):
    """What a POD study needs, or what a number of images would give.

    Fields: assumed (curve and spreads); networks; images (None: no number is enough); expected (of that design); sizes
    (image,): of the foreign objects to make, in the curve's unit; wanted_over_a90, limit_over_a90, fewest_networks (None
    where a number of images was given); warnings.
    """

    assumed: "AssumedCurve"
    networks: int
    images: int | None
    expected: "Precision | None"
    sizes: "np.ndarray[Any, np.dtype[np.float64]]"
    wanted_over_a90: float | None = None
    limit_over_a90: float | None = None
    fewest_networks: int | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin plan --json` prints."""
        wanted = {}
        if self.wanted_over_a90 is not None:
            wanted = {name: getattr(self, name) for name in ("wanted_over_a90", "limit_over_a90", "fewest_networks")}
        found: dict[str, Any] = plain(
            {
                "assumed": asdict(self.assumed),
                "networks": self.networks,
                "images": self.images,
                "expected": None if self.expected is None else asdict(self.expected),
                "sizes": self.sizes,
                **wanted,
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each foreign object to make: its size."""
        import pandas

        return pandas.DataFrame({"size": self.sizes})

    def plot(self, ax: Any = None) -> Any:
        """The assumed curve, and ticks at the sizes to make; returns the axes."""
        import numpy as np

        from ..pod.links import link_from_name
        from ..pod.mixed import averaged_pod

        axes = axes_or_new(ax)
        c0, c1 = self.assumed.coefficients()
        ends = [*self.sizes.tolist(), self.assumed.size_at(0.02), self.assumed.size_at(0.98)]
        size = (np.geomspace if self.assumed.log_size else np.linspace)(min(ends), max(ends), 200)
        x = np.log(size) if self.assumed.log_size else size
        total = float(np.hypot(self.assumed.sd_network, self.assumed.sd_image))
        axes.plot(size, averaged_pod(c0 + c1 * x, total, link=link_from_name(self.assumed.link)))
        axes.plot(self.sizes, np.zeros(len(self.sizes)), "|", ms=8)
        axes.set(xlabel="size", ylabel="probability of detection", xscale="log" if self.assumed.log_size else "linear")
        return axes

    def _table(self) -> Table:
        rows = [
            ("networks", f"{self.networks}"),
            ("images", "no number is enough" if self.images is None else f"{self.images}"),
        ]
        if self.expected is not None:
            shares = (self.expected.bound_over_a90, self.expected.low_over_a90, self.expected.high_over_a90)
            bound, *ends = (number_text(None if share is None else self.assumed.a90 * share) for share in shares)
            rows.append(("expected a90/95", bound))
            rows.append(("two-sided 95 %", " to ".join(ends)))
        if len(self.sizes):
            rows.append(("sizes", f"{self.sizes.min():.4g} to {self.sizes.max():.4g}"))
        title = f"POD study: assumed a50 {self.assumed.a50:.4g}, a90 {self.assumed.a90:.4g}, {self.assumed.link}"
        return Table(title=title, header=("", ""), rows=tuple(rows), notes=self.warnings)


def plan(
    *,
    a50: float | None = None,
    a90: float | None = None,
    pilot: "TableLike | None" = None,
    size: str | None = None,
    link: str = "cloglog",
    log_size: bool = False,
    sd_network: float = 0.0,
    sd_image: float = 0.0,
    networks: int = 1,
    wanted: float = 1.2,
    images: int | None = None,
) -> PodPlan:
    """How many images and networks a POD study needs, and which sizes to make.

    Args:
        a50, a90: the curve that is expected, in any unit, above 0.
        pilot: in their place a curve of `fit_pod` or a table, whose curve and spreads are taken.
        size, link, log_size: of the pilot's table, or of the assumed curve.
        sd_network, sd_image: spread between networks and images on the link's scale.
        networks: that look at every image.
        wanted: ratio of a90/95 to a90.
        images: in its place, what this number of images would give.

    Returns:
        The plan; large-sample, see `raytwin.pod.planning`.

    Raises:
        InputError: no curve, or a pilot that has none.

    Example:
        >>> study = rt.plan(a50=1.5, a90=3, sd_network=0.4, sd_image=0.8, networks=10, images=100)
        >>> 1 < study.expected.bound_over_a90 < 2
        True
    """
    from ..pod.planning import expected_precision, plan_pod, recommended_sizes

    assumed, told = _assumed(
        a50=a50,
        a90=a90,
        pilot=pilot,
        size=size,
        link=link,
        log_size=log_size,
        sd_network=sd_network,
        sd_image=sd_image,
        networks=networks,
    )
    if images is not None:
        sizes = recommended_sizes(assumed, images, networks=networks)
        expected = expected_precision(assumed, sizes, networks=networks)
        return PodPlan(
            assumed=assumed,
            networks=networks,
            images=images,
            expected=expected,
            sizes=sizes,
            warnings=(*told, *_warnings_of_few(images)),
        )
    found: Plan = plan_pod(assumed, wanted_over_a90=wanted, networks=networks)
    warnings = _warnings_of_few(found.images)
    if found.images is None:
        warnings = (
            f"a90/95 stays at {found.limit_over_a90:.3g} a90 with {counted(networks, 'network')}, whatever the number of images:"
            f" it takes at least {counted(found.fewest_networks, 'network')}",
        )
    return PodPlan(
        assumed=assumed,
        networks=networks,
        images=found.images,
        expected=found.expected,
        sizes=found.sizes,
        wanted_over_a90=found.wanted_over_a90,
        limit_over_a90=found.limit_over_a90,
        fewest_networks=found.fewest_networks,
        warnings=(*told, *warnings),
    )


def _what_is_missing(fit: "PodFit") -> str:
    """Why a curve has no a50 or no a90."""
    if fit.c1 is None:
        return "; ".join(("no curve", *fit.warnings))
    if not fit.c1 > 0.0:
        return f"a table of {fit.n} trials in which POD does not rise with size"
    percent = 50 if fit.a50 is None else 90
    tested = f"{fit.smallest_size:.4g} to {fit.largest_size:.4g}"
    return f"a curve that does not cross POD {percent} % within the tested sizes, {tested}"


def _warnings_of_few(images: int | None) -> tuple[str, ...]:
    from ..pod.planning import FEW_TRIALS

    if images is None or images >= FEW_TRIALS:
        return ()
    return (
        f"with {images} images, fewer than some {FEW_TRIALS}, hits and misses may separate, and bounds are longer then",
    )


def _assumed(
    *,
    a50: float | None,
    a90: float | None,
    pilot: "TableLike | None",
    size: str | None,
    link: str,
    log_size: bool,
    sd_network: float,
    sd_image: float,
    networks: int,
) -> "tuple[AssumedCurve, tuple[str, ...]]":
    """What is assumed, and what was said of the pilot's curve."""
    from ..pod.planning import AssumedCurve

    if pilot is None:
        if a50 is None or a90 is None:
            raise InputError("a50 and a90", received="not both", expected="both sizes", remedy="or a pilot's table")
        given = AssumedCurve(a50=a50, a90=a90, link=link, log_size=log_size, sd_network=sd_network, sd_image=sd_image)
        return given, ()
    curve = pilot if isinstance(pilot, PodCurve) else fit_pod(pilot, size=size, link=link, log_size=log_size)
    fit = fit_of_hits(curve)
    if fit.a50 is None or fit.a90 is None:
        raise InputError(
            "pilot",
            received=_what_is_missing(fit),
            expected="a pilot with an a50 and an a90",
            remedy="give another table or size column, or a50 and a90",
        )
    if fit.repeats == "cluster" and networks > 1:
        raise InputError(
            "pilot",
            received=f"a table where every network hits or misses the same images, and {networks} networks",
            expected="a pilot whose networks differ, or one network",
            remedy="plan with one network: such networks add nothing to each other",
        )
    crossed = fit.crossed
    assumed = AssumedCurve(
        a50=fit.a50,
        a90=fit.a90,
        link=fit.link,
        log_size=fit.log_size,
        sd_network=(crossed.sd_network or 0.0) if crossed else 0.0,
        sd_image=(crossed.sd_image or 0.0) if crossed else 0.0,
    )
    return assumed, tuple(f"pilot: {text}" for text in curve.warnings)
