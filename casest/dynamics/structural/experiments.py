"""Several records of one model: the same parameters, other states and inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from casest.dynamics.declare import Constraint, Dynamics, Measured, Motion
from casest.errors import UsageError


def several(model: Dynamics, count: int) -> Dynamics:
    """A model of `count` records at once. Parameters are states without a rate and noise."""
    if count < 1:
        raise UsageError(f"{model.name}: experiments={count}: there must be one at least")
    if count == 1:
        return model
    t, where = model.traced, model.slices()
    shared = {
        s.name for s in model.states if not s.intensity and t.f[where[s.name]].is_zero()
    }  # fmt: skip
    names = [*(s.name for s in model.signals), *(s.name for s in model.states)]
    own = [name for name in names if name not in shared]

    def named(name: str, k: int) -> str:
        return f"{name} ({k})" if k > 1 and name in own else name

    def function(**given: Any) -> Motion:
        rates: dict[str, Any] = {}
        outputs: list[Measured] = []
        constraints: list[Constraint] = []
        for k in range(1, count + 1):
            here = {n: given[named(n, k)] for n in names}
            here.update({c.name: given[c.name] for c in model.constants})
            one = model.function(**here)
            rates.update({named(n, k): rate for n, rate in one.rates.items()})
            outputs += one.outputs
            constraints += one.constraints
        return Motion(rates=rates, outputs=tuple(outputs), constraints=tuple(constraints))

    def repeated(parts: Any) -> Any:
        found = [
            replace(p, name=named(p.name, k))
            for k in range(1, count + 1) for p in parts if k == 1 or p.name in own
        ]  # fmt: skip
        return tuple(found)

    return replace(
        model, function=function, signals=repeated(model.signals), states=repeated(model.states)
    )
