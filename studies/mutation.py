"""Small plausible mistakes, one at a time: does a test notice?

    python studies/mutation.py              # every mistake that was not tried with these files yet
    python studies/mutation.py certificate  # those of the modules whose path contains the word

Each mistake of studies/mutants.py is made in a copy of the package, and the fastest test files of
its module run on it, one after the other, until a test fails. What none notices survives, and is
named in studies/mutation.md with what is to be said of it. A record holds as long as neither the
module nor its test files change. A snippet that is not found exactly once is an error: the list
follows the code.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

from mutants import JUDGED, MUTANTS, ROOT, Mutant
from resumed import done, kept

RECORDS = ROOT / "out" / "mutation.jsonl"
TABLE = ROOT / "studies" / "mutation.md"
#: Seconds after which a test that runs on and on counts as one that noticed.
PATIENCE = 900.0
COPIED = ("casest", "problems", "tests", "pyproject.toml", "CONTRIBUTING.md", "README.md")


def main() -> None:
    """Try what is left of the list, and write the table."""
    words = sys.argv[1:]
    for mutant in MUTANTS:
        _check(mutant)
    wanted = [m for m in MUTANTS if not words or any(word in m.path for word in words)]
    known = {record["identity"] for record in kept(RECORDS)}
    left = [m for m in wanted if m.identity() not in known]
    if left:
        with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
            done(tried, [(folder, *m) for m in left], RECORDS, workers=1)
    TABLE.write_text(table(), encoding="utf-8")
    print(f"{TABLE.relative_to(ROOT)}: {summary()}")


def _check(mutant: Mutant) -> None:
    path = ROOT / "casest" / mutant.path
    count = path.read_text(encoding="utf-8").count(mutant.old) if path.exists() else 0
    if count != 1 or mutant.old == mutant.new:
        raise SystemExit(
            f"studies/mutants.py: {mutant.old!r} is {count} times in casest/{mutant.path}, not once"
        )


# -- one mistake -----------------------------------------------------------------------------------


def tried(folder: str, path: str, old: str, new: str) -> dict[str, Any]:
    """Make the mistake in the copy in that folder, run the tests, take it back."""
    mutant, began, copy = Mutant(path, old, new), time.perf_counter(), _copy(folder)
    module = copy / "casest" / path
    text = module.read_text(encoding="utf-8")
    by = ""
    try:
        for test in mutant.tests:
            _check_unchanged(copy, test)
            _write(module, text.replace(old, new))
            code, words = _run(copy, test)
            _write(module, text)
            if code != 0:
                by = _first_failure(words) or f"{test}: exit code {code}"
                break
    finally:
        _write(module, text)
    seconds = round(time.perf_counter() - began, 1)
    identity = mutant.identity(copy)
    return {"identity": identity, "name": mutant.name, "by": by, "seconds": seconds}


@cache
def _check_unchanged(copy: Path, test: str) -> None:
    """The tests must pass on the package as it is, in the copy as it is."""
    code, words = _run(copy, test)
    if code != 0:
        raise SystemExit(f"{test} fails without any mistake:\n{words}")


def _write(module: Path, text: str) -> None:
    """Compiled files are believed by size and second: away with them."""
    module.write_text(text, encoding="utf-8")
    shutil.rmtree(module.parent / "__pycache__", ignore_errors=True)


@cache
def _copy(place: str) -> Path:
    """The folder, with the package and its tests in it."""
    folder = Path(place)
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy(ROOT / name, folder / name)
    (folder / "casest_problems").symlink_to(folder / "problems")
    said = subprocess.run(
        [sys.executable, "-c", "import casest, casest_problems as p; print(casest.__path__[0])"],
        cwd=folder, env=_environment(folder), capture_output=True, text=True, check=True,
    )  # fmt: skip
    if Path(said.stdout.strip()) != folder / "casest":
        raise SystemExit(f"the copy is not the one that is imported: {said.stdout}")
    return folder


def _environment(folder: Path) -> dict[str, str]:
    data = os.environ.get("CASEST_DATA", str(ROOT.parent / "shared" / "data"))
    return {**os.environ, "PYTHONPATH": str(folder), "CASEST_DATA": data,
            "OPENBLAS_NUM_THREADS": "1"}  # fmt: skip


def _run(folder: Path, test: str) -> tuple[int, str]:
    """Exit code and output of one test file in the copy, up to its first failure."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=line", "-p", "no:cacheprovider",
               "-m", "", str(folder / "tests" / test)]  # fmt: skip
    try:
        found = subprocess.run(
            command, cwd=folder, env=_environment(folder), capture_output=True, text=True,
            timeout=PATIENCE, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 1, f"FAILED {test}::still running after {PATIENCE:g} s"
    return found.returncode, found.stdout + found.stderr


def _first_failure(words: str) -> str:
    for line in words.splitlines():
        kind, _, rest = line.partition(" ")
        if kind in ("FAILED", "ERROR") and "::" in rest:
            return rest.partition("::")[2].partition(" - ")[0]
    return ""


# -- the table -------------------------------------------------------------------------------------


def _results() -> list[tuple[Mutant, dict[str, Any] | None]]:
    """Each mistake with its newest record, whatever has changed since."""
    newest = {record["name"]: record for record in kept(RECORDS)}
    return [(m, newest.get(m.name)) for m in MUTANTS]


def summary() -> str:
    """How many were tried, and how many survived."""
    tried_ones = [r for _, r in _results() if r]
    survived = sum(not r["by"] for r in tried_ones)
    share = 100 * survived / max(len(tried_ones), 1)
    return f"{len(tried_ones)} mistakes, {survived} unnoticed ({share:.0f} %)"


def table() -> str:
    """The text of studies/mutation.md."""
    results = [(m, r) for m, r in _results() if r]
    total, survived = (Counter(m.path for m, r in results if want(r["by"]))
                       for want in (lambda _: True, lambda by: not by))  # fmt: skip
    lines = [
        "# Mistakes that tests notice",
        "",
        f"`make study-mutation`: {summary()}.",
        "Each is one small change to one module; the test files of that module run on it until one",
        "fails.",
        "",
        "| module | mistakes | unnoticed |",
        "| --- | --- | --- |",
        *(f"| `{path}` | {total[path]} | {survived[path]} |" for path in total),
        "",
        "## Unnoticed",
        "",
        "| module | the code | the mistake | what is to be said of it |",
        "| --- | --- | --- | --- |",
    ]
    for mutant, record in results:
        if not record["by"]:
            said = JUDGED.get((mutant.path, mutant.new), "**a test is missing**")
            old, new = (f"`{part}`".replace("|", "\\|") for part in (mutant.old, mutant.new or " "))
            lines.append(f"| `{mutant.path}` | {old} | {new} | {said} |")
    lines += ["", "## Noticed, and by which test", "", "| module | the mistake | test |",
              "| --- | --- | --- |"]  # fmt: skip
    for mutant, record in results:
        if record["by"]:
            new = f"`{mutant.new or ' '}`".replace("|", "\\|")
            lines.append(f"| `{mutant.path}` | {new} | {record['by'].partition('[')[0]} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
