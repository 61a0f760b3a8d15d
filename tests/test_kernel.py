"""The compiled kernel gives CasADi's values and the replay's sums, or NumPy takes over unasked."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from test_replay import (
    EXACT_BINARY,
    EXACT_UNARY,
    SMOOTH_BINARY,
    SMOOTH_UNARY,
    SPECIAL,
    assert_same,
    function,
    model,
    single_operations,
    special_pairs,
    unary,
)

from casest.demo import RECORD
from casest.engine import (
    Columns,
    Replay,
    cost,
    evaluated,
    kernel,
    normal_equations,
    residuals,
    rows,
    summed,
)
from casest.engine.operations import OPERATIONS
from casest.leastsquares.per_sample import residual_and_jacobian
from casest.results.find import SHIPPED, find_model

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler on this machine"
)
INF, NAN = np.inf, np.nan
POSES = ["norm-triangular", str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
POSES += ["--set", "norm=9.80665"]
COUNTS = [1, 7, 63, 64, 65, 40_000]
#: Shipped problems of one and of three residuals, with many branches and with none.
KINDS = {"norm-triangular", "wheel", "steinhart-hart"}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("kernels")


@pytest.fixture(autouse=True)
def always(monkeypatch, cache):
    monkeypatch.setenv("CASEST_KERNEL", "always")
    monkeypatch.setenv("CASEST_CACHE", str(cache))


def replayed(monkeypatch, work):
    """What NumPy makes of it."""
    with monkeypatch.context() as off:
        off.setenv("CASEST_KERNEL", "off")
        return work()


def compiled(replay):
    """Is it the kernel that answers?"""
    return replay.kernels.get(-1) is not None


def with_any_jacobian(parameters, sample, residual):
    """A function of the engine's form, for residuals whose derivative is of no interest."""
    return function(parameters, sample, ca.densify(residual), ca.DM(residual.numel(), 1))


def mapped_over(f, parameters, samples):
    """CasADi's own values of the first output, a column, (N, rows)."""
    found = f.map(len(samples)).call([ca.DM(parameters), ca.DM(samples.T)])[0]
    return np.array(found).T


