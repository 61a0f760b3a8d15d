"""What `casest doctor` finds: versions, compiler, kernel, cache, readers, a fit of known truth."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from msgspec import Struct, to_builtins

from casest import __version__
from casest.engine.cache import kernel_folder
from casest.engine.kernel import compiler_found, compiler_version, compiles
from casest.engine.threads import pools
from casest.errors import CasestError
from casest.results.file import plain

#: What computes, and cannot be missing.
_NEEDED = ("casadi", "numpy", "scipy", "msgspec", "click", "pint", "threadpoolctl")
#: Module, extra that installs it, and what it is for.
_OPTIONAL = (
    ("pyarrow", "parquet", "Parquet files, fleets"),
    ("h5py", "matlab", "MATLAB 7.3 files"),
    ("rosbags", "ros", "ROS bags"),
    ("pyulog", "px4", "PX4 logs"),
    ("pymavlink", "ardupilot", "ArduPilot logs"),
    ("matplotlib", "plot", "plots of compare, estimate.plot()"),
    ("pandas", "frames", "data frames out"),
    ("boule", "earth", "gravity(latitude, height)"),
    ("pygeomag", "earth", "field(latitude, longitude, height, year)"),
    ("distributed", "fleet", "fleets on a Dask cluster"),
)


class Finding(Struct, frozen=True):
    """One thing that was looked at: `ok` is null where it is neither good nor bad.

    `do` says what to do where it is not ok.
    """

    about: str
    name: str
    found: str
    ok: bool | None = None
    do: str = ""


class Health(Struct, frozen=True):
    """All that was found, in order."""

    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Nothing is wrong."""
        return all(f.ok is not False for f in self.findings)

    def content(self) -> dict[str, object]:
        """For JSON."""
        found: dict[str, object] = plain(to_builtins(self))
        return found


def health() -> Health:
    """Look at everything; nothing is written but a kernel into the cache."""
    return Health((*_versions(), *_kernel(), *_algebra(), *_readers(), *_fit()))


def _versions() -> Iterator[Finding]:
    yield Finding("versions", "casest", f"{__version__} in {Path(__file__).parents[1]}")
    yield Finding("versions", "python", f"{platform.python_version()} ({sys.executable})")
    yield Finding("versions", "system", f"{platform.platform()}, {os.cpu_count()} cores")
    for name in _NEEDED:
        try:
            yield Finding("versions", name, version(name), True)
        except PackageNotFoundError:
            yield Finding("versions", name, "missing", False, f"pip install {name}")


def _kernel() -> Iterator[Finding]:
    """Without a kernel everything works, slower."""
    wish, compiler = os.environ.get("CASEST_KERNEL", "auto"), compiler_found()
    slower = "long records are computed by NumPy, several times slower"
    if compiler is None:
        yield Finding("kernel", "compiler", f"none: {slower}", None, "install gcc or clang")
    else:
        yield Finding("kernel", "compiler", f"{compiler}: {compiler_version(compiler)}", True)
    folder = kernel_folder()
    if folder is None:
        do = "set CASEST_CACHE to a folder of your own that nobody else can write"
        yield Finding("kernel", "cache", f"no safe folder: {slower}", None, do)
    else:
        own = list(folder.glob("*.so"))
        size = sum(f.stat().st_size for f in own) / 1e6
        yield Finding("kernel", "cache", f"{folder}: {len(own)} kernels, {size:.1f} MB", True)
    if wish == "off":
        yield Finding("kernel", "CASEST_KERNEL", "off", None, "unset it to compile kernels")
    elif compiler is not None and folder is not None:
        ok = compiles()
        said = "compiles, is kept and loads" if ok else f"cannot be compiled: {slower}"
        yield Finding(
            "kernel", "a kernel", said, ok or None, "" if ok else "is the compiler whole?"
        )


def _algebra() -> Iterator[Finding]:
    for pool in pools():
        name = f"{pool.get('internal_api')} {pool.get('version') or ''}".strip()
        kind = pool.get("architecture")
        said = f"{name}, {pool.get('num_threads')} threads" + (f", {kind}" if kind else "")
        yield Finding("linear algebra", Path(str(pool.get("filepath"))).name, said)


def _readers() -> Iterator[Finding]:
    for name, extra, what in _OPTIONAL:
        if find_spec(name) is None:
            how = f"pip install 'casest[{extra}]'"
            yield Finding("optional", name, f"not installed ({what})", None, how)
            continue
        try:
            yield Finding("optional", name, f"{version(name)} ({what})", True)
        except PackageNotFoundError:
            yield Finding("optional", name, f"there ({what})", True)


def _fit() -> Iterator[Finding]:
    """The shipped record, calibrated as anybody would, against the truth that it was made from."""
    from casest.data import load_runs
    from casest.demo import RECORD, furthest
    from casest.estimate.calibrate import calibrate
    from casest.results.find import find_model

    began = time.perf_counter()
    try:
        model = find_model("norm-triangular")
        runs = load_runs(RECORD, model.signals, columns={"v": "a"}, rate=50, at_rest=True)
        found = calibrate(model.having(norm=9.80665), runs)
    except CasestError as error:
        yield Finding("a fit", "handheld.csv", str(error), False, "please report this page")
        return
    took = time.perf_counter() - began
    z = furthest(found.values, found.std)
    said = f"{took:.2g} s, trusted, at most {z:.1f} standard deviations from the truth"
    yield Finding("a fit", "handheld.csv", said, z < 4.5)


def health_text(found: Health) -> str:
    """What is printed: a block for each subject, what to do beneath what wants it."""
    blocks, lines = list[str](), list[str]()
    for k, f in enumerate(found.findings):
        if k == 0 or f.about != found.findings[k - 1].about:
            blocks.append("\n".join(lines))
            lines = [f.about]
        mark = {True: " ", None: " " if not f.do else "-", False: "!"}[f.ok]
        lines.append(f"{mark} {f.name:<14} {f.found}")
        if f.do and f.ok is not True:
            lines.append(f"  {'':<14} {f.do}")
    blocks.append("\n".join(lines))
    blocks.append("Nothing is wrong." if found.ok else "What is marked ! is wrong.")
    return "\n\n".join(b for b in blocks if b)
