"""The measured data that tests read, and what happens where they are missing."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


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
