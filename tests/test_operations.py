"""Every row of the one table of operations says the same thing in all its columns: CasADi's."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import casest
from casest import Residual, UnitError, model, param, quantity, signal
from casest.cli import run as command
from casest.correction import numpy_table
from casest.declaration.dimensions import check_units
from casest.engine import Replay
from casest.engine.operations import BY_CODE, OPERATIONS, Units
from casest.errors import CasestError

CODES = {name: getattr(ca, name) for name in dir(ca) if name.startswith("OP_")}
LABELS = {code: name[3:].lower() for name, code in CODES.items()}
#: Instructions that move numbers and compute nothing.
MOVES = {"OP_CONST", "OP_INPUT", "OP_OUTPUT"}
each = pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: LABELS[o.code])
exported = pytest.mark.parametrize(
    "operation", [o for o in OPERATIONS if o.numpy is not None], ids=lambda o: LABELS[o.code]
)


def samples():
    """Pairs of all signs and sizes, equal ones and zeros among them; exact as `float` too."""
    rng = np.random.default_rng(0)
    wide = rng.normal(size=(600, 2)) * 10.0 ** rng.uniform(-3, 3, size=(600, 2))
    near = rng.uniform(-1, 1, size=(300, 2))
    some = np.array([-2.5, -1.0, 0.0, 0.5, 1.0, 3.0])
    every = np.concatenate([wide, near, np.array(np.meshgrid(some, some)).reshape(2, -1).T])
    return every.astype(np.float32).astype(float)


X = samples()


def expression(operation, x, y):
    """CasADi's own; where it has an exponent that is no symbol, the constant 2.5."""
    if operation.code == ca.OP_CONSTPOW:
        return x**2.5
    if operation.arity == 1:
        return ca.SX.unary(operation.code, x)
    return ca.SX.binary(operation.code, x, y)


def given(operation, scales=(1.0, 1.0)):
    """The operands, as many as it reads."""
    a, b = (scale * column for scale, column in zip(scales, X.T, strict=True))
    if operation.code == ca.OP_CONSTPOW:
        b = np.full(len(X), 2.5)
    return [a.copy(), b.copy()][: operation.arity]


