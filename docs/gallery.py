"""A picture for every example, of what it found when it ran; `make docs` makes them.

python docs/gallery.py        # runs examples/*.py, writes docs/pictures/gallery/*.svg
"""

from __future__ import annotations

import io
import runpy
import tempfile
from collections.abc import Callable
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent
EXAMPLES = sorted((HERE.parent / "examples").glob("[0-9]*.py"))
PICTURES = HERE / "pictures" / "gallery"
Names = dict[str, Any]
Draw = Callable[[Names], Figure]


def poses(g: Names) -> Figure:
    """Directions that were enough, and those of one plane that were not."""
    figure, axes = panels(2)
    shown = (("everywhere", "everywhere: trusted"), ("one_axis", "one plane: refused"))
    for axis, (name, title) in zip(axes, shown, strict=True):
        run = g[name]
        axis.plot(run.signals["v"][:, 0], run.signals["v"][:, 2], "o")
        axis.set(title=title, xlabel="x [m/s²]", ylabel="z [m/s²]", xlim=(-11, 11), ylim=(-11, 11))
        axis.set_aspect("equal")
    return figure


def ranks(g: Names) -> Figure:
    """Rank of the Gramian by how the body turns."""
    figure, (axis,) = panels(1)
    axis.barh(list(g["ranks"]), list(g["ranks"].values()))
    axis.axvline(9, color="0.4", linestyle="--")
    axis.set_xlabel("observable directions of 9")
    return figure


def solvers(g: Names) -> Figure:
    """How often each solver was right."""
    figure, (axis,) = panels(1)
    rows = g["found"].rows
    axis.barh([row.solver for row in rows], [row.right for row in rows])
    axis.set_xlabel(f"right, of {len(rows[0].spread)} starts")
    return figure


def filtered(g: Names) -> Figure:
    """A state over time with its band."""
    figure, (axis,) = panels(1)
    t, x, std = g["run"].time, g["found"].smoothed[:, 2], g["found"].smoothed_std[:, 2]
    axis.plot(t, x)
    axis.fill_between(t, x - 1.96 * std, x + 1.96 * std, alpha=0.3)
    axis.axhline(0.1, color="0.4", linestyle="--")
    axis.set(xlabel="t [s]", ylabel="bias [m/s²], truth dashed")
    return figure


def source(g: Names) -> Figure:
    """The exported function."""
    lines = g["source"].splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("int "))
    figure = Figure(figsize=(6.4, 2.6))
    text = "\n".join(lines[first : first + 14])
    figure.text(0.02, 0.96, text, family="monospace", fontsize=8, va="top")
    return figure


def panels(count: int) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def plotted(
    name: str, what: str = "residuals", over: str | None = None
) -> Callable[[Names], Figure]:
    """`plot` of what the example calls `name`."""
    return lambda g: g[name].plot(what, over)


#: What is drawn of each example, by the number in its name.
DRAWN: dict[str, Draw] = {
    "01": plotted("estimate", "sphere"),
    "02": poses,
    "03": plotted("warm"),
    "04": plotted("estimate", "correlation"),
    "05": plotted("found"),
    "06": plotted("both", "parameters"),
    "07": plotted("found", "profiles"),
    "08": plotted("found", "residuals", "angle"),
    "09": ranks,
    "10": solvers,
    "11": source,
    "12": plotted("found"),
    "13": filtered,
}


def picture(example: Path, folder: Path) -> Path:
    """Run an example in a folder of its own and draw what it found."""
    with tempfile.TemporaryDirectory() as empty, chdir(empty), redirect_stdout(io.StringIO()):
        found = runpy.run_path(str(example), run_name="__main__")
        figure = DRAWN[example.name[:2]](found)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{example.stem}.svg"
    figure.savefig(target, metadata={"Date": None})
    return target


def main() -> None:
    """All of them."""
    for example in EXAMPLES:
        print(picture(example, PICTURES))


if __name__ == "__main__":
    main()
