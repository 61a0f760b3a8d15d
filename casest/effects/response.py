"""How a sensor answers: cross-axis sensitivity, nonlinearity, saturation."""

from __future__ import annotations

from casest.declaration.effect import effect
from casest.declaration.physics import SX, dot, fabs, fmax, inf, sign, vertcat
from casest.declaration.shapes import each
from casest.declaration.symbols import constant, param
from casest.errors import UsageError


def three_axes(u: SX) -> None:
    """Refuse a quantity of another number of axes."""
    if u.numel() != 3:
        raise UsageError(f"not applicable: it needs three axes, and there are {u.numel()}")


def _two_axes(u: SX) -> None:
    if u.numel() != 2:
        raise UsageError(f"not applicable: it needs two or three axes, and there are {u.numel()}")


#: All of a matrix, row by row.
MATRIX = "u + K·u, K of three rows: k[0] k[1] k[2]; k[3] k[4] k[5]; k[6] k[7] k[8]"
IN_A_PLANE = "u + K·u, K of two rows: k[0] k[1]; k[2] k[3]"


@effect(on="input", formula="y + k·x")
def _crossed_in_a_plane(u: SX, *, k: SX = param()) -> SX:
    """Two axes that are not orthogonal: y sees k of x."""
    _two_axes(u)
    return vertcat(u[0], u[1] + k * u[0])


@effect(on="input", formula=IN_A_PLANE)
def _matrix_in_a_plane(u: SX, *, k: SX = param(4)) -> SX:
    """Both axes see each other, each with a gain of its own: K row by row."""
    _two_axes(u)
    return u + vertcat(*(dot(k[row : row + 2], u) for row in (0, 2)))


@effect(
    on="input",
    typical={"k": 0.01},
    shown_by="a second mounting or tilt (wheel), poses that cover the sphere (norm)",
    formula="y + k[0]·x; z + k[1]·x + k[2]·y",
    otherwise=_crossed_in_a_plane,
)
def cross_axis(u: SX, *, k: SX = param(3)) -> SX:
    """Axes that are not orthogonal: y sees k[0] of x; z sees k[1] of x and k[2] of y.

    Three terms, because a rotation is the mounting's (Burkhard et al., eq. 1: M lower triangular).
    """
    three_axes(u)
    return vertcat(u[0], u[1] + k[0] * u[0], u[2] + k[1] * u[0] + k[2] * u[1])


# Without a typical size, as gain_matrix: what a declared gain takes up is not hidden in it.
@effect(
    on="input",
    shown_by="inputs of known size along each axis",
    formula="u·(1 + k)",
)
def axis_gain(u: SX, *, k: SX = param(each)) -> SX:
    """Each axis has a gain of its own."""
    return u * (1 + k)


@effect(
    on="input",
    shown_by="known directions that cover the sphere (a norm sees six of the nine)",
    formula=MATRIX,
    otherwise=_matrix_in_a_plane,
    only_of=("T",),
)
def soft_iron(u: SX, *, k: SX = param(9)) -> SX:
    """Every axis sees every other: iron that turns with the sensor bends the field into them.

    K row by row (Vasconcelos et al. 2011, C_SI − 1), gains on its diagonal. As much of it is
    determined as the declared gains, axes and mounting leave.
    """
    return _matrix(u, k)


@effect(
    on="input",
    shown_by="known directions that cover the sphere (a norm sees six of the nine)",
    formula=MATRIX,
    otherwise=_matrix_in_a_plane,
    foreign_to=("T",),  # there it is soft_iron
)
def gain_matrix(u: SX, *, k: SX = param(9)) -> SX:
    """Every axis sees every other, each with a gain of its own: scale, skew and turn at once.

    K row by row, gains on its diagonal. As much of it is determined as the declared gains, axes
    and mounting leave.
    """
    return _matrix(u, k)


def _matrix(u: SX, k: SX) -> SX:
    three_axes(u)
    return u + vertcat(*(dot(k[row : row + 3], u) for row in (0, 3, 6)))


@effect(
    on="input",
    typical={"k": 1e-3},
    shown_by="inputs of both signs on each axis",
    formula="u + k·|u|",
)
def gain_by_sign(u: SX, *, k: SX = param(each)) -> SX:
    """A gain of 1 + k for inputs above zero, 1 − k below: scale factor asymmetry (IEEE Std 528)."""
    return u + k * fabs(u)