def close(ours, theirs, rtol=1e-12):
    """Equal within rounding of the largest entry; nan where nan."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    scale = np.abs(theirs[np.isfinite(theirs)]).max(initial=0.0)
    np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol * scale)


# -- values: CasADi's own --------------------------------------------------------------------------


def test_every_operation_that_can_be_emitted_is_tested():
    tested = [*EXACT_UNARY, *EXACT_BINARY, *SMOOTH_UNARY, *SMOOTH_BINARY, "CONSTPOW"]
    emitted = {operation.code for operation in OPERATIONS if not operation.same}
    assert emitted <= {getattr(ca, f"OP_{name}") for name in tested}


@pytest.mark.parametrize("exact", [True, False])
def test_every_operation_agrees_on_special_values(exact):
    names = (EXACT_UNARY, EXACT_BINARY) if exact else (SMOOTH_UNARY, SMOOTH_BINARY)
    outputs = single_operations(*names)
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 2)
    f = with_any_jacobian(p, s, outputs(p, s))
    replay, samples = Replay(f), special_pairs()
    for parameters in ([1.7, -0.3], [-0.0, INF], [NAN, 5e-324]):
        ours = residuals(replay, parameters, samples)
        theirs = mapped_over(outputs, parameters, samples)
        assert_same(ours, theirs, 0.0 if exact else 1e-12, 0.0 if exact else 1e-322)
    assert compiled(replay)


@pytest.mark.parametrize("name", ["SIN", "SIGN", "TAN"])
def test_an_operation_alone_agrees_on_special_values(name):
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    f = with_any_jacobian(p, s, unary(name, s))
    ours = residuals(Replay(f), [0.0], SPECIAL[:, None])
    assert_same(ours, mapped_over(f, [0.0], SPECIAL[:, None]), 1e-12)


def test_a_constant_power_and_a_choice_agree_on_special_values():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    powers = [s**k for k in (2.5, -1.5, 3, 7, -2, 0.5, 1 / 3)]
    choice = [ca.if_else(s > 0, ca.log(s), p), ca.if_else(s == s, s, -1.0)]
    f = with_any_jacobian(p, s, ca.vertcat(*powers, p**2.5, *choice))
    ours = residuals(Replay(f), [1.3], SPECIAL[:, None])
    assert_same(ours, mapped_over(f, [1.3], SPECIAL[:, None]), 1e-12, 1e-322)


def test_an_angle_far_beyond_a_turn_has_its_sine():
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    f = with_any_jacobian(p, s, ca.vertcat(ca.sin(s), ca.cos(s), ca.sin(p * s)))
    sizes = 10.0 ** np.arange(-8, 19).repeat(37)[:, None]
    angles = sizes * np.random.default_rng(0).normal(size=sizes.shape)
    ours = residuals(Replay(f), [3.0], angles)
    assert_same(ours, mapped_over(f, [3.0], angles), 1e-12)


# -- sums: the replay's ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * (n not in KINDS)) for n in SHIPPED]
)
def test_sums_and_rows_of_a_shipped_problem_are_those_of_the_replay(name, monkeypatch):
    replay = residual_and_jacobian(find_model(name))
    rng = np.random.default_rng(1)
    p = rng.uniform(0.5, 1.5, replay.n_parameters)
    m = replay.shapes[0][0]
    everything = rng.normal(size=(max(COUNTS), replay.n_sample))
    weights = rng.uniform(0, 2, (max(COUNTS), m))

    def work():
        found = []
        for n in COUNTS:
            samples = everything[:n]
            for w in (None, weights[:n]) if n < 1000 else (weights[:n],):
                found += [cost(replay, p, samples, w), *normal_equations(replay, p, samples, w)]
        return [*found, residuals(replay, p, samples), *rows(replay, p, samples)]

    theirs = replayed(monkeypatch, work)
    for a, b in zip(work(), theirs, strict=True):
        close(a, b)
    assert compiled(replay)


@pytest.mark.parametrize("n", COUNTS)
def test_a_sum_of_any_output_is_that_of_the_replay(n, monkeypatch):
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 3)
    expression = ca.blockcat([[ca.sin(p[0] * s[0]), 0, s[1]], [0, 3.5, s[2] * s[2] * p[1]]])
    replay = Replay(function(p, s, ca.sparsify(expression)))
    samples = np.random.default_rng(2).normal(size=(n, 3))

    def work():
        return summed(replay, [0.3, 1.2], samples)

    close(work(), replayed(monkeypatch, work))
    assert replay.kernels[0] is not None


def test_no_samples_give_zero_sums():
    replay, none = Replay(model()), np.zeros((0, 5))
    assert cost(replay, [0.4, -1.2, 2.0, 0.3], none) == 0
    assert not normal_equations(replay, [0.4, -1.2, 2.0, 0.3], none).matrix.any()
    assert residuals(replay, [0.4, -1.2, 2.0, 0.3], none).shape == (0, 3)


def test_sixty_parameters_fit_into_small_chunks(monkeypatch):
    n = 60
    p, s = ca.SX.sym("p", n), ca.SX.sym("s", n)
    r = ca.vertcat(*(ca.sin(ca.dot(p, s) + k) for k in range(2)), p[0] * s[0] - 1)
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    rng = np.random.default_rng(3)
    x, samples = rng.normal(size=n), rng.normal(size=(1001, n))

    def work():
        return normal_equations(replay, x, samples)

    for a, b in zip(work(), replayed(monkeypatch, work), strict=True):
        close(a, b)
    assert compiled(replay)


def test_without_parameters_or_signals_there_are_still_sums():
    p, s = ca.SX.sym("p", 0), ca.SX.sym("s")
    none = Replay(function(p, s, 2 * s, ca.SX(1, 0)))
    assert cost(none, [], np.array([[1.0], [3.0]])) == 0.5 * (4 + 36)
    assert normal_equations(none, [], np.array([[1.0], [3.0]])).matrix.shape == (0, 0)
    p, s = ca.SX.sym("p"), ca.SX.sym("s", 0)
    blind = Replay(function(p, s, 2 * p, ca.SX(2)))
    normal = normal_equations(blind, [3.0], np.zeros((5, 0)))
    assert (normal.cost, normal.gradient[0], normal.matrix[0, 0]) == (90, 60, 20)
    assert compiled(none)
    assert compiled(blind)


@pytest.mark.parametrize("weighted", [False, True])
def test_what_is_not_finite_appears_in_its_sums_and_nowhere_else(weighted):
    p, s = ca.SX.sym("p", 2), ca.SX.sym("s", 2)
    r = ca.vertcat(p[0] * s[0], p[1] * s[1])
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    samples = np.ones((1003, 2))
    w = np.zeros(samples.shape) if weighted else None  # a weight of zero does not hide it
    for row in (0, 500, 1002):
        samples[row, 0] = NAN
        normal = normal_equations(replay, [2.0, 3.0], samples, w)
        assert np.isnan(cost(replay, [2.0, 3.0], samples, w))
        np.testing.assert_array_equal(np.isnan(normal.gradient), [True, False])
        np.testing.assert_array_equal(np.isnan(normal.matrix), [[True, False], [False, False]])
        np.testing.assert_array_equal(
            np.isnan(residuals(replay, [2.0, 3.0], samples)[:, 0]), np.isnan(samples[:, 0])
        )
        samples[row, 0] = 1.0
    samples[7, 1] = INF
    assert cost(replay, [2.0, 3.0], samples) == INF
    assert normal_equations(replay, [2.0, 3.0], samples).matrix[1, 1] == INF


# -- columns of any kind ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["rows", "columns", "strided", "backwards", "float32", "big-endian", "odd", "mapped"]
)
def test_samples_may_lie_in_memory_in_any_way(kind, tmp_path):
    replay, p = Replay(model()), [0.4, -1.2, 2.0, 0.3]
    plain = np.random.default_rng(4).normal(size=(1003, 5)).astype(np.float32).astype(float)
    samples = {
        "rows": lambda: plain,
        "columns": lambda: np.asfortranarray(plain),
        "strided": lambda: np.repeat(plain, 3, axis=0)[::3],
        "backwards": lambda: plain[::-1].copy()[::-1],
        "float32": lambda: plain.astype(np.float32),
        "big-endian": lambda: plain.astype(">f8"),
        "odd": lambda: misaligned(plain),
        "mapped": lambda: mapped(plain, tmp_path / "samples"),
    }[kind]()
    expected = normal_equations(replay, p, plain.copy())
    found = normal_equations(replay, p, samples)
    assert compiled(replay)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def misaligned(plain):
    """Numbers between bytes, as a packed record of a logger has them."""
    packed = np.zeros(len(plain), dtype=np.dtype([("flag", "u1"), ("v", "f8", 5)]))
    packed["v"] = plain
    return packed["v"]


def mapped(plain, path):
    plain.tofile(path)
    return np.memmap(path, dtype=float, mode="r", shape=plain.shape)


def test_the_number_of_threads_changes_no_digit(monkeypatch):
    replay = residual_and_jacobian(find_model("wheel"))
    rng = np.random.default_rng(5)
    p, samples = rng.uniform(0.5, 1.5, 15), rng.normal(size=(300_001, 4))
    found = []
    for cores in (1, 2, 5):
        monkeypatch.setattr(kernel, "_cores", lambda cores=cores: cores)
        kernel._threads.cache_clear()
        found.append((cost(replay, p, samples), normal_equations(replay, p, samples)))
    kernel._threads.cache_clear()
    for value, normal in found[1:]:
        assert value == found[0][0]
        np.testing.assert_array_equal(normal.matrix, found[0][1].matrix)


# -- the cache, and machines where something is missing --------------------------------------------


def answer(folder, **environment):
    """The cost of a small function, and whether a kernel computed it."""
    os.environ.update({"CASEST_KERNEL": "always", "CASEST_CACHE": str(folder), **environment})
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    r = ca.sin(p * s)
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    found = cost(replay, [2.0], np.linspace(0, 1, 100)[:, None])
    return found, compiled(replay)


@pytest.fixture
def is_compiled(monkeypatch):
    """`answer` in this process, its number checked and the environment put back."""
    expected = 0.5 * float(np.sum(np.sin(2 * np.linspace(0, 1, 100)) ** 2))

    def ask(folder, **environment):
        for name in ("CASEST_KERNEL", "CASEST_CACHE", *environment):
            monkeypatch.setenv(name, "")
        found, by_kernel = answer(folder, **environment)
        monkeypatch.undo()
        assert found == pytest.approx(expected, rel=1e-14)
        return by_kernel

    return ask


def elsewhere(folders):
    """`answer` for each folder, each in a new process, all at once."""
    with multiprocessing.get_context("spawn").Pool(len(folders)) as pool:
        return pool.map(answer, folders, chunksize=1)


def test_a_second_process_uses_what_the_first_compiled(tmp_path, is_compiled):
    assert is_compiled(tmp_path)
    (library,) = tmp_path.iterdir()  # and nothing is left over
    before = library.stat()
    assert elsewhere([tmp_path])[0][1]
    (library,) = tmp_path.iterdir()
    after = library.stat()
    assert (after.st_mtime_ns, after.st_ino) == (before.st_mtime_ns, before.st_ino)


def test_two_processes_may_build_at_once(tmp_path):
    first, second = elsewhere([tmp_path, tmp_path])
    assert first == second
    assert first[1]
    assert [path.suffix for path in tmp_path.iterdir()] == [".so"]


@pytest.mark.parametrize(
    "damage",
    ["cut", "flipped", *(pytest.param(d, marks=pytest.mark.long) for d in ("empty", "text"))],
)
def test_a_damaged_library_is_built_again(tmp_path, is_compiled, damage):
    assert is_compiled(tmp_path / "whole")
    (library,) = (tmp_path / "whole").iterdir()
    whole = library.read_bytes()
    middle = len(whole) // 2
    broken = {
        "cut": whole[:middle],
        "empty": b"",
        "text": b"no library",
        "flipped": whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :],
    }[damage]
    # At a place of its own: to write over a library that a process uses would end the process.
    damaged = tmp_path / "damaged" / library.name
    damaged.parent.mkdir()
    damaged.write_bytes(broken)
    assert is_compiled(damaged.parent)
    assert damaged.read_bytes() != broken


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(kernel, "_cores", lambda: 2)
    replay, samples = Replay(model()), np.ones((200_000, 5))
    expected = cost(replay, [0.4, -1.2, 2.0, 0.3], samples)  # starts threads
    child = multiprocessing.get_context("fork").Process(
        target=lambda: os._exit(cost(replay, [0.4, -1.2, 2.0, 0.3], samples) != expected)
    )
    child.start()
    child.join(20)
    if child.exitcode is None:
        child.kill()
    assert child.exitcode == 0


def test_without_a_compiler_that_works_numpy_takes_over(tmp_path, is_compiled):
    assert not is_compiled(tmp_path, CC="/bin/false")
    assert not is_compiled(tmp_path, CC="/no/such/compiler")
    assert not is_compiled(tmp_path, CASEST_KERNEL="off")
    assert not is_compiled(tmp_path, CASEST_KERNEL="auto")  # too few samples
    assert list(tmp_path.iterdir()) == []


def test_without_a_folder_to_write_to_numpy_takes_over(tmp_path, is_compiled):
    file = tmp_path / "file"
    file.write_text("in the way")
    assert not is_compiled(file)
    assert not is_compiled(file / "below")
    assert not is_compiled(Path("/proc/casest"))


@pytest.mark.parametrize("base", ["", "relative"])
def test_without_a_home_numpy_takes_over(tmp_path, monkeypatch, is_compiled, base):
    """No home folder at all, as in some containers; a cache folder that is named relatively."""

    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    assert not is_compiled("", XDG_CACHE_HOME=base)
    assert not Path("relative").exists()
    assert is_compiled("", XDG_CACHE_HOME=str(tmp_path))


posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners of files on this system")


@posix
def test_what_is_cached_is_the_users_alone(tmp_path, is_compiled):
    before = os.umask(0)
    try:
        assert is_compiled(tmp_path / "new")
    finally:
        os.umask(before)
    (library,) = (tmp_path / "new").iterdir()
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "new", library)]
    assert modes == [0o700, 0o700]


@posix
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o722])
def test_a_folder_that_others_can_write_is_no_cache(tmp_path, is_compiled, mode):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(mode)
    assert not is_compiled(tmp_path / "open")
    (tmp_path / "open" / "below").mkdir(mode=0o700)  # others could exchange it
    assert not is_compiled(tmp_path / "open" / "below")
    (tmp_path / "open").chmod(0o1777)  # as /tmp is
    assert is_compiled(tmp_path / "open" / "below")


@posix
def test_a_folder_that_is_a_link_is_no_cache(tmp_path, is_compiled):
    (tmp_path / "own").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "own")
    assert not is_compiled(tmp_path / "link")
    assert is_compiled(tmp_path / "link" / "below")


@posix
def test_a_folder_or_a_file_of_another_user_is_no_cache(tmp_path, monkeypatch, is_compiled):
    assert is_compiled(tmp_path / "own")
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert not is_compiled(tmp_path / "own")
    monkeypatch.undo()
    assert is_compiled(tmp_path / "own")


@posix
@pytest.mark.parametrize("how", ["others can write it", "a link"])
def test_a_library_that_others_may_have_written_is_built_again(tmp_path, is_compiled, how):
    assert is_compiled(tmp_path / "first")
    (library,) = (tmp_path / "first").iterdir()
    other = tmp_path / "second" / library.name
    other.parent.mkdir()
    if how == "a link":
        other.symlink_to(library)
    else:
        shutil.copy(library, other)
        other.chmod(0o777)
    before = os.lstat(other).st_ino
    assert is_compiled(other.parent)
    found = os.lstat(other)
    assert found.st_ino != before
    assert stat.S_ISREG(found.st_mode)
    assert stat.S_IMODE(found.st_mode) == 0o700


def test_a_model_that_is_only_tried_is_not_compiled_unless_its_record_is_very_long(monkeypatch):
    """Closing the loop evaluates dozens of models a few times: compilers would take longer."""
    monkeypatch.setenv("CASEST_KERNEL", "auto")
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    r = ca.sin(p * s)
    for count, expected in ((10_000, False), (kernel.TRIED, True)):
        replay = Replay(function(p, s, r, ca.jacobian(r, p)))
        samples = np.linspace(0, 1, count)[:, None]
        with kernel.only_tried():
            cost(replay, [2.0], samples)
        assert compiled(replay) == expected
    replay = Replay(function(p, s, r, ca.jacobian(r, p)))
    cost(replay, [2.0], np.linspace(0, 1, 10_000)[:, None])
    assert compiled(replay)


@pytest.mark.long
def test_a_result_says_which_kernel_it_is_of_and_they_differ_in_the_last_digits(tmp_path, cache):
    def estimate(wish, expected):
        environment = {**os.environ, "CASEST_KERNEL": wish, "CASEST_CACHE": str(cache)}
        words = [sys.executable, "-c", "from casest.cli import main; main()", "calibrate"]
        subprocess.run([*words, *POSES, "-o", str(tmp_path)], env=environment, check=True)
        result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
        assert result["solver"]["kernel"] == expected
        return result["estimate"]

    numpy, compiled = estimate("off", "numpy"), estimate("always", "compiled")
    assert estimate("always", "compiled") == compiled
    for name, p in numpy["parameters"].items():
        value, std = np.array(p["value"]), np.array(p["std"])
        other = np.array(compiled["parameters"][name]["value"])
        assert (np.abs(value - other) <= 1e-9 * std).all()


def test_values_of_single_samples_have_the_digits_of_the_replay(monkeypatch):
    """Sums, products and quotients alone: nothing is contracted. Sparse outputs are made dense."""
    p, x = ca.SX.sym("p", 2), ca.SX.sym("x", 3)
    matrix = ca.SX(2, 3)
    matrix[0, 1], matrix[1, 2] = p[0] * x[0] + x[1], x[2] / (1 + x[0] ** 2) - p[1]
    function = ca.Function("f", [p, x], [matrix, ca.vertcat(3 * p[0], x[1])],
                           ["parameters", "sample"], ["a", "b"])  # fmt: skip
    samples = Columns([np.random.default_rng(0).standard_normal((1001, 3))])
    known = np.array([0.7, -1.3])
    monkeypatch.setenv("CASEST_KERNEL", "always")
    compiled = evaluated(Replay(function), known, samples)
    for found, expected in zip(compiled, Replay(function)(known, samples), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_allclose(
        compiled[0][5, 0, 1], 0.7 * samples.dense[5, 0] + samples.dense[5, 1]
    )
