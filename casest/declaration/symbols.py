"""Signals, parameters and constants: the symbol table that a model's signature declares."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from casest.declaration.shapes import Array, Shape, array_shape
from casest.declaration.uncertainty import Uncertainty, stated
from casest.errors import DeclarationError

Scope = Literal["all", "run"]


@dataclass(frozen=True)
class Signal:
    """A measured input of a model, one value per sample.

    `size` is the number of numbers per sample (9 for a rotation matrix, row by row);
    `unit` is None where any unit will do (the data's own is then kept).
    `held`: of an estimator in motion, it keeps its value until the next sample, as a command does;
    else it is a straight line between two. `std` of one reading, a number for each of `size`, in
    `unit`; None where nothing is known.
    """

    name: str
    size: int
    unit: str | None
    kind: Literal["plain", "rotation"] = "plain"
    held: bool = False
    wanders: bool = False
    std: tuple[float, ...] | None = None


def signal(
    shape: int | str = 1,
    unit: str | None = None,
    *,
    held: bool = False,
    wanders: bool = False,
    std: Any = None,
) -> Any:
    """Declare a measured input: `signal("s")`, `signal(3, "m/s^2")`, `signal(3)` (any unit).

    `held`: an input of an estimator in motion that keeps its value between samples (a command to a
    motor) in place of a straight line. `wanders`: its mean may wander while the sensor lies still,
    as a gyroscope's does; rest is looked for in its noise alone. `std`: of one reading, in the
    signal's unit, one number or one for each component: what `--sensor-noise` says without it.
    """
    if isinstance(shape, str) and unit is not None:
        raise DeclarationError(
            f"signal({shape!r}, {unit!r}): how many numbers it has comes before its unit, as in "
            f"signal({unit!r}, {shape!r})"
        )
    size, own = (1, shape) if isinstance(shape, str) else (shape, unit)
    known = None if std is None else tuple(map(float, stated(std, (size,)).std))
    return Signal("", size, own, held=held, wanders=wanders, std=known)


def attitude() -> Any:
    """Declare a measured rotation, body to reference frame: a 3x3 matrix in the model's body.

    Data give it as `roll pitch yaw` (intrinsic Z-Y-X) or as `qw qx qy qz`.
    """
    return Signal("", 9, None, kind="rotation")


@dataclass(frozen=True)
class Parameter:
    """An unknown of a model.

    `units` has one unit per stored entry; `start` is a packed value or None (then the shape's
    neutral value, moved inside the bounds); `lower` and `upper` bound each stored entry;
    `scope` says whether all runs share one value or each run has its own.
    """

    name: str
    shape: Shape
    units: tuple[str, ...]
    start: tuple[float, ...] | None
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    scope: Scope = "all"

    @property
    def unit(self) -> str:
        """The unit, where all entries have the same; else all of them, comma-separated."""
        return self.units[0] if len(set(self.units)) == 1 else ", ".join(self.units)

    @property
    def entry_names(self) -> tuple[str, ...]:
        """Names of the stored entries: `offset[0]`, `scale[1,0]`, `tilt`."""
        return self.shape.entry_names(self.name)

    def start_value(self) -> Array:
        """The declared start (packed), or the neutral value, strictly inside the bounds."""
        if self.start is not None:
            return np.array(self.start)
        value = self.shape.pack(self.shape.default())
        lower, upper = np.array(self.lower), np.array(self.upper)
        finite = np.isfinite(lower) & np.isfinite(upper)
        middle = np.where(
            finite, 0.5 * (np.where(finite, lower, 0) + np.where(finite, upper, 0)), 0
        )
        inside = np.where(finite, middle, np.where(np.isfinite(lower), lower + 1.0, upper - 1.0))
        return np.where((value > lower) & (value < upper), value, inside)


@dataclass(frozen=True)
class Constant:
    """A plain number (or array) of a model, with its unit."""

    name: str
    value: tuple[float, ...]
    unit: str
    dims: tuple[int, ...] = ()
    #: Declared unit such as `[v]`, where the user has stated another.
    like: str = ""
    #: The declaration as a parameter it was fixed from, so that it can be freed again.
    frozen: Parameter | None = field(default=None, compare=False)
    #: Of its entries, or of the coordinates of the parameter it was fixed from; None: it is exact.
    uncertainty: Uncertainty | None = None
    #: Is it a choice, as where something is counted from? Then it cannot be wrong.
    chosen: bool = False

    @property
    def array(self) -> Array:
        """The value with its shape."""
        return np.array(self.value).reshape(self.dims)

    @property
    def std(self) -> Array | None:
        """Standard deviation of every entry, shaped like the value; None where it is exact.

        Of a direction or a rotation, which have no entries of their own, also None.
        """
        if self.uncertainty is None or (self.frozen is not None and self.frozen.shape.curved):
            return None
        if self.frozen is not None:
            return self.frozen.shape.unpack(self.uncertainty.std)
        return self.uncertainty.std.reshape(self.dims)


def param(
    shape: int | tuple[int, ...] | Shape | str | None = None,
    unit: str | tuple[str, ...] = "",
    *,
    start: Any = None,
    bounds: tuple[Any, Any] | None = None,
    per: Literal["run"] | None = None,
) -> Any:
    """Declare an unknown.

    `param("rad")` is a scalar, `param(3, "m/s^2")` a vector, `param(lower(3))` a triangular
    matrix, `param(unit_vector)` a direction; `unit` may be a tuple with one unit per entry, and
    `[v]` in a unit stands for the unit of the signal, constant or quantity `v`. `bounds` are
    (lower, upper), numbers or arrays of the value's shape, None for no end. `per="run"`: each run
    has its own.
    """
    if isinstance(shape, str):
        if unit:
            raise DeclarationError(
                f"param({shape!r}, {unit!r}): its shape comes before its unit, as in "
                f"param({unit!r}, {shape!r})"
            )
        form, unit = array_shape(None), shape
    else:
        form = array_shape(shape)
    if form.kind == "each":
        return Undecided(unit if isinstance(unit, str) else unit[0], start, bounds, per)
    return make_parameter(form, unit, start, bounds, "run" if per == "run" else "all")


#: What a model's signature declares.
Symbol = Signal | Parameter | Constant


@dataclass(frozen=True)
class Undecided:
    """A parameter of an effect whose length is that of the quantity it acts on."""

    unit: str
    start: Any
    bounds: Any
    per: Literal["run"] | None

    def decided(self, dims: tuple[int, ...]) -> Parameter:
        """The parameter for a quantity with value of shape `dims`."""
        scope: Scope = "run" if self.per == "run" else "all"
        one = np.ndim(self.start) == 0 and self.start is not None
        start = np.full(dims, self.start) if one else self.start
        return make_parameter(Shape("array", dims), self.unit, start, self.bounds, scope)


def make_parameter(
    shape: Shape, unit: str | tuple[str, ...], start: Any, bounds: Any, scope: Scope
) -> Parameter:
    """A checked, still nameless parameter."""
    units = (unit,) * shape.size if isinstance(unit, str) else tuple(unit)
    if len(units) != shape.size:
        raise DeclarationError(
            f"{len(units)} units for {shape.size} entries: give one, or one each"
        )
    lower, upper = _bounds(shape, bounds)
    packed = None
    if start is not None:
        packed = tuple(map(float, shape.pack(start)))
        outside = [i for i in range(shape.size) if not lower[i] <= packed[i] <= upper[i]]
        if outside:
            i = outside[0]
            raise DeclarationError(
                f"start {packed[i]:g} is outside bounds ({lower[i]:g}, {upper[i]:g})"
            )
    return Parameter("", shape, units, packed, lower, upper, scope)


def _bounds(shape: Shape, bounds: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    lower, upper = np.full(shape.size, -np.inf), np.full(shape.size, np.inf)
    if shape.positive_diagonal:
        on_diagonal = [len(set(i)) == 1 for i in shape.entries]
        lower[np.array(on_diagonal)] = 0.0
    if bounds is not None:
        if shape.curved:
            raise DeclarationError(f"a {shape.kind} parameter has no bounds: it lives on a sphere")
        try:
            low, high = bounds
        except (TypeError, ValueError):
            raise DeclarationError(f"bounds {bounds!r} are not a pair (lower, upper)") from None
        lower = shape.spread(-np.inf if low is None else low)
        upper = shape.spread(np.inf if high is None else high)
    bad = np.flatnonzero(~(lower < upper))
    if bad.size:
        raise DeclarationError(
            f"bounds ({lower[bad[0]]:g}, {upper[bad[0]]:g}) leave no room: "
            "lower must be below upper"
        )
    return tuple(map(float, lower)), tuple(map(float, upper))


def constant(
    value: Any,
    unit: str = "",
    *,
    std: Any = None,
    freedom: float = np.inf,
    chosen: bool = False,
) -> Any:
    """Declare a plain number (or array) of the model with its unit: `constant(0.28, "m")`.

    `std` is its standard uncertainty in the same unit, one number or one for each entry:
    `constant(0.28, "m", std=0.001)`. It is carried into every estimate. `freedom`: degrees of
    freedom of that standard uncertainty, where it is an estimate itself (JCGM 100, G.4). `chosen`:
    it is a choice, as the temperature from which another one is counted, and no error of it is
    looked for.
    """
    if std is None and np.isfinite(freedom):
        raise DeclarationError(f"freedom {freedom!r} is that of a std, and there is none: give std")
    array = np.asarray(value, dtype=float)
    if not np.all(np.isfinite(array)):
        raise DeclarationError(f"constant {value!r} is not finite")
    known = None if std is None else stated(std, array.shape, freedom)
    values = tuple(map(float, array.ravel()))
    return Constant("", values, unit, array.shape, uncertainty=known, chosen=chosen)


def named(declaration: Any, name: str) -> Any:
    """The declaration under its name."""
    return replace(declaration, name=name)
