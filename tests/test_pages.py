"""Every command, file and printed line of the documentation is as it stands there."""

from __future__ import annotations

import re

import pytest
from pages import ROOT, blocks, folder_of_a_reader, follow

PAGES = sorted((ROOT / "docs").glob("*.md"))
PHYSICS = "casest.declaring.physics"
WITH_COMMANDS = [p for p in PAGES if any(language == "sh" for language, _ in blocks(p))]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda p: p.stem)
def test_a_reader_who_does_what_a_page_says_sees_what_it_shows(page, tmp_path):
    assert follow(page, folder_of_a_reader(page, tmp_path)) >= 1


def test_every_question_has_a_page_with_commands():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    questions = set(re.findall(r"\[\]\((\w+)\.md\)", index))
    assert questions == {"calibrate", "motion_enough", "close", "invisible", "export", "in_motion"}
    assert questions <= {page.stem for page in WITH_COMMANDS}


def test_every_page_is_reached_from_the_front():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = {
        line
        for text in re.findall(r"```\{toctree\}(.*?)```", index, re.DOTALL)
        for line in text.split()
    }
    assert {page.stem for page in PAGES} - {"index"} <= listed


def test_the_reference_names_every_public_name_that_is_no_word_of_mathematics():
    import casest

    text = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    mathematics = {name for name in casest.__all__ if casest._WHERE.get(name) == PHYSICS}
    shown = {"Residual", "der", "integral", "inverse", "polynomial", "quantity", "rotation", "skew"}
    mathematics -= shown
    for name in set(casest.__all__) - mathematics - {"__version__"}:
        assert re.search(rf"casest\.{name}$", text, re.MULTILINE), name
