"""C99 source of a correction: fixed memory, no dependency but the mathematics library."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from casest import __version__
from casest.correction.inverse import LEFT
from casest.correction.program import Program
from casest.declaration.shapes import Array
from casest.engine.operations import OPERATIONS
from casest.escaping import c_comment

_C = {operation.name: operation.exported_c for operation in OPERATIONS}
_NEWTON = """
/* Newton's method, every step halved until it gains, as casest does it. */
static int solve(const real *x, real *value, real start) {{
  real in[{width} + {n}], out[2 * {n}], next[2 * {n}], trial[{n}];
  for (int i = 0; i < {width}; ++i) in[i] = x[i];
  for (int i = 0; i < {n}; ++i) value[i] = start < FROM_READING ? start : x[{at} + i];
  for (int i = 0; i < {n}; ++i) in[{width} + i] = value[i];
  run(in, out);
  for (int k = 0; k < 60; ++k) {{
    real share = 1, moved = 0, size = 1;
    int gained = 0;
    for (int h = 0; h < 30 && !gained; ++h, share /= 2) {{
      real before = 0, after = 0;
      for (int i = 0; i < {n}; ++i) in[{width} + i] = trial[i] = value[i] + share * out[i];
      run(in, next);
      for (int i = 0; i < {n}; ++i) {{
        before += out[{n} + i] * out[{n} + i];
        after += next[{n} + i] * next[{n} + i];
      }}
      gained = after <= before;
    }}
    if (!gained) break;
    for (int i = 0; i < {n}; ++i) {{
      if (fabs(trial[i] - value[i]) > moved) moved = fabs(trial[i] - value[i]);
      if (1 + fabs(value[i]) > size) size = 1 + fabs(value[i]);
      value[i] = trial[i];
    }}
    for (int i = 0; i < 2 * {n}; ++i) out[i] = next[i];
    if (moved <= EXACT * size) break;
  }}
  for (int i = 0; i < {n}; ++i) {{
    if (!isfinite(value[i]) || !(fabs(out[{n} + i]) <= CLOSE * {largest})) return 0;
  }}
  return 1;
}}

int {name}(const real *x, real *corrected) {{
  static const real starts[] = {{{starts}}};
  real best = INFINITY;
  for (unsigned k = 0; k < sizeof starts / sizeof *starts; ++k) {{
    real value[{n}], away = 0;
    if (!solve(x, value, starts[k])) continue;
    for (int i = 0; i < {n}; ++i)
      if (fabs(value[i] - MIDDLE) > away) away = fabs(value[i] - MIDDLE);
    if (away < best) {{
      best = away;
      for (int i = 0; i < {n}; ++i) corrected[i] = value[i];
    }}
  }}
  return best < INFINITY ? 0 : 1;
}}
"""
_DIRECT = """
int {name}(const real *x, real *corrected) {{
  run(x, corrected);
  for (int i = 0; i < {n}; ++i)
    if (!isfinite(corrected[i])) return 1;
  return 0;
}}
"""
_SPREAD = """
/* Standard deviations of a corrected sample, {n} each: by the parameters, by the reading's own
 * noise, by the references, and together. Returns 0, or 1 where one is no number. */
