"""What speaks against an estimate, and what for it: each reason once, for one sensor and for many.

A reason has a code, whose place is its place in what is said; a threshold, where it is a matter of
degree; and words, a function of its figures. `estimate.certificate` asks for one sensor,
`fleet.judge` for many side by side. What only one of them asks is in ONE_ONLY and MANY_ONLY; where
both ask, but not with the same means, the code's line says so.
"""

from __future__ import annotations

from enum import IntFlag, auto

#: Share of the residual that the Jacobian can still reach (Bates & Watts' relative offset).
SLOPE = 1e-5
#: Last Gauss-Newton step, in standard deviations of the estimate.
STEP = 1e-4
#: Smallest exact curvature, of the Gauss-Newton one: less is none beyond rounding.
CURVATURE = 1e-9
#: Two solutions are the same when they differ by less than this many standard deviations.
SAME = 1e-2
#: Rise of the cost, in variances, up to which another solution fits alike: half of χ²(1) at 95 %;
#: and how many standard deviations away it is one of its own.
ALIKE, APART = 1.92, 10.0
#: Rise of the cost two standard deviations from the optimum, over what the intervals assume; from
#: FAR on the number says no more.
SHAPE, FAR = (0.5, 10.0), 1000.0
#: Within this the linear intervals are as good as those of the likelihood, which are dearer.
LINEAR = (0.7, 2.0)
#: From this ratio on a valley is too bent to be looked along: about 45 standard deviations aside.
BENT = 1e3
#: Standard deviations from a bound, of the unknown alone, within which it is on it.
ON_BOUND = 1e-3
#: Standard deviations beyond a bound that the data may ask for where the truth lies on it: noise
#: asks for more in one of two thousand.
BEYOND = 3.3
#: Share of two standard deviations within its bounds from which on a direction is walked along.
WALKED = 0.2
#: An implicit residual is the noise of the reading to first order only; the second-order part must
#: stay below this share of it. (A flat ellipsoid through poses in a plane "fits" by that part.)
SECOND_ORDER = 0.07
#: Range of an input, in its middle, below which that is far from zero.
FAR = 0.5
#: Singular values of the column-scaled Jacobian below this leave a direction undetermined for all
#: practical purposes: its standard deviation is 10⁵ times that of each parameter alone.
PRACTICALLY_NULL = 1e-5
#: Below this one, a direction is named as the cause where a fit does not settle.
WEAK = 1e-3
#: Neighbouring rows of a table over which residuals are alike, from which on the fit is poor: an
#: autoregression of 0.8. Of NIST's 27 problems one has more at its solution, and one valley.
POOR = 9.0
#: Independent residuals for each unknown that a wandering residual must be worth, where no other of
#: at least STARTS ended in the same place: a random walk alone fits many a motion.
WORTH, STARTS = 5, 4
#: Correlation of neighbouring residuals, in standard deviations of that of independent ones, from
#: which on the samples of a sensor among many are taken for a time series.
TIME_SERIES = 5.0
#: Probability with which a sound sensor is refused for the size of its residual.
TOO_LARGE = 1e-6
#: Standard deviations within which an estimator of the model's own must come to the optimum.
NEAR = 3.0


class Code(IntFlag):
    """What may speak against an estimate, in the order in which it is said."""

    #: A reading is no number. (One: files are refused, or the residual is NOT_FINITE at the start.)
    READING = auto()
    NOT_FINITE = auto()
    #: As many equations as unknowns, or fewer, and no noise known. (One: fewer are a DataError.)
    NO_REDUNDANCY = auto()
    #: Rank. (Many: singular values from JᵀJ; null and practically null are one.)
    NOT_DETERMINED = auto()
    BOUND = auto()
    NOT_SETTLED = auto()
    #: Second derivatives. (Many: only where steps do not shrink, or the cost is no parabola along
    #: the weakest direction.)
    NO_MINIMUM = auto()
    #: The cost around it. (Many: all directions only as above; no profile of the likelihood, the
    #: standard deviations are printed as they are.)
    MISSHAPEN = auto()
    #: Another solution. (Many: along the weakest direction, of sensors whose least singular value
    #: is below 0.1. Of models that are searched `fleet.valley` says who is asked alone.)
    AMBIGUOUS = auto()
    #: Second order of the readings' noise, of implicit models. (Many: screened first.)
    NOISE = auto()
    #: More noise than a sound sensor has, where the user says how much that is.
    LOUD = auto()
    #: Neighbours alike. (One: standard deviations are widened instead.)
    CORRELATED = auto()
    #: Several valleys, and the best of them fits poorly.
    POOR_VALLEY = auto()
    #: What the model's own start or estimator says, or how far the latter is from the optimum.
    MODEL = auto()


