"""Runs first_steps.ipynb as Jupyter would and writes the page with what it shows; for `make docs`.

python docs/notebook.py       # writes docs/notebook.md
"""

from __future__ import annotations

import ast
import io
import json
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
NOTEBOOK = HERE / "first_steps.ipynb"


def page(notebook: Path) -> str:
    """Markdown of the notebook: cells of text, cells of code with what they print and show."""
    names: dict[str, Any] = {"__name__": "__main__"}
    parts: list[str] = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        else:
            parts += [f"```python\n{source}\n```", *executed(source, names)]
    return "\n\n".join(parts) + "\n"


def executed(source: str, names: dict[str, Any]) -> Iterator[str]:
    """What a cell prints, then how its last line shows itself."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with redirect_stdout(printed):
        exec(compile(tree, "<cell>", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)  # type: ignore[attr-defined]
    if printed.getvalue():
        yield f"```text\n{printed.getvalue().rstrip()}\n```"
    if value is not None:
        yield shown(value)


def shown(value: Any) -> str:
    """Figures as SVG, then HTML, then text, as a notebook prefers them."""
    if hasattr(value, "savefig"):
        drawn = io.StringIO()
        value.savefig(drawn, format="svg", metadata={"Date": None})
        return f"```{{raw}} html\n{drawn.getvalue()[drawn.getvalue().index('<svg') :]}\n```"
    if hasattr(value, "_repr_html_"):
        return f"```{{raw}} html\n{value._repr_html_()}\n```"
    return f"```text\n{value!r}\n```"


if __name__ == "__main__":
    (HERE / "notebook.md").write_text(page(NOTEBOOK), encoding="utf-8")