int {name}_std(const real *x, const real *corrected, real *std);
int {name}_std(const real *x, const real *corrected, real *std) {{
  real in[{width} + {n}];
  for (int i = 0; i < {width}; ++i) in[i] = x[i];
  for (int i = 0; i < {n}; ++i) in[{width} + i] = corrected[i];
  run_spread(in, std);
  for (int i = 0; i < 4 * {n}; ++i)
    if (!isfinite(std[i])) return 1;
  return 0;
}}
"""
_TEST = """
#ifdef CASEST_SELF_TEST
/* cc -DCASEST_SELF_TEST {name}.c -lm && ./a.out: against the values that casest computed. */
#include <stdio.h>
int main(void) {{
  static const real x[][{width}] = {{
{inputs}
  }};
  static const real expected[][{n}] = {{
{outputs}
  }};
  double worst = 0;
  for (unsigned k = 0; k < sizeof x / sizeof *x; ++k) {{
    real found[{n}], size = 0;
    if ({name}(x[k], found)) {{
      printf("row %u: no corrected value\\n", k);
      return 1;
    }}
    for (int i = 0; i < {n}; ++i) if (fabs(expected[k][i]) > size) size = fabs(expected[k][i]);
    for (int i = 0; i < {n}; ++i) {{
      double away = fabs(found[i] - expected[k][i]) / (size > 0 ? size : 1);
      if (!(away <= worst)) worst = away;
    }}
  }}
  printf("largest error %.2g of the value\\n", worst);
  return !(worst <= {tolerance});
}}
#endif
"""


def c_source(
    program: Program,
    name: str,
    single: bool,
    test: tuple[Array, Array],
    spread: Program | None = None,
) -> str:
    """The source file, with a self-test on `test` (inputs, corrected) under a macro.

    `single` computes with `float` instead of `double`.
    """
    n, width = program.output.size, program.width
    lines = [_head(program, name, single)]
    lines += [*function("run", program.steps, program.registers)]
    if program.kind == "direct":
        lines.append(_DIRECT.format(name=name, n=n))
    else:
        assert program.measured is not None
        starts = [number(s) for s in program.starts]
        starts += ["FROM_READING"] * (program.measured[1] == n)
        lines.append(
            _NEWTON.format(
                name=name,
                n=n,
                width=width,
                at=program.measured[0],
                starts=", ".join(starts),
                largest=number(program.largest),
            )
        )
    if program.seen:
        lines.append(_extrapolates(program, name))
    if spread is not None:
        lines += [*function("run_spread", spread.steps, spread.registers)]
        lines.append(_SPREAD.format(name=name, n=n, width=width))
    inputs, outputs = (_rows(part) for part in test)
    tolerance = "2e-4" if single else "1e-9"
    lines.append(
        _TEST.format(
            name=name, n=n, width=width, inputs=inputs, outputs=outputs, tolerance=tolerance
        )
    )
    return "\n".join(lines)


def _extrapolates(program: Program, name: str) -> str:
    """A function that says whether a sample lies outside what the calibration saw."""
    ends = [("-INFINITY", "INFINITY") if s is None else tuple(map(number, s)) for s in program.seen]
    low, high = (", ".join(column) for column in zip(*ends, strict=True))
    return (
        "/* 1 where x lies outside what the calibration saw: the correction extrapolates. */\n"
        f"int {name}_extrapolates(const real *x) {{\n"
        f"  static const real low[] = {{{low}}};\n"
        f"  static const real high[] = {{{high}}};\n"
        f"  for (int i = 0; i < {program.width}; ++i)\n"
        "    if (!(x[i] >= low[i] && x[i] <= high[i])) return 1;\n"
        "  return 0;\n"
        "}\n"
    )


def _head(program: Program, name: str, single: bool) -> str:
    """What a reader must know to call it."""
    said = [
        f"{program.output.name} of {program.model}, exported by casest {__version__}.",
        "",
        "x: one sample,",
    ]
    place = 0
    for i in program.inputs:
        places = f"x[{place}]" if i.size == 1 else f"x[{place}]..x[{place + i.size - 1}]"
        said.append(f"  {places}  {i.name} [{i.unit or '1'}]")
        place += i.size
    said += [
        f"corrected: {program.output.size} values [{program.output.unit or '1'}].",
        *([f"{LEFT}{', '.join(program.left)}."] if program.left else []),
        "Returns 0, or 1 where the reading lies outside what the model can produce.",
    ]
    lines = [
        *(f"{' *' if k else '/*'} {c_comment(line)}".rstrip() for k, line in enumerate(said)),
        " */",
        "#include <math.h>",
        "#include <tgmath.h>",
        "",
        f"typedef {'float' if single else 'double'} real;",
        f"int {name}(const real *x, real *corrected);",
        *([f"int {name}_extrapolates(const real *x);"] if program.seen else []),
    ]
    if program.kind == "newton":
        close, exact = ("1e-5f", "2e-7f") if single else ("1e-9", "1e-14")
        lines += [
            f"#define CLOSE {close}",
            f"#define EXACT {exact}",
            f"#define MIDDLE {number(program.middle)}",
            "#define FROM_READING (real)1e30",
        ]
    return "\n".join([*lines, ""])


def function(name: str, steps: Sequence[tuple[Any, ...]], registers: int) -> Iterator[str]:
    """`static void NAME(const real *in, real *out)`: a list of operations (see `Program`)."""
    yield f"static void {name}(const real *in, real *out) {{"
    yield f"  real w[{max(registers, 1)}];"
    for operation, place, *rest in steps:
        if operation == "input":
            yield f"  w[{place}] = in[{rest[0]}];"
        elif operation == "constant":
            yield f"  w[{place}] = {number(rest[0])};"
        elif operation == "output":
            yield f"  out[{place}] = w[{rest[0]}];"
        else:
            operands = [f"w[{r}]" for r in rest]
            yield f"  w[{place}] = {_C[operation].format(*operands)};"
    yield "}"


def number(value: float) -> str:
    """A literal of the right type, to the last digit."""
    return f"(real){float(value)!r}"


def _rows(values: Array) -> str:
    rows: Sequence[str] = ["    {" + ", ".join(number(x) for x in row) + "}," for row in values]
    return "\n".join(rows)
