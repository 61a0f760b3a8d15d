"""A page of Markdown as its reader uses it: the files it shows are written, its commands are run.

In order: python and csv blocks that begin with `# name` are files; each line of a sh block is a
command, whose exit code is 0 or what `# exit code N` at its end says; a text block shows what
the commands above it have printed, with `...` where lines are left out; what a command that
succeeds says on standard error is shown without gaps; lines of a c block stand in a C file that the
commands have written. Commands may be run within this process, those of
casest by the function that the installed script calls: it starts up once, not for each line.
"""

from __future__ import annotations

import io
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

from casest import cli

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```\{?([\w-]*)\}?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
EXIT = re.compile(r"\s+# exit code (\d)$")


#: Runs a command line in a folder.
Runner = Callable[[str, Path], subprocess.CompletedProcess[str]]


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of every fenced block."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def folder_of_a_reader(page: Path, folder: Path) -> Path:
    """A folder with the shipped records and the files that the page shows."""
    shutil.copytree(ROOT / "casest" / "demo", folder / "casest" / "demo")
    for language, text in blocks(page):
        first, _, rest = text.partition("\n")
        if language in ("python", "csv", "toml"):
            assert first.startswith("# "), f"{page.name}: a block without the name of its file"
            (folder / first[2:]).write_text(rest, encoding="utf-8")
    return folder


def run(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The command as in a shell of the installed environment."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    # The folder holds only the demo of casest: the installed package must win over it.
    environment["PYTHONSAFEPATH"] = "1"
    return subprocess.run(
        line, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def run_within(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The same of a command of casest, or of a Python file, without a process of its own."""
    name, *words = shlex.split(line)
    if name not in ("casest", "python"):
        return run(line, folder)
    out, err = io.StringIO(), io.StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        code = cli.run(words) if name == "casest" else _run_file(words)
    return subprocess.CompletedProcess(line, code, out.getvalue(), err.getvalue())


def _run_file(words: list[str]) -> int:
    """What `python FILE` does; an exception is not caught."""
    before, sys.argv = sys.argv, words
    try:
        runpy.run_path(words[0], run_name="__main__")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = before
    return 0


def first_apart() -> Runner:
    """Each command is a process of its own the first time, and within this one afterwards."""
    seen: set[str] = set()

    def run_either(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
        command = " ".join(shlex.split(line)[:2])
        known = command in seen
        seen.add(command)
        return run_within(line, folder) if known else run(line, folder)

    return run_either


def follow(page: Path, folder: Path, run: Runner = run) -> int:
    """Do what the page says; the number of its commands."""
    printed: list[str] = []
    shown = {s for language, text in blocks(page) if language == "text" for s in text.splitlines()}
    count = 0
    for language, text in blocks(page):
        if language == "sh":
            for written in text.splitlines():
                line, expected = EXIT.sub("", written), EXIT.search(written)
                done = run(line, folder)
                code = int(expected[1]) if expected else 0
                assert done.returncode == code, f"{line}\n{done.stdout}\n{done.stderr}"
                said = done.stderr.splitlines()
                assert code or shown.issuperset(said), f"{line}\n{done.stderr}"
                printed += [*done.stdout.splitlines(), *said]
                count += 1
        elif language == "c":
            written_c = "".join(p.read_text(encoding="utf-8") for p in folder.rglob("*.c"))
            for line in text.splitlines():
                assert line in written_c, f"{page.name}: no exported source has {line!r}"
        elif language == "text":
            for line in text.splitlines():
                digits = "stationary" not in line  # rounding differs from machine to machine
                if line.strip() and line.strip() != "..." and digits:
                    assert line in printed, f"{page.name}: nothing printed {line!r}"
    return count
