"""An effect that a record could not show: of its typical size, and absent, as two rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casest.data.run import Run
from casest.declaration.effect import OVER_TIME
from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.candidates.typical import largest_of, typical_sizes
from casest.diagnose.sensor import Sensor
from casest.diagnose.sensor.fits import problem_of
from casest.effects import CATALOGUE
from casest.effects.placing import prepared
from casest.errors import UsageError
from casest.plan.rivals.rivals import Rival, rival_of

#: The rival without the effect.
ALONE = "the model alone"


def shown_or_not(
    model: Model, values: Mapping[str, Array], runs: Sequence[Run], name: str, sigma: Array
) -> list[Rival]:
    """The model with the effect `name` held at a typical size, and the model alone; both fitted.

    UsageError where the effect does not apply, acts on the sequence of samples, or has no size that
    is typical.
    """
    sensor = Sensor(model, prepared(model, tuple(runs)), CATALOGUE, frozenset([name]))
    base = sensor.fitted(model, model.among(values))
    if base is None:
        raise UsageError(f"{model.name}: its fit to the record fails; close the loop again")
    tried = {t.what.label: t.what for t in sensor.trials(base)}
    found = [what for what in tried.values() if what.among([name])]
    if not found:
        raise UsageError(f"--show {name}: of this record there is {', '.join(tried)}")
    largest = largest_of(*problem_of(base, sensor.runs))
    with_it, size = _of_typical_size(found[0], model, largest)
    if any(a.kind in OVER_TIME for a in with_it.effects):
        raise UsageError(f"--show {name}: it acts on the sequence of samples: one shows none of it")
    fit = sensor.fitted(with_it, base.values)
    if fit is None:
        raise UsageError(f"--show {name}: with {size} the record cannot be fitted")
    label = f"{found[0].label} ({size})"
    return [rival_of(label, fit, sensor.runs, sigma), rival_of(ALONE, base, sensor.runs, sigma)]


def _of_typical_size(
    candidate: Candidate, model: Model, largest: Mapping[str, float]
) -> tuple[Model, str]:
    """The model with the effect held, and `k = 0.001`."""
    extended = candidate.added_to(model)
    parameters = candidate.parameters(extended)
    typical = typical_sizes(candidate, parameters, model, largest)
    if typical is None or candidate.freed:
        raise UsageError(f"--show {candidate.label}: nobody knows a size of it that is typical")
    ends = np.cumsum([p.shape.coordinates for p in parameters])[:-1]
    parts = np.split(np.asarray(typical, float), ends)
    held = {p.name: p.shape.unpack(own) for p, own in zip(parameters, parts, strict=True)}
    words = ", ".join(
        f"{p.name.rpartition('.')[2]} = {own[0]:.3g}"
        for p, own in zip(parameters, parts, strict=True)
    )
    return extended.having(**held), words
