"""What a result made in Python calls its model and its data, so that it can be used again."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Sequence
from pathlib import Path

from casest.data.run import Run
from casest.declaration.model import Model
from casest.results.find import SHIPPED


def name_of(model: Model) -> str:
    """As the command line would call it: a shipped name, `file.py:name`, else its own."""
    source = Path(inspect.unwrap(model.function).__code__.co_filename)
    for name, (module, attribute) in SHIPPED.items():
        if source.stem == module:
            shipped = getattr(importlib.import_module(f"casest_problems.{module}"), attribute)
            if (shipped.function, shipped.name) == (model.function, model.name):
                return name
    return f"{source}:{model.name}" if source.suffix == ".py" and source.is_file() else model.name


def data_names(runs: Sequence[Run]) -> list[str]:
    """Files of the runs, or the names of those that have none, each once."""
    return list(dict.fromkeys(run.file or run.name for run in runs))
