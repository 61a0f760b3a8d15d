"""Floors of the package: imports go only down; problems use public names; --help starts quickly."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[1]


def rooms() -> list[str]:
    """From the ground up, as CONTRIBUTING.md shows the house."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    house = text.partition("## The house")[2].partition("```text\n")[2].partition("```")[0]
    return [line.split()[0] for line in house.splitlines()]


#: A room may import itself and those before it, also for type checking.
ROOMS = rooms()


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def floor(name: str) -> int:
    """Place of a module's room in the list: that of the longest listed name it lies in."""
    found = [r for r in ROOMS if name == r or (r != "casest" and name.startswith(r + "."))]
    assert found, f"{name} is in no room: add it to ROOMS"
    return ROOMS.index(max(found, key=len))


def statements(nodes: list[ast.stmt]) -> Iterator[ast.AST]:
    """These, and those within them."""
    for node in nodes:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, part, []))


@cache
def imports(path: Path) -> set[str]:
    """Modules of casest that a file imports, anywhere in it."""
    found = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the room"
            module = node.module or ""
            for alias in node.names:
                inner = ROOT.joinpath(*module.split("."), f"{alias.name}.py")
                package = ROOT.joinpath(*module.split("."), alias.name)
                own = inner.exists() or package.is_dir() or alias.name == "__version__"
                found.add(f"{module}.{alias.name}" if own else module)
    return {name for name in found if name.partition(".")[0] in ("casest", "casest_problems")}


MODULES = sorted((ROOT / "casest").rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_go_only_down(path):
    own = module_name(path)
    climbing = {name for name in imports(path) if floor(name) > floor(own)}
    assert climbing == set(), f"{own} (floor {floor(own)}) imports upwards: {sorted(climbing)}"


#: What text and page may read beside results: what is theirs, errors, escaping, the name of a data
#: file, and types of what a result holds (a run with its times and gaps, an array and its digits).
READ = {
    "text": ["casest.report.text", "casest.report.next_command"],
    "html": ["casest.report.html", "casest.report.next_command"],
}
BESIDE = ["casest.results", "casest.errors", "casest.escaping", "casest.units"]
EXACTLY = {"casest.__version__", "casest.data.logs", "casest.data.run", "casest.declaration.shapes"}


@pytest.mark.parametrize("path", [p for p in MODULES if p.parent.name in READ], ids=module_name)
def test_text_and_page_read_results_and_nothing_else(path):
    rooms = (*READ[path.parent.name], *BESIDE)
    inside = {n for n in imports(path) if any(n == r or n.startswith(r + ".") for r in rooms)}
    assert imports(path) - inside - EXACTLY == set()


def test_no_two_modules_import_each_other():
    below = {module_name(p): imports(p) - {module_name(p)} for p in MODULES}

    names = list(below)
    graph = np.array([[other in below[name] for other in names] for name in names])
    _, circle = connected_components(csr_array(graph), connection="strong")
    within = np.bincount(circle)[circle] > 1
    # a package's own front may name its members, which name each other
    assert [n for n, own in zip(names, within, strict=True) if own and n.count(".")] == []


@pytest.mark.parametrize("path", sorted((ROOT / "problems").glob("*.py")), ids=lambda p: p.stem)
def test_problems_use_public_names_of_casest_only(path):
    import casest
    import casest.dynamics

    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not any(alias.name.partition(".")[0] == "casest" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("casest"):
            # The decorator of moving estimators bears its package's name, so it lives there.
            homes = {"casest": casest, "casest.dynamics": casest.dynamics}
            assert node.module in homes, f"{path.name} imports {node.module}"
            assert {alias.name for alias in node.names} <= set(homes[node.module].__all__)


def test_every_public_name_is_there():
    import casest

    assert len(casest.__all__) == len(set(casest.__all__))
    for name in casest.__all__:
        assert getattr(casest, name) is not None
    with pytest.raises(AttributeError, match="casest has no 'modle'"):
        _ = casest.modle


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


def test_help_needs_neither_numpy_nor_casadi():
    code = (
        "import sys\n"
        "from casest.cli import run\n"
        "assert run(['--help']) == 0\n"
        "heavy = {'numpy', 'casadi', 'scipy', 'pint', 'pyarrow'} & set(sys.modules)\n"
        "print('heavy:', sorted(heavy))\n"
    )
    text = python(code)
    assert "Calibrate sensors, prove the answer" in text
    assert text.endswith("heavy: []\n")


def test_the_module_is_the_command_line():
    command = [sys.executable, "-m", "casest", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Usage: casest ")


def test_help_of_every_command_needs_neither_numpy_nor_casadi():
    code = (
        "import sys\n"
        "from casest.cli import commands, run\n"
        "assert all(run([name, '--help']) == 0 for name in commands.commands)\n"
        "print('heavy:', sorted({'numpy', 'casadi'} & set(sys.modules)))\n"
    )
    assert python(code).endswith("heavy: []\n")


def test_a_small_calibration_loads_nothing_it_does_not_need(tmp_path):
    rng = np.random.default_rng(0)
    v = rng.standard_normal((60, 3))
    v *= 9.8 / np.linalg.norm(v, axis=1)[:, None]
    names = "vx [m/s^2],vy [m/s^2],vz [m/s^2]"
    noisy = v * [1.01, 0.99, 1.02] + 0.01 * rng.standard_normal(v.shape)
    np.savetxt(tmp_path / "n.csv", noisy, delimiter=",", header=names, comments="")
    code = (
        "import sys\n"
        "from casest.cli import run\n"
        f"assert run(['calibrate', 'norm-diagonal', {str(tmp_path / 'n.csv')!r}]) == 0\n"
        "slow = {'scipy.stats', 'scipy.optimize', 'matplotlib', 'pandas', 'pint', 'pyarrow'}\n"
        "slow |= {f'casest.report.html.{page}' for page in ('check', 'motion', 'side_by_side')}\n"
        "print('slow:', sorted(slow & set(sys.modules)))\n"
    )
    assert python(code).endswith("slow: []\n")


def test_the_wheel_has_every_room():
    """What `pyproject.toml` lists is what there is."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    rooms = {".".join(f.parent.relative_to(ROOT).parts) for f in ROOT.glob("casest/**/__init__.py")}
    assert {*project["tool"]["setuptools"]["packages"]} == rooms | {"casest_problems"}