#: Nothing speaks against it.
NOTHING = Code(0)
#: Asked of one sensor alone, of many only where they are calibrated alone.
ONE_ONLY = Code.POOR_VALLEY | Code.MODEL
#: Asked of many alone.
MANY_ONLY = Code.READING | Code.LOUD | Code.CORRELATED
#: Beside these nothing else is worth saying of a sensor among many.
ALONE = (Code.READING, Code.NOT_FINITE, Code.NO_REDUNDANCY, Code.NOT_DETERMINED)


# -- words against ---------------------------------------------------------------------------------


def reading(sample: int) -> str:
    """READING: the first sample that is not finite."""
    return f"sample {sample} is not finite: measure this sensor again"


def not_finite(way: str = "") -> str:
    """NOT_FINITE, at the best point; `way` out, where there is one."""
    return "the residual is not finite at the best point found" + (f"; {way}" if way else "")


def no_redundancy(equations: int, unknowns: int, way: str) -> str:
    """NO_REDUNDANCY, with what shows the noise."""
    return (
        f"no redundancy: {equations} equations for {unknowns} unknowns fit whatever the noise is; "
        f"{way}"
    )


def not_determined(direction: str) -> str:
    """NOT_DETERMINED: a null direction in words."""
    return f"not determined: {direction}"


def practically_not_determined(direction: str, way: str = "") -> str:
    """NOT_DETERMINED, by a direction that is not quite null; `way` out, where there is one."""
    said = f"practically not determined: {direction}; the motion does not separate them"
    return said + (f"; {way}" if way else "")


def count_from(name: str, least: float, most: float, *, settable: bool) -> str:
    """Of an input far from zero for its range, whose zero is `settable` as `at` or the user's."""
    middle = f"{(least + most) / 2:.4g}"
    how = f", --set at={middle}" if settable else f" ({middle})"
    return (
        f"{name} is from {least:.6g} to {most:.6g}, far from zero for its range: "
        f"count it from its middle{how}"
    )


def bound(name: str, lower: float, upper: float, beyond: float | None = None) -> str:
    """BOUND: the unknown, where it may be, and how many standard deviations beyond it would go."""
    asked = "the data ask for a value outside, or do not determine it"
    if beyond is not None:
        asked = (
            f"the data ask for a value {beyond:.3g} standard deviations beyond it: the bound or "
            "the model is wrong; declare other bounds, or hold it with --fix"
        )
    return f"`{name}` ended on its bound ({lower:.4g}, {upper:.4g}): {asked}"


def not_kept(expression: str, value: float, where: str) -> str:
    """BOUND: a constraint that no values keep, what it comes to, and where."""
    return (
        f"a constraint cannot be kept: {expression} comes to {value:.3g}{where}; the equations or "
        "the constraint are wrong"
    )


def pulled(pull: float) -> str:
    """BOUND: how far the data would go without the constraints."""
    return (
        f"the data ask for {pull:.3g} standard deviations away from the constraints: these or the "
        "model are wrong"
    )


def kept(acting: int, every: int, pull: float) -> str:
    """For constraints: how many act, and what the data would rather."""
    return (
        f"constraints are kept, {acting} of {every} act; without them the data would go {pull:.2g} "
        "standard deviations away"
    )


def held(name: str, bound: float, end: float, upper: bool, beyond: float) -> str:
    """For an unknown on its bound: how far inside it may be, and what the data would rather."""
    rather = f"; the data ask for {beyond:.2g} standard deviations more" if beyond >= 0.05 else ""
    return (
        f"`{name}` is on its bound {bound:.4g} ({'above' if upper else 'below'} {end:.3g} with "
        f"95 % confidence{rather}); the other standard deviations hold it there"
    )


def not_settled(step: float, singular: float, direction: str) -> str:
    """NOT_SETTLED: the last step, the smallest singular value and its direction."""
    if singular < WEAK:
        return f"not determined well enough to settle: {direction}; vary the motion"
    return f"not a stationary point: the last step was still {step:.2g} standard deviations long"


def no_minimum(curvature: float | None = None) -> str:
    """NO_MINIMUM; the curvature, where it was computed."""
    value = "not positive" if curvature is None else f"{curvature:.2g}"
    return f"no minimum: the exact curvature is {value} in some direction"


