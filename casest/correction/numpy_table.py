"""Exported operations in NumPy, by name: the text that an exported module holds, and its value."""

from __future__ import annotations

from typing import Any

import numpy as np

from casest.engine import operations


def _text() -> str:
    rows = {o.name: o.numpy for o in operations.OPERATIONS if o.numpy is not None}
    lines = [f'    "{name}": {function},' for name, function in rows.items()]
    return "\n".join(["OPERATIONS: dict[str, Any] = {", *lines, "}\n"])


#: In place of this import, in an exported module: the table itself.
IMPORT = "from casest.correction.numpy_table import OPERATIONS\n"
TEXT = _text()

_found: dict[str, Any] = {"Any": Any, "np": np}
exec(TEXT, _found)  # what runs here is what is exported, to the letter
OPERATIONS: dict[str, Any] = _found["OPERATIONS"]


def _with(operation: operations.Operation) -> Any:
    """One that is not exported, by the function that computes it in a fit."""

    def computed(*operands: Any) -> Any:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in operands))
        out = np.empty(arrays[0].shape)
        operation.kernel(*arrays, out)
        return out

    return computed


OPERATIONS |= {o.name: _with(o) for o in operations.OPERATIONS if o.numpy is None}
#: How many operands each has.
ARITIES = {o.name: o.arity for o in operations.OPERATIONS}
