"""Whether the unknowns of an effect are a matter of axes."""

from __future__ import annotations

from collections.abc import Sequence

from casest.declaration.symbols import Parameter


def axes_of(own: Sequence[Parameter]) -> int:
    """How many axes the parameters have, one number each; 0 where that is no matter of axes."""
    vectors = all(p.shape.kind == "array" and len(p.shape.dims) == 1 for p in own)
    sizes = {p.shape.size for p in own}
    per_run = any(p.scope == "run" for p in own)
    return 0 if not vectors or per_run or len(sizes) != 1 else next(iter(sizes))
