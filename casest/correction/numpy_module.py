"""A Python module with NumPy alone that corrects readings, and the interpreter of the JSON form."""

from __future__ import annotations

import inspect
import json
import math
from typing import Any

from casest import __version__
from casest.correction import numpy_table, runtime
from casest.correction.inverse import LEFT
from casest.correction.program import Input, Program
from casest.declaration.shapes import Array
from casest.escaping import python_docstring

_TEST = '''

def largest_error() -> float:
    """Of the values that casest computed when this was exported, relative to their size."""
    given = np.array(INPUTS, dtype=float)
    expected = np.array(EXPECTED, dtype=float)
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float(np.max(np.abs(correct(given) - expected) / np.where(size > 0, size, 1.0)))


INPUTS = {inputs}
EXPECTED = {outputs}

if __name__ == "__main__":
    worst = largest_error()
    print(f"largest error {{worst:.2g}} of the value")
    raise SystemExit(0 if worst <= 1e-9 else 1)
'''

_SPREAD = '''

SPREAD = {program}


def spread(x: Any) -> Any:
    """Standard deviations (N, 4 n) of the corrected values of every row of x, in their unit.

    By the parameters, by the reading's own noise, by the references, and together.
    """
    x = np.asarray(x, dtype=float)
    return attempted(SPREAD, np.hstack([x, correct(x)]))
'''


def python_source(
    program: Program, test: tuple[Array, Array], spread: Program | None = None
) -> str:
    """Source of a module with `correct(x)`: the runtime's text and the program as data.

    Run as a script it checks itself on `test` (inputs, corrected), as the C source does.
    """
    text = inspect.getsource(runtime)
    _, _, body = text.partition("from __future__ import annotations\n")
    body = body.replace(numpy_table.IMPORT, numpy_table.TEXT, 1)
    signals = ", ".join(f"{i.name} ({i.size}, {i.unit or '1'})" for i in program.inputs)
    said = (
        f"{program.output.name} of {program.model}, exported by casest {__version__}.\n\n"
        f"correct(x): x (N, {program.width}) holds {signals};\n"
        f"returns (N, {program.output.size}) in {program.output.unit or '1'}. Raises ValueError\n"
        "naming the row whose reading lies outside what the model can produce.\n"
        + (f"\n{LEFT}\n{', '.join(program.left)}.\n" if program.left else "")
    )
    head = f'"""{python_docstring(said)}"""\n\nfrom __future__ import annotations\n'
    tail = (
        f"\n\nPROGRAM = {_loaded(as_data(program))}\n\n\n"
        "def correct(x: Any) -> Any:\n"
        '    """Corrected values of every row of x."""\n'
        "    return corrected(PROGRAM, x)\n"
        + (_extrapolates(program) if program.seen else "")
        + ("" if spread is None else _SPREAD.format(program=_loaded(as_data(spread))))
        + _TEST.format(inputs=_loaded(test[0].tolist()), outputs=_loaded(test[1].tolist()))
    )
    return (
        head
        + body.replace(
            "from typing import Any\n", "import json\nfrom typing import Any\n", 1
        ).rstrip()
        + "\n"
        + tail
    )


def _loaded(data: Any, width: int = 88) -> str:
    """An expression for plain data, in lines of bounded length."""
    text = json.dumps(data)
    pieces = [text[k : k + width] for k in range(0, len(text), width)]
    return "json.loads(\n" + "\n".join(f"    {piece!r}" for piece in pieces) + "\n)"


def _extrapolates(program: Program) -> str:
    low = [-math.inf if s is None else s[0] for s in program.seen]
    high = [math.inf if s is None else s[1] for s in program.seen]
    return (
        "\n\nLOW, HIGH = (\n"
        f"    np.array([{', '.join(map(_python_number, low))}]),\n"
        f"    np.array([{', '.join(map(_python_number, high))}]),\n"
        ")\n\n\n"
        "def extrapolates(x: Any) -> Any:\n"
        '    """Which rows of x lie outside what the calibration saw."""\n'
        "    x = np.asarray(x, dtype=float)\n"
        "    return ~((x >= LOW) & (x <= HIGH)).all(axis=1)\n"
    )


def _python_number(value: float) -> str:
    return repr(value) if math.isfinite(value) else f"{'-' * (value < 0)}np.inf"


def as_data(program: Program) -> dict[str, Any]:
    """The program as plain data, for JSON."""
    found: dict[str, Any] = {
        "kind": program.kind,
        "inputs": [_values(i) for i in program.inputs],
        "output": _values(program.output),
        "registers": program.registers,
        "steps": [list(step) for step in program.steps],
    }
    if program.kind == "newton":
        found["newton"] = {
            "starts": list(program.starts),
            "middle": program.middle,
            "measured": list(program.measured or ()),
            "largest": program.largest,
        }
    return found


def _values(i: Input) -> dict[str, Any]:
    found: dict[str, Any] = {"name": i.name, "size": i.size, "unit": i.unit}
    return found if i.kind == "plain" else {**found, "kind": i.kind}
