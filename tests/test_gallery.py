"""The gallery has a picture of every example; the notebook runs and shows what its text says."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture
def made(monkeypatch):
    """The modules that the documentation's build runs."""
    monkeypatch.syspath_prepend(str(DOCS))
    import gallery
    import notebook

    yield gallery, notebook
    for name in ("gallery", "notebook"):
        del sys.modules[name]


def test_every_example_has_its_picture_on_the_page(made):
    gallery, _ = made
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert re.findall(r"pictures/gallery/(\w+)\.svg", text) == [e.stem for e in gallery.EXAMPLES]
    assert re.findall(r"`examples/(\w+\.py)`", text) == [e.name for e in gallery.EXAMPLES]
    assert list(gallery.DRAWN) == [e.name[:2] for e in gallery.EXAMPLES]


def test_a_picture_is_drawn_from_what_an_example_found(made, tmp_path):
    gallery, _ = made
    drawn = gallery.picture(gallery.EXAMPLES[0], tmp_path).read_text(encoding="utf-8")
    assert "z down" in drawn
    assert drawn.count("<use ") > 24  # a mark for each pose, among those of the axes


@pytest.mark.long
def test_the_notebook_runs_and_shows_verdict_figures_and_corrected_readings(made):
    _, notebook = made
    text = notebook.page(notebook.NOTEBOOK)
    assert "rank 9: trusted</b>" in text
    assert text.count("<svg") == 2
    assert "corrected_x" in text
