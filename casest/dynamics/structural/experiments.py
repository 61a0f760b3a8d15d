"""Several records of one model: the same parameters, other states and inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from casest.dynamics.declare import Constraint, Dynamics, Measured, Motion
from casest.errors import UsageError

#: The names that some names have in all records.
Copies = Callable[[Sequence[str]], tuple[str, ...]]


def several(model: Dynamics, count: int, per_run: Sequence[str] = ()) -> tuple[Dynamics, Copies]:
    """A model of `count` records at once. Parameters, states without a rate and noise, are shared
    but for `per_run`."""
    if count < 1:
        raise UsageError(f"{model.name}: experiments={count}: there must be one at least")
    f, where = model.traced.f, model.slices()
    still = [s.name for s in model.states if not s.intensity and f[where[s.name]].is_zero()]
    shared = set(still) - set(per_run)
    names = [*(s.name for s in model.signals), *(s.name for s in model.states)]
    own = [name for name in names if name not in shared]

    def named(name: str, k: int) -> str:
        return f"{name} ({k})" if k > 1 and name in own else name

    def copies(some: Sequence[str]) -> tuple[str, ...]:
        every = [named(name, k) for k in range(1, count + 1) for name in some]
        return tuple(dict.fromkeys(every))

    if count == 1:
        return model, copies

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

    signals, states = repeated(model.signals), repeated(model.states)
    return replace(model, function=function, signals=signals, states=states), copies
