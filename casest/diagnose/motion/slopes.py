"""What numbers of effects do to an estimator's rates and outputs: F = ∂f/∂k and G = ∂h/∂k.

Candidates at zero change nothing, so that many are traced as one model: the slopes in the numbers
of each are those that it has alone. A function is made once for the same effects at other numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.declaration.tracing import flat
from casest.dynamics.declare import Dynamics
from casest.effects.moving import Candidate, extended
from casest.engine import Columns, Replay

Added = Sequence[tuple[Candidate, Array]]


def batches(added: Added, tried: Sequence[Candidate], most: int) -> Iterator[list[int]]:
    """Which of `tried` have their slopes taken together: of one place, `most` numbers at once.

    Those that are added, or are held at something, each alone.
    """
    there, together = [c for c, _ in added], dict[str, list[int]]()
    for k, c in enumerate(tried):
        if c.held or any(c is other for other in there):
            yield [k]
            continue
        own = together.setdefault(c.place, [])
        if own and sum(tried[i].size for i in own) + c.size > most:
            yield together.pop(c.place)
            own = together.setdefault(c.place, [])
        own.append(k)
    yield from together.values()


def slopes(
    model: Dynamics,
    added: Added,
    wanted: Sequence[Candidate],
    run: Run,
    along: Array,
    tried: Sequence[Candidate] = (),
) -> tuple[Array, Array]:
    """F (N, n, p) and G (N, m, p) in the numbers of the `wanted` ones along states of the filter
    (N, ≥ n), those that are `added` at their values."""
    several = [c for c in wanted if all(c is not other for other, _ in added)]
    own = [v for c, v in added for w in wanted if c is w] or [np.zeros(c.size) for c in wanted]
    others = [
        (c, v)
        for c, v in added
        if all(c is not w for w in wanted) and (c not in tried or np.any(v))
    ]
    assert len(several) in (0, len(wanted))
    replay, grown = _function(
        model, *(tuple(map(_plain, g)) for g in ([c for c, _ in others], wanted))
    )
    held = [[float(v) for _, v in c.held] for c in (*(c for c, _ in others), *wanted)]
    numbers = np.concatenate([*(v for _, v in others), *own, *held])
    n, x = model.size, np.ascontiguousarray(along[:, : model.size])
    F, G = replay(numbers, Columns([x, *(run.signals[s.name] for s in grown.signals)]))
    wide = along.shape[1] - n  # states of coloured noise, which nothing else drives
    return np.pad(F, ((0, 0), (0, wide), (0, 0))), G


def _plain(candidate: Candidate) -> Candidate:
    """What its slopes are made of: not the values that it is held at, nor sizes."""
    held = tuple((n, 0.0) for n, _ in candidate.held)
    numbers = tuple(replace(n, typical=0.0) for n in candidate.numbers)
    return replace(candidate, numbers=numbers, held=held, trials=1.0)


@lru_cache(maxsize=32)
def _function(
    model: Dynamics, others: tuple[Candidate, ...], wanted: tuple[Candidate, ...]
) -> tuple[Replay, Dynamics]:
    """(numbers of the others and of the wanted ones, what each is held at; sample) -> F, G; and the
    model with all of them."""
    every = (*others, *wanted)
    held = [ca.SX.sym("held", len(c.held)) for c in every]
    k = [ca.SX.sym("k", c.size) for c in every]
    symbolic = [
        replace(c, held=tuple((n, h[i]) for i, (n, _) in enumerate(c.held)))
        for c, h in zip(every, held, strict=True)
    ]
    count = len(others)
    grown = extended(model, [*zip(symbolic[:count], k[:count], strict=True),
                             *((c, None) for c in symbolic[count:])])  # fmt: skip
    t, n = grown.traced, model.size
    at: list[Any] = [ca.SX(c.size, 1) for c in wanted] if len(wanted) > 1 else k[count:]
    found = ca.substitute([t.A[:n, n:], t.C[:, n:]], [t.x[n:]], [ca.densify(ca.vertcat(*at))])
    sample = ca.vertcat(t.x[:n], *[flat(t.symbols[s.name]) for s in grown.signals])
    parameters = ca.vertcat(*k, *held)
    function = ca.Function("slopes", [parameters, sample], [ca.densify(e) for e in found],
                           ["parameters", "sample"], ["F", "G"])  # fmt: skip
    return Replay(function), grown
