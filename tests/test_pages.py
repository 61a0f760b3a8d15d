"""Every command, file and printed line of the documentation is as it stands there."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess

import pytest
from pages import BLOCK, ROOT, blocks, folder_of_a_reader, follow, run_within

from casest.cli import commands

#: The notebook's page is made by the build: tests/test_gallery.py.
PAGES = [p for p in sorted((ROOT / "docs").glob("*.md")) if p.stem != "notebook"]
PHYSICS = "casest.declaration.physics"
#: Pages that work on a measured record, which lies beside the project.
MEASURED = {
    "equations": "multiarm-pendulum/pendulum_single.csv",
    "from_others": "ardupilot-log171/MAG_all.csv",
}
WITH_COMMANDS = [p for p in PAGES if any(language == "sh" for language, _ in blocks(p))]
#: Pages whose commands take longest.
DEAR = {
    "close", "equations", "fleet", "from_others", "imu", "in_motion", "invisible", "motion_enough",
    "plan", "uncertainty",
}  # fmt: skip


def each_page():
    for page in WITH_COMMANDS:
        dear = [pytest.mark.long] if page.stem in DEAR else []
        yield pytest.param(page, id=page.stem, marks=dear)


@pytest.mark.parametrize("page", list(each_page()))
def test_a_reader_who_does_what_a_page_says_sees_what_it_shows(page, tmp_path, request):
    folder = folder_of_a_reader(page, tmp_path)
    if page.stem in MEASURED:
        shutil.copy(request.getfixturevalue("shared_data") / MEASURED[page.stem], folder)
    assert follow(page, folder, run_once) >= 1


#: What the loop over the shipped wheel printed and wrote: pages show the same command.
WHEEL = "casest close wheel casest/demo/wheel.csv -o out"
_made: list[tuple[subprocess.CompletedProcess[str], dict[str, bytes]]] = []


def run_once(line, folder):
    """As `run_within`; the command that takes longest is computed for the first page alone."""
    if line != WHEEL:
        return run_within(line, folder)
    if not _made:
        done = run_within(line, folder)
        _made.append((done, {p.name: p.read_bytes() for p in (folder / "out").iterdir()}))
    done, written = _made[0]
    (folder / "out").mkdir(exist_ok=True)
    for name, content in written.items():
        (folder / "out" / name).write_bytes(content)
    return done


EVERY = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


@pytest.mark.parametrize("page", EVERY, ids=lambda p: p.stem)
def test_no_block_of_a_page_slips_through(page):
    """Languages that `follow` knows; files that a command uses; else make targets and extras."""
    known = blocks(page)
    assert {language for language, _ in known} <= RUN | {"", "toctree", "eval-rst", "include"}
    typed = "".join(text for language, text in known if language == "sh")
    for language, text in known:
        if language in ("python", "csv"):
            name = text.partition("\n")[0].removeprefix("# ")
            apart = page.name == "README.md" and name == "fit.py"  # run by test_readme
            used = name in typed or f"from {name.removesuffix('.py')} import" in text
            assert used or apart, f"{page.name}: nothing uses {name}"
        elif language == "":
            for line in filter(None, map(str.strip, text.splitlines())):
                assert understood(line.partition("#")[0].strip()), f"{page.name}: {line}"


#: Languages of blocks that are run, written or compared.
RUN = {"sh", "text", "python", "csv", "toml", "c"}


def understood(line):
    """A make target, an extra, or the script that runs everything."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    words = line.split()
    if words[0] == "make":
        return all(re.search(rf"^{t}:", makefile, re.MULTILINE) for t in words[1:])
    extra = re.fullmatch(r"pip install 'casest\[(\w+)\]'", line)
    return bool(extra and re.search(rf"^{extra[1]} =", project, re.MULTILINE)) or line == ".ci/run"


@pytest.mark.parametrize("page", EVERY, ids=lambda p: p.stem)
def test_every_command_within_a_sentence_exists_with_its_options(page):
    prose = BLOCK.sub("", page.read_text(encoding="utf-8"))
    for span in re.findall(r"`(casest [^`]*)`", " ".join(prose.split())):
        name, *words = shlex.split(span.replace("…", ""))[1:]
        if name.startswith("-"):
            continue
        assert name in commands.commands, span
        options = {o for p in commands.commands[name].params for o in p.opts}
        for word in words:
            if word.startswith("-"):
                assert word in options, span


def test_every_question_has_a_page_with_commands():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    questions = set(re.findall(r"\[\]\((\w+)\.md\)", index))
    asked = {"calibrate", "motion_enough", "close", "invisible", "export", "in_motion"}
    assert asked <= questions
    assert questions <= {page.stem for page in WITH_COMMANDS}


def test_figures_of_a_study_are_quoted_as_they_stand_there():
    """The README quotes NIST's; the method includes the loop's table."""
    nist = (ROOT / "studies" / "nist.md").read_text(encoding="utf-8")
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    right, refused, wrong, no = (
        int(n) for n in re.search(r"\| \*\*all\*\* (.*)", nist)[1].replace("*", "").split("|")[1:5]
    )
    assert wrong == 0
    said = (
        f"of {right + refused + no} perturbed starts {right} end right, {refused + no} are refused"
    )
    assert said in readme
    method = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    loop = (ROOT / "studies" / "loop.md").read_text(encoding="utf-8")
    first, last = re.search(r'start-after: "(.*)"\n:end-before: "(.*)"', method).groups()
    assert "without effect, one reported" in loop.partition(first)[2].partition(last)[0]


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
    mathematics = {name for name in casest.__all__ if casest._HOMES.get(name) == PHYSICS}
    shown = {"Residual", "der", "integral", "inverse", "polynomial", "quantity", "rotation", "skew"}
    mathematics -= shown
    for name in set(casest.__all__) - mathematics - {"__version__"}:
        assert re.search(rf"casest\.{name}$", text, re.MULTILINE), name