@effect(
    on="input",
    typical={"k": 2e-4},
    shown_by="inputs of several sizes and both signs on each axis",
    formula="u + k·(u − at)²",
    numbers={"at": "middle"},
)
def quadratic(u: SX, *, k: SX = param(each, "1/[u]"), at: SX = constant(0.0)) -> SX:
    """Second-order response of each axis (Batista, eq. 2).

    About the middle `at` of a recorded input that is far from zero, as a temperature in kelvin, and
    so are the others: the gain is that in the middle, not at a zero that nothing came near to.
    """
    return u + k * (u - at) ** 2


@effect(
    on="input",
    typical={"k": 2e-4},
    shown_by="inputs of several sizes and both signs on each axis",
    formula="u + k·(u − at)·|u − at|",
    numbers={"at": "middle"},
)
def signed_quadratic(u: SX, *, k: SX = param(each, "1/[u]"), at: SX = constant(0.0)) -> SX:
    """Odd second-order response k·u·|u| (IEEE Std 1293, odd quadratic), or about `at`."""
    return u + k * (u - at) * fabs(u - at)


@effect(
    on="input",
    typical={"k": 2e-5},
    shown_by="inputs up to the end of the range, of both signs",
    formula="u + k·(u − at)³",
    numbers={"at": "middle"},
)
def cubic(u: SX, *, k: SX = param(each, "1/([u])^2"), at: SX = constant(0.0)) -> SX:
    """Third-order response of each axis (IEEE Std 1293, K3), or about `at`."""
    return u + k * (u - at) ** 3


@effect(
    on="input",
    typical={"k": 2e-5},
    shown_by="inputs up to the end of the range, of both signs",
    formula="u + k·|u − at|³",
    numbers={"at": "middle"},
)
def signed_cubic(u: SX, *, k: SX = param(each, "1/([u])^2"), at: SX = constant(0.0)) -> SX:
    """Even third-order response k·|u|³, or about `at`."""
    return u + k * fabs(u - at) ** 3


@effect(
    on="input",
    typical={"k": 2e-4},
    shown_by="poses between the axes: two axes loaded at once",
    formula="x + k[0]·y·z; y + k[1]·x·z; z + k[2]·x·y",
)
def cross_quadratic(u: SX, *, k: SX = param(3, "1/[u]")) -> SX:
    """Products of the two other axes in each axis (IEEE Std 1293, cross-coupling)."""
    three_axes(u)
    return u + vertcat(k[0] * u[1] * u[2], k[1] * u[0] * u[2], k[2] * u[0] * u[1])


@effect(
    on="input",
    typical={"width": 0.02},
    profile={"width": "band"},
    shown_by="inputs close to zero, of both signs",
    formula="sign(u)·max(|u| − width, 0)",
)
def dead_band(u: SX, *, width: SX = param(each, "[u]", bounds=(0, None))) -> SX:
    """An input within ±width does nothing, and lacks it beyond: a motor's or a spring's breakaway.

    Unlike a dead zone, what is read of nothing is the offset.
    """
    return sign(u) * fmax(fabs(u) - width, 0)


@effect(
    on="output",
    typical={"share": 1.0},
    profile={"level": "level"},
    plain={"share": 1.0},
    null={"level": inf},
    shown_by="readings that reach the end of the range",
    formula="y − share·sign(y)·max(|y| − level, 0)",
    # Where less than half is lost the reading goes on: a bend with a kink; where more than all, it
    # turns back.
    within={"share": (0.5, 1.5)},
)
def saturation(y: SX, *, share: SX = param(each, bounds=(0, None)), level: SX = param("[y]")) -> SX:
    """Readings beyond ±level are cut off (share 1), or compressed (share below 1)."""
    return y - share * sign(y) * fmax(fabs(y) - level, 0)


@effect(
    on="output",
    typical={"share": 1.0},
    profile={"level": "floor"},
    plain={"share": 1.0},
    null={"level": -inf},
    shown_by="readings that reach the lower end of the range",
    formula="y + share·max(level − y, 0)",
    within={"share": (0.5, 1.5)},  # as above
)
def floor(y: SX, *, share: SX = param(each, bounds=(0, None)), level: SX = param("[y]")) -> SX:
    """Readings below a level are cut off (share 1), or compressed: the lower end of a range."""
    return y + share * fmax(level - y, 0)


@effect(
    on="output",
    typical={"width": 0.02},
    profile={"width": "threshold"},
    shown_by="readings close to zero, of both signs",
    formula="sign(y)·max(|y| − width, 0)",
)
def dead_zone(y: SX, *, width: SX = param(each, "[y]")) -> SX:
    """Readings stay at zero up to ±width, and lack it beyond: friction, a comparator's threshold.

    A negative width is a jump at zero instead (crossover distortion).
    """
    return sign(y) * fmax(fabs(y) - width, 0)
