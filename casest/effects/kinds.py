"""Which kinds of sensor have an effect, by what they read."""

from __future__ import annotations

from collections.abc import Sequence

from casest.declaration.effect import Effect
from casest.declaration.model import Model
from casest.units import known, size


def readings(model: Model) -> tuple[str, ...]:
    """Signals that are measured, as far as the body says: of an implicit residual every vector."""
    return model.traced.readings or tuple(s.name for s in model.signals if s.kind == "plain")


def foreign(effect: Effect, units: Sequence[str | None]) -> str:
    """Why no sensor that reads these units has the effect, in words; empty where one may.

    All of several readings must be of such a kind.
    """
    read = " and ".join(dict.fromkeys(u or "1" for u in units))
    if effect.only_of and not _all_of(effect.only_of, units):
        return f"only sensors that read {' or '.join(effect.only_of)} have it; ask for it by name"
    if effect.foreign_to and _all_of(effect.foreign_to, units):
        return f"no sensor that reads {read} is known to have it; ask for it by name"
    return ""


def _all_of(kinds: Sequence[str], units: Sequence[str | None]) -> bool:
    of = {size(kind)[1] for kind in kinds}
    return bool(units) and all(u and known(u) and size(u)[1] in of for u in units)
