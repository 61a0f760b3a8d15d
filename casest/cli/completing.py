"""`completion`: what a shell may complete; names are read from source, so that Tab is quick."""

from __future__ import annotations

import ast
from pathlib import Path

import click
from click.shell_completion import CompletionItem
from click.types import StringParamType

from casest.cli.flags import Kind
from casest.cli.shared import commands, echo

_HERE = Path(__file__).parents[1]


def declared_names(file: str, variable: str) -> list[str]:
    """Names in the tuple, or keys of the dictionary, that a module of casest assigns."""
    tree = ast.parse((_HERE / file).read_text(encoding="utf-8"))
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(t, ast.Name) and t.id == variable for t in targets):
            value = getattr(node, "value", None)
            found = value.keys if isinstance(value, ast.Dict) else getattr(value, "elts", [])
            names = [n.id if isinstance(n, ast.Name) else getattr(n, "value", None) for n in found]
            return [name for name in names if isinstance(name, str)]
    return []


class _Name(StringParamType):
    """A word that is taken as it is, and completed from `names`."""

    def names(self) -> list[str]:
        """What the word may be."""
        raise NotImplementedError

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Names that begin so; where there are none, files (a model's or data's own)."""
        found = [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]


class ModelName(_Name):
    """A shipped model of one of the kinds that a command takes, or a file."""

    def __init__(self, *kinds: Kind) -> None:
        self.kinds = kinds

    def names(self) -> list[str]:
        """Shipped models of these kinds."""
        shipped = {Kind.FITTED: "SHIPPED", Kind.MOVING: "MOVING"}
        found = [declared_names("results/find.py", shipped[kind]) for kind in self.kinds]
        return [name for names in found for name in names]


class EffectName(_Name):
    """An effect of the catalogue."""

    def names(self) -> list[str]:
        """Names of the catalogue, and of the one of motion."""
        moving = declared_names("effects/moving.py", "CATALOGUE")
        own = [name.lower().removeprefix("output_") for name in moving]
        return list(dict.fromkeys([*declared_names("effects/__init__.py", "CATALOGUE"), *own]))


class SolverName(_Name):
    """A solver of any model; estimators of a model's own are not known before it is loaded."""

    def names(self) -> list[str]:
        """The general solvers."""
        return declared_names("solve/strategy.py", "SOLVERS")


@commands.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """A script that completes what is typed: eval "$(casest completion bash)"."""
    from click.shell_completion import get_completion_class

    made = get_completion_class(shell)
    assert made is not None
    echo(made(commands, {}, "casest", "_CASEST_COMPLETE").source())