def misshapen(low: float, high: float, where: str = "") -> str:
    """MISSHAPEN: least and largest rise of the cost over a parabola's, and in which direction.

    An infinite one is a point beyond the bounds, or where the residual is not finite.
    """
    place = f" ({where})" if where else ""
    if high == float("inf"):
        return (
            f"not determined well enough: two standard deviations{place} reach beyond the bounds; "
            "vary the motion"
        )
    rise = f"{low:.2g}" + (f" to {high:.2g}" if high > low else "")
    rise = rise if high < FAR else f"over {FAR:.0f}"
    flat = ": the data hardly determine it" if low < SHAPE[0] else ""
    return (
        f"too uncertain for its intervals: two standard deviations away{place} the cost rises "
        f"{rise} times as much as they assume{flat}; vary the motion"
    )


def ambiguous(name: str, here: float, there: float) -> str:
    """AMBIGUOUS: the unknown in which two solutions differ most."""
    return (
        f"two solutions fit alike: `{name}` = {here:.6g} and {there:.6g}; give --start, or vary "
        "the motion"
    )


def ambiguous_along(direction: str) -> str:
    """AMBIGUOUS, found along a direction."""
    return f"another solution fits alike or better, along {direction}"


def noise(second: float) -> str:
    """NOISE: second-order part over the noise."""
    return (
        f"the noise is too large for the curvature of the fitted surface (second-order part "
        f"{second:.2g} of the noise): the readings cover too little, or average more of them"
    )


def loud(sigma: float) -> str:
    """LOUD: standard deviation of the residual."""
    return (
        f"the residual ({sigma:.3g}) is larger than the noise= of a sound sensor: the sensor is "
        "bad, or does not follow the model"
    )


CORRELATED = (
    "residuals of neighbouring samples are alike: a time series, or a missing effect; average "
    "readings at rest, or call calibrate"
)


def poor_valley(starts: int, places: int, over: float) -> str:
    """POOR_VALLEY: starts, the places they ended in, and rows over which residuals are alike."""
    return (
        f"{starts} starts ended in {places} places, and even the best leaves residuals that are "
        f"alike over {over:.2g} rows: there may be a better one, or the model lacks something; "
        "give --start near the solution"
    )


def wandering(starts: int, over: float, worth: float, unknowns: int) -> str:
    """POOR_VALLEY, of a record in time: a residual that wanders, and nothing that agrees."""
    return (
        f"none of {starts} other starts ended here, and the residuals are alike over {over:.2g} "
        f"samples: worth {worth:.2g} independent ones for {unknowns} unknowns, which whatever "
        "wanders could fit; record more motion"
    )


def collapsed(estimator: str) -> str:
    """MODEL: its estimator left the bounds."""
    return f"{estimator}: the solution collapsed; it lies outside the bounds of the model"


def from_optimum(estimator: str, name: str, deviations: float) -> str:
    """MODEL: how far its estimator ended from the optimum; up to NEAR it speaks for it."""
    return (
        f"{estimator}: `{name}` is {deviations:.2g} standard deviations from the certified "
        "least-squares optimum"
    )


# -- words for -------------------------------------------------------------------------------------


def stationary(step: float, at_most: bool = False, kink: str = "") -> str:
    """The step left, in standard deviations; where an unknown is at a kink of the cost, that of a
    slope between those of its two sides."""
    where = f" at a kink over `{kink}`, to both sides of which the cost rises" if kink else ""
    left = f"the step left is {'at most ' * at_most}{step:.1g} standard deviations"
    return f"stationary{where}: {left}"


def minimum(curvature: float | None = None) -> str:
    """Exact curvature over the Gauss-Newton one, where it was computed."""
    if curvature is None:
        return "a minimum: steps shrink, and the cost rises along the weakest direction"
    return f"a minimum: exact curvature at least {curvature:.3g} of the Gauss-Newton one"


def agreement(agreeing: int, others: int) -> str:
    """How many other starts and algorithms found the same."""
    found = "the same optimum from another start or algorithm"
    return f"{found}: {agreeing} of {others}" + "; the others end higher" * (agreeing < others)


def intervals(low: float, high: float) -> str:
    """Least and largest rise of the cost over what the intervals assume."""
    return f"intervals describe the cost two standard deviations away within {low:.2f}-{high:.2f}"


def cautious_intervals(high: float) -> str:
    """The same above LINEAR. (Many say `intervals` there too.)"""
    return (
        "intervals are cautious: two standard deviations away the cost rises up to "
        f"{high:.2g} times as much as they assume"
    )


PROFILED = (
    "the 95 % intervals are those of the likelihood, each unknown profiled: the cost is no "
    "parabola, and standard deviations describe it only roughly"
)
