"""The measured data that tests read, and what happens where they are missing."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path
from typing import Any

import pytest

#: The files that take longest, with what is marked long, come first: a long one at the end would
#: leave a core idle.
LONGEST = (
    "closing_motion", "loop", "interruption", "joining", "false_alarms", "report", "pages",
    "evidence", "closing_records", "sampson", "on_bounds", "inputs", "noise", "malformed_files",
    "public_types", "readme", "formula", "exit_codes", "effects", "imu", "norm_limits", "valley",
    "nist", "kernel", "batch_certificate", "equations", "memory", "fleet_restart",
    "effects_of_columns", "cli", "replay", "extended", "filter_step", "simulating_motion",
    "examples", "spread", "structural",
)  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """Files are handed out in the order of the collection, not by their number of tests."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_finish() -> None:
    """Tests and the modules that they load stay: no look for garbage goes through them again.

    Nor, every few milliseconds, through what tests make: nearly all of it goes by itself.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Longest files first; within a file the order stays."""
    place = {f"test_{name}": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> None:
    """A runner in the background ignores Ctrl-C, and so would all that it starts."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def control() -> Any:
    """python-control: loading it takes seconds, in every process that collects the tests."""
    import control

    return control


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the measured records: CASEST_DATA, else ../shared/data beside the project."""
    stated = os.environ.get("CASEST_DATA")
    folder = Path(stated) if stated else Path(__file__).parents[2] / "shared" / "data"
    if folder.is_dir():
        return folder
    message = f"measured data not found in {folder}: set CASEST_DATA to their folder"
    if os.environ.get("CI") or os.environ.get("CASEST_REQUIRE_DATA"):
        pytest.fail(message)
    pytest.skip(message)
