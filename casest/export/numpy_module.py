"""A Python module with NumPy alone that corrects readings, and the interpreter of the JSON form."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from casest import __version__
from casest.export import runtime
from casest.export.program import Program


def python_source(program: Program) -> str:
    """Source of a module with `correct(x)`: the runtime's text and the program as data."""
    text = inspect.getsource(runtime)
    _, _, body = text.partition("from __future__ import annotations\n")
    signals = ", ".join(f"{i.name} ({i.size}, {i.unit or '1'})" for i in program.inputs)
    head = (
        f'"""{program.output.name} of {program.model}, exported by casest {__version__}.\n\n'
        f"correct(x): x (N, {program.width}) holds {signals};\n"
        f"returns (N, {program.output.size}) in {program.output.unit or '1'}. Raises ValueError\n"
        'naming the row whose reading lies outside what the model can produce.\n"""\n\n'
        "from __future__ import annotations\n"
    )
    data = json.dumps(as_data(program))
    lines = "\n".join(_wrapped(data))
    tail = (
        "\n\nPROGRAM = json.loads(\n" + lines + "\n)\n\n\n"
        "def correct(x: Any) -> Any:\n"
        '    """Corrected values of every row of x."""\n'
        "    return corrected(PROGRAM, x)\n"
    )
    return (
        head
        + body.replace(
            "from typing import Any\n", "import json\nfrom typing import Any\n", 1
        ).rstrip()
        + "\n"
        + tail
    )


def _wrapped(text: str, width: int = 88) -> Sequence[str]:
    pieces = [text[k : k + width] for k in range(0, len(text), width)]
    return [f"    {piece!r}" for piece in pieces]


def as_data(program: Program) -> dict[str, Any]:
    """The program as plain data, for JSON."""
    found: dict[str, Any] = {
        "kind": program.kind,
        "inputs": [{"name": i.name, "size": i.size, "unit": i.unit} for i in program.inputs],
        "output": {
            "name": program.output.name,
            "size": program.output.size,
            "unit": program.output.unit,
        },
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


def corrected(program: Program, x: Any) -> Any:
    """The program run by the same text that is exported."""
    return runtime.corrected(as_data(program), np.asarray(x, dtype=float))
