"""Why what a refit found is not what its name says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.diagnose.candidates.candidates import Candidate
from casest.diagnose.levels import LEVELS
from casest.diagnose.protocol.state import ANOTHER


def another(model: Model, values: Mapping[str, Array], declared: Model) -> tuple[str, str]:
    """Label of an effect that is not what its name says at these values, and why; else empty.

    Of axes that have sizes of their own the largest decides. What the `declared` model has already
    is the user's word.
    """
    given = {a.label for a in declared.effects}
    for attached in (a for a in model.effects if a.label not in given):
        for name, (least, most) in attached.effect.within:
            own = [v for n, v in values.items() if _is_of(n, attached.label, name)]
            size = max((float(np.max(v)) for v in own), default=most)
            if not least <= size <= most:
                beyond = f"above {most:g}" if size > most else f"below {least:g}"
                why = f"{attached.label} would have {name} = {size:.3g}, {beyond}"
                return attached.label, f"{why}: {ANOTHER}"
    return "", ""


def _is_of(full: str, label: str, name: str) -> bool:
    """`creep.k`, and `creep.k_1` where the axes have sizes of their own."""
    own = full.removeprefix(f"{label}.")
    return own != full and own.partition("_")[0] == name


def at_one_input(what: Candidate, beyond: Array) -> str:
    """Why a cut-off is none: one value alone lies beyond it, which may be off itself; else empty.

    `beyond`: what it takes from each reading (N, m).
    """
    size = np.abs(beyond).max(initial=0.0)
    if size > 0 and len(np.unique(np.round(beyond[beyond != 0] / size, 6))) < 2:
        return f"one input alone lies beyond the level of {what.label}"
    return ""


def too_slow(
    values: Mapping[str, Array], added: Sequence[Candidate], spans: Sequence[float]
) -> str:
    """Why records of these spans (s) are too short for a memory: nobody saw it fade; else empty."""
    for what in added:
        profile = what.effect.profile if what.effect is not None else ()
        for name in (n for n, kind in profile if kind == "timescale"):
            value = float(np.max(values.get(f"{what.label}.{name}", 0.0)))
            if value > max(spans, default=np.inf) / LEVELS.fades:
                return f"its refit fails: {name} = {value:.3g} s is over half of the record"
    return ""