def truth(operation, operands):
    """What CasADi's virtual machine makes of them."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = ca.Function("f", [x, y], [ca.densify(expression(operation, x, y))])
    columns = [operands[0], operands[-1]]
    return np.array(f.map(len(X)).call([ca.DM(c).T for c in columns])[0]).ravel()


def assert_same(found, expected, rtol=1e-14, atol=0.0):
    found = np.broadcast_to(np.asarray(found, dtype=float), expected.shape)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol, equal_nan=True)


# -- one meaning in every column -------------------------------------------------------------------


@each
def test_the_kernel_is_casadis(operation):
    operands, found = given(operation), np.empty(len(X))
    with np.errstate(all="ignore"):
        operation.kernel(*operands, found)
    assert_same(found, truth(operation, given(operation)))


@each
def test_the_kernel_may_write_over_any_operand(operation):
    for k in range(operation.arity):
        operands = given(operation)
        with np.errstate(all="ignore"):
            operation.kernel(*operands, operands[k])
        assert_same(operands[k], truth(operation, given(operation)))


@pytest.mark.parametrize(
    "operation", [o for o in OPERATIONS if o.python], ids=lambda o: LABELS[o.code]
)
def test_pythons_numbers_give_casadis(operation):
    operands = given(operation)
    pairs = zip(operands[0].tolist(), operands[-1].tolist(), strict=True)
    with np.errstate(all="ignore"):
        assert_same([operation.python(a, b) for a, b in pairs], truth(operation, operands), rtol=0)


@exported
def test_the_text_of_an_exported_module_is_casadis(operation):
    operands = given(operation)
    with np.errstate(all="ignore"):
        found = numpy_table.OPERATIONS[operation.name](*operands)
    assert_same(found, truth(operation, operands))


def functions(expressions, number, head):
    """C source with a function for each: void f3(const number *a, const number *b, number *out)."""
    text = [*head, f"typedef {number} real;"]
    for k, expression in expressions.items():
        text += [f"void f{k}(long n, const real *a, const real *b, real *out) {{"]
        text += ["  for (long l = 0; l < n; ++l) {", "    const real x = a[l], y = b[l];"]
        text += ["    (void)y;", f"    out[l] = {expression.format('x', 'y')};", "  }", "}"]
    return "\n".join([*text, ""])


def built(folder, text, flags):
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    (folder / "f.c").write_text(text)
    words = [compiler, "-shared", "-fPIC", *flags, str(folder / "f.c"), "-o", str(folder / "f.so")]
    subprocess.run([*words, "-lm"], check=True)
    return ctypes.CDLL(str(folder / "f.so"))


def called(library, operation, kind):
    operands = [np.ascontiguousarray(x, dtype=kind) for x in given(operation)]
    found = np.empty(len(X), dtype=kind)
    places = (ctypes.c_void_p(x.ctypes.data) for x in (operands[0], operands[-1], found))
    getattr(library, f"f{operation.code}")(ctypes.c_long(len(X)), *places)
    return found


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    text = functions({o.code: o.c for o in OPERATIONS}, "double", ["#include <math.h>"])
    return built(tmp_path_factory.mktemp("kernels"), text, ["-std=gnu11", "-O1", "-w"])


@pytest.fixture(scope="module", params=["double", "float"])
def sources(request, tmp_path_factory):
    rows = {o.code: o.exported_c for o in OPERATIONS if o.numpy is not None}
    text = functions(rows, request.param, ["#include <math.h>", "#include <tgmath.h>"])
    strict = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    return built(tmp_path_factory.mktemp(request.param), text, [*strict, "-O1"]), request.param


@each
def test_the_c_of_compiled_kernels_is_casadis(kernels, operation):
    assert_same(called(kernels, operation, np.float64), truth(operation, given(operation)))


@exported
def test_the_exported_c_is_casadis_in_double_and_float(sources, operation):
    library, number = sources
    found = called(library, operation, np.float64 if number == "double" else np.float32)
    expected = truth(operation, given(operation))
    if number == "double":
        assert_same(found, expected)
    else:
        with np.errstate(over="ignore"):
            assert_same(found, expected.astype(np.float32).astype(float), 1e-6, atol=1e-37)


# -- units: what scaling the operands does ---------------------------------------------------------

#: They round to whole units, and ask whether a number is zero.
ROUNDING, LOGICAL = {"floor", "ceil"}, {"not", "and", "or"}


def scaled(operation):
    """Operands in units a fourth, a sixteenth as large, and by what the result must grow."""
    if isinstance(operation.units, tuple):
        scales = (4.0, 16.0)
        powers = (float(p) for p in operation.units)
        return scales, np.prod([s**p for s, p in zip(scales, powers, strict=False)])
    return {
        Units.SAME: ((4.0, 4.0), 4.0),
        Units.COMPARED: ((4.0, 4.0), 1.0),
        Units.FIRST: ((4.0, 1.0), 4.0),
        Units.LAST: ((1.0, 4.0), 4.0),
    }[operation.units]


@pytest.mark.parametrize(
    "operation",
    [
        o
        for o in OPERATIONS
        if o.units not in (Units.PURE, Units.ANGLE, Units.ANY) and o.name not in ROUNDING
    ],
    ids=lambda o: LABELS[o.code],
)
def test_the_rule_for_units_is_what_scaling_does(operation):
    scales, factor = scaled(operation)
    expected = factor * truth(operation, given(operation))
    assert_same(truth(operation, given(operation, scales)), expected)


@pytest.mark.parametrize("operation", [o for o in OPERATIONS if o.units is Units.ANGLE])
def test_angles_are_in_radians(operation):
    operands = given(operation)
    turned = [operands[0] + 2 * np.pi]
    moderate = np.abs(operands[0]) < 1.5
    found, expected = truth(operation, turned), truth(operation, operands)
    assert_same(found[moderate], expected[moderate], atol=1e-12)  # 2π itself is rounded


@pytest.mark.parametrize(
    "operation", [o for o in OPERATIONS if o.units is Units.PURE and o.name not in LOGICAL]
)
def test_what_must_be_a_pure_number_could_not_have_a_unit(operation):
    """No power of the scale comes out: the value would depend on the unit."""
    before, after = (truth(operation, given(operation, (s, s))) for s in (1.0, 2.0))
    with np.errstate(all="ignore"):
        growth = after / before
    growth = growth[np.isfinite(growth)]
    assert np.ptp(growth) > 0.01


def declared(operation, x="m^2", y="s^2", result="kg"):
    """A model whose only operation this is, with its result declared in a unit."""

    @model
    def single(x=signal(x), y=signal(y), z=signal("V"), *, a=param("V")):
        quantity("result", expression(operation, x, y), result)
        return Residual(measured=z, predicted=a)

    return single


def result_unit(operation):
    """Of operands in m² and s², or both in m² where they must agree; else a pure number."""
    if isinstance(operation.units, tuple):
        bases = zip(("m", "s"), operation.units, strict=False)
        return "*".join(f"{base}^{int(2 * power)}" for base, power in bases)
    return {Units.SAME: "m^2", Units.FIRST: "m^2", Units.LAST: "s^2"}.get(operation.units, "")


@each
def test_the_rule_for_units_is_followed_in_declarations(operation):
    pure = operation.units in (Units.PURE, Units.ANGLE)
    both = operation.units in (Units.SAME, Units.COMPARED)
    x, y = ("", "") if pure else ("m^2", "m^2" if both else "s^2")
    check_units(declared(operation, x, y, result_unit(operation)))
    if operation.units is not Units.ANY:
        with pytest.raises(UnitError, match="quantity result is declared in kg"):
            check_units(declared(operation, x, y, "kg"))
    if both:
        with pytest.raises(UnitError, match=r"units do not fit: m\^2 .* against s\^2"):
            check_units(declared(operation, "m^2", "s^2", result_unit(operation)))
    if pure:
        with pytest.raises(UnitError, match=f"the argument of {operation.name}: units do not fit"):
            check_units(declared(operation, "m^2", "m^2", ""))


# -- what is not in the table ----------------------------------------------------------------------


def inlined_never(a, b):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    return ca.Function("g", [x, y], [ca.sin(x) * y], {"never_inline": True})(a, b)


def in_functions():
    """What CasADi puts into functions of SX, by name: each as an expression of two numbers."""
    found = {"OP_CALL": inlined_never}
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    for name in CODES.keys() - MOVES:
        code = CODES[name]
        for made in (partial(ca.SX.binary, code), lambda a, _, code=code: ca.SX.unary(code, a)):
            f = ca.Function("f", [x, y], [made(x, y)])
            if code in (f.instruction_id(k) for k in range(f.n_instructions())):
                found[name] = made
    return found


IN_FUNCTIONS = in_functions()
UNKNOWN = {name: made for name, made in IN_FUNCTIONS.items() if CODES[name] not in BY_CODE}


def test_all_that_casadi_computes_of_numbers_is_known_but_three():
    assert set(UNKNOWN) <= {"OP_ERFINV", "OP_PRINTME", "OP_CALL"}
    assert len(IN_FUNCTIONS) > 45  # so that the list above is not empty for another reason
    assert len(BY_CODE) == len(OPERATIONS)  # none stands there twice


@pytest.mark.parametrize("name", sorted(UNKNOWN))
def test_an_unknown_operation_is_named_wherever_it_is_met(name):
    said = f"uses the operation {name}, which casest does not know: write the expression without"
    p, s = ca.SX.sym("p"), ca.SX.sym("s")
    f = ca.Function("f", [p, s], [UNKNOWN[name](p, s)], ["parameters", "sample"], ["r"])
    with pytest.raises(CasestError, match=f"function 'f' {said}"):
        Replay(f)

    @model
    def single(x=signal("m"), y=signal("m"), *, a=param("")):
        return Residual(measured=y, predicted=UNKNOWN[name](a, x))

    with pytest.raises(CasestError, match=f"model single {said}"):
        check_units(single)


MODEL = '''
import casadi
from casest import Residual, model, param, quantity, signal


@model
def soft(x=signal("V"), y=signal("V"), *, scale=param("1/V", start=0.5), top=param("V", start=1)):
    """A limit that is approached as the error function is."""
    force = quantity("force", x, "V")
    return Residual(measured=y, predicted=quantity("reading", top * casadi.erf(scale * force), "V"),
                    corrected=force)
'''


def test_what_is_not_exported_is_named(tmp_path, capsys):
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, 60)
    from scipy.special import erf

    y = 1.3 * erf(0.8 * x) + 1e-3 * rng.normal(size=60)
    (tmp_path / "soft.py").write_text(MODEL)
    header = "x [V],y [V]"
    np.savetxt(
        tmp_path / "d.csv", np.column_stack([x, y]), delimiter=",", header=header, comments=""
    )
    words = ["calibrate", str(tmp_path / "soft.py"), str(tmp_path / "d.csv")]
    assert command([*words, "-o", str(tmp_path / "o")]) == 0
    capsys.readouterr()
    assert command(["export", str(tmp_path / "o"), "--to", "c"]) == 1
    said = capsys.readouterr().err
    assert "the correction uses the operation erf, which is not exported" in said
    assert "correct with casest apply" in said
    assert command(["apply", str(tmp_path / "o"), str(tmp_path / "d.csv")]) == 0
    rows = capsys.readouterr().out.splitlines()[1:]
    np.testing.assert_allclose([float(row.split(",")[-1]) for row in rows], x, atol=0.02)


#: Modules with an algebra of their own, to which an operation that they do not name is opaque: sums
#: multiplied out, from which zero a temperature counts, how far an unknown reaches, where it jumps.
ALGEBRAS = {"grouping.py", "temperatures.py", "arguments.py", "stepping.py"}


def test_no_other_module_lists_operations():
    root = Path(casest.__file__).parent
    for path in root.rglob("*.py"):
        named = set(re.findall(r"\bOP_[A-Z0-9_]+", path.read_text(encoding="utf-8")))
        if path.name not in ALGEBRAS | {"operations.py"}:
            assert named <= MOVES, f"{path.relative_to(root)} names {sorted(named - MOVES)}"
