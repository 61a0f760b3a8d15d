"""Long studies that can be interrupted: each record is kept as it is made, one line of JSON."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any


def kept(path: Path) -> list[dict[str, Any]]:
    """The records of a file; none where there is no file yet."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def done(
    function: Callable[..., dict[str, Any]],
    left: Sequence[tuple[Any, ...]],
    path: Path,
    workers: int,
) -> list[dict[str, Any]]:
    """Call the function with each tuple of arguments, on all workers; keep and return the records.

    How far it has come is shown on one line.
    """
    path.parent.mkdir(exist_ok=True)
    found, began = [], time.time()
    with ProcessPoolExecutor(workers) as pool, path.open("a", encoding="utf-8") as file:
        waiting = [pool.submit(function, *arguments) for arguments in left]
        for k, ready in enumerate(as_completed(waiting), 1):
            if ready.exception() is not None:  # what has not begun would be waited for
                pool.shutdown(wait=False, cancel_futures=True)
            found.append(ready.result())
            file.write(json.dumps(found[-1]) + "\n")
            file.flush()
            print(f"\r{k}/{len(left)}, {time.time() - began:.0f} s", end="", flush=True)
    print()
    return found
