"""`calibrate`, `attempt` and `close` as Python calls them: on runs, files, data frames, arrays."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

from casest.data.finding import Choice
from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.diagnose import loop
from casest.effects import CATALOGUE
from casest.errors import NotTrusted
from casest.estimate import calibrate as fitting
from casest.interface.estimate import Closing, Estimate
from casest.interface.reading import Data, Reading, model_and_runs
from casest.interface.sensor_noise import SensorNoise
from casest.interface.words import as_python_says


def calibrate(
    model: Model | str,
    data: Data,
    *,
    columns: Choice | None = None,
    units: Mapping[str, str] | None = None,
    scales: Mapping[str, str] | None = None,
    rate: float | None = None,
    at_rest: bool | Sequence[str] = False,
    time_zero: Literal["first", "column"] = "first",
    sensor_noise: SensorNoise | None = None,
    start: Mapping[str, Any] | None = None,
    solver: str = "ipopt",
    seed: int = 0,
) -> Estimate:
    """Fit the model; return an estimate whose certificate is trusted.

    `model` is declared, or named as on the command line. `data` are runs, files, data frames
    (pandas, polars, PyArrow, xarray), mappings of arrays by name or arrays (N, k); several are
    several runs. `columns`, `units`, `scales`, `rate`, `at_rest` and `time_zero` say how they are
    read, as in `load_runs`: columns={"v": ["ax", "ay", "az"]}, units={"v": "g"}. `sensor_noise`
    states the standard deviation of one reading by signal: {"v": "4.5 mg"}, {"v": 0.02} in the
    model's unit, {"x": "u_x"} a column, one by axis, or a covariance between axes.

    `start` overrides the automatic start values; `solver` is one of SOLVERS or an estimator of
    the model's own (`closed-form`), which is judged against the least-squares optimum. Raises
    NotTrusted, with the refused estimate as its attribute `estimate`, where no answer deserves
    belief; DataError where there are fewer residuals than unknowns, or data cannot be used.
    """
    reading = Reading(columns=columns, units=units, scales=scales, rate=rate, at_rest=at_rest,
                      time_zero=time_zero)  # fmt: skip
    with _told(reading):
        found, runs = model_and_runs(model, data, reading, sensor_noise)
        fit = fitting.calibrate(found, runs, start=start, solver=solver, seed=seed)
        return Estimate.of(fit, reading)


def attempt(
    model: Model | str,
    data: Data,
    *,
    columns: Choice | None = None,
    units: Mapping[str, str] | None = None,
    scales: Mapping[str, str] | None = None,
    rate: float | None = None,
    at_rest: bool | Sequence[str] = False,
    time_zero: Literal["first", "column"] = "first",
    sensor_noise: SensorNoise | None = None,
    start: Mapping[str, Any] | None = None,
    solver: str = "ipopt",
    seed: int = 0,
    intervals: bool = True,
) -> Estimate:
    """The same as `calibrate`, but a refused estimate is returned instead of raised.

    Without `intervals`, those that only the likelihood can give are left out: each takes fits. So
    is the search for a better valley: the start is taken to lie in the right one.
    """
    reading = Reading(columns=columns, units=units, scales=scales, rate=rate, at_rest=at_rest,
                      time_zero=time_zero)  # fmt: skip
    with _told(reading):
        found, runs = model_and_runs(model, data, reading, sensor_noise)
        fit = fitting.attempt(
            found, runs, start=start, solver=solver, seed=seed, intervals=intervals
        )
        return Estimate.of(fit, reading)


def close(
    model: Model | str,
    data: Data,
    *,
    columns: Choice | None = None,
    units: Mapping[str, str] | None = None,
    scales: Mapping[str, str] | None = None,
    rate: float | None = None,
    at_rest: bool | Sequence[str] = False,
    time_zero: Literal["first", "column"] = "first",
    sensor_noise: SensorNoise | None = None,
    catalogue: Sequence[Effect] | None = None,
    start: Mapping[str, Any] | None = None,
    known: Collection[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
) -> Closing:
    """Fit, trace the residual to effects of the catalogue, add those that held-out data confirm.

    `model`, `data` and how they are read: as in `calibrate`. Where several causes explain the data
    alike, those that are `known` to be there come first: by name, or as `temperature_bias(temp)`.
    `catalogue`: effects to be tried, if not all that are shipped. Where nothing can be held out,
    nothing is added, and `refused` says so. Raises NotTrusted, with the refused estimate, where the
    declared model itself has no trustworthy fit, and what it lacks is not found either.
    """
    reading = Reading(columns=columns, units=units, scales=scales, rate=rate, at_rest=at_rest,
                      time_zero=time_zero)  # fmt: skip
    with _told(reading):
        found, runs = model_and_runs(model, data, reading, sensor_noise)
        tried = CATALOGUE if catalogue is None else catalogue
        closed = loop.close(
            found, runs, catalogue=tried, start=start, known=known, seed=seed, say=say
        )
        return Closing.of(closed, reading)


@contextmanager
def _told(reading: Reading) -> Iterator[None]:
    """Errors in Python's words; a refused estimate is one that prints and saves."""
    with as_python_says():
        try:
            yield
        except NotTrusted as error:
            if error.estimate is not None:
                error.estimate = Estimate.of(error.estimate, reading)
            raise
