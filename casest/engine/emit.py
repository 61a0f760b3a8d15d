"""C source of least-squares sums from the instruction list that `replay` holds.

One loop turn works on a chunk of samples, held as rows of an array in the first-level cache: first
every entry of residual and Jacobian for the whole chunk, then their products. Each loop over the
chunk has no branches, so that the compiler puts one sample into each SIMD lane.
"""

from __future__ import annotations

from collections.abc import Iterator

from casest.engine.operations import BY_CODE
from casest.engine.replay import Entry, Plan, Replay

#: Instructions of one loop: the time that compilers take grows with the square of it.
_LONGEST = 200
#: Bytes of a chunk's values: they stay in the first-level cache.
_CACHE = 24_000
#: Chunks after which the lanes are emptied into the total: sums of sums keep rounding small.
_FLUSH = 8
#: Rows and columns of a tile of products: its sums stay in registers.
_TILE = 4

_HEAD = """\
#include <math.h>
#include <stddef.h>
#ifdef SIMD_MATH
__attribute__((simd("notinbranch"), const)) double sin(double);
__attribute__((simd("notinbranch"), const)) double cos(double);
__attribute__((simd("notinbranch"), const)) double exp(double);
__attribute__((simd("notinbranch"), const)) double log(double);
__attribute__((simd("notinbranch"), const)) double pow(double, double);
#endif
#define B {chunk}
#define LANES 8
typedef double lanes __attribute__((vector_size(64), aligned(8), may_alias));
"""

_PRODUCTS = """\
#define UNROLLED _Pragma("GCC unroll 4") for
#define TILE(R, C) \\
  static __attribute__((noinline)) void tile_##R##_##C( \\
      const double (*x)[B], const double (*y)[B], lanes *sum) { \\
    lanes s[R][C]; \\
    UNROLLED (int i = 0; i < R; ++i) \\
      UNROLLED (int j = 0; j < C; ++j) s[i][j] = sum[i * C + j]; \\
    for (int l = 0; l < B; l += LANES) \\
      UNROLLED (int i = 0; i < R; ++i) \\
        UNROLLED (int j = 0; j < C; ++j) \\
          s[i][j] += *(const lanes *)(x[i] + l) * *(const lanes *)(y[j] + l); \\
    UNROLLED (int i = 0; i < R; ++i) \\
      UNROLLED (int j = 0; j < C; ++j) sum[i * C + j] = s[i][j]; \\
  }
static inline double total(lanes s) {
  return ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]));
}
"""


def source(replay: Replay, components: list[list[Entry]]) -> str:
    """C source with `casest_cost`, `casest_normal` and `casest_values`.

    `components` lists for each residual its entries of the Jacobian and itself, as in `normal`.
    Of every component the products a_i·a_j, j ≥ i, are summed, row by row.
    """
    entries = [entry for own in components for entry in own]
    residuals = [own[-1] for own in components]
    chunk = max(16, min(128, _CACHE // (8 * len(entries)) // 8 * 8))
    # Not str.format: C has braces of its own.
    parts = [_HEAD.replace("{chunk}", str(chunk)), _PRODUCTS]
    parts += _block("all", replay.plan(entries), len(entries))
    parts += _block("residual", replay.plan(residuals), len(residuals))
    parts.append(_normal([len(own) for own in components]))
    parts.append(_cost(len(residuals)))
    parts.append(_values("all", len(entries)))
    parts.append(_values("residual", len(residuals)))
    return "\n".join(parts)


def source_of_sum(replay: Replay, output: int) -> str:
    """C source with `casest_sum`: each entry of one output, added over all samples."""
    entries = replay.entries(output)
    chunk = max(16, min(128, _CACHE // (8 * max(len(entries), 1)) // 8 * 8))
    parts = [_HEAD.replace("{chunk}", str(chunk)), _PRODUCTS]
    parts += _block("all", replay.plan(entries), len(entries))
    parts.append(_sum(len(entries)))
    return "\n".join(parts)


def source_of_values(replay: Replay) -> str:
    """C source with `casest_records`: all outputs of every sample, one dense after the other."""
    outputs = range(len(replay.shapes))
    entries = [entry for i in outputs for entry in replay.entries(i)]
    plan = replay.plan(entries)
    rows = len(entries) + len(plan.inputs) + _loops(plan, _places_of(plan.scalars))[1]
    chunk = max(16, min(128, _CACHE // (8 * max(rows, 1)) // 8 * 8))
    parts = [_HEAD.replace("{chunk}", str(chunk))]
    parts += _block("all", plan, len(entries))
    parts.append(_records(replay, len(entries)))
    return "\n".join(parts)


def _records(replay: Replay, count: int) -> str:
    """Every entry of every sample, where it is in dense outputs: result[sample][place]."""
    places, width = list[int](), 0
    for (rows, columns), (row, column) in zip(replay.shapes, replay.sparsity, strict=True):
        places += (width + row * columns + column).tolist()
        width += rows * columns
    return "\n".join(
        [
            "const int casest_normal_count = 0;",
            f"static const int place[] = {{{', '.join(map(str, places)) or '0'}}};",
            f"void casest_records{_SIGNATURE} {{",
            _BUFFERS.format(name="all"),
            "  (void)w;",
            "  for (ptrdiff_t first = 0; first < n; first += B) {",
            _READ.format(name="all"),
            "    for (int l = 0; l < length; ++l)",
            f"      for (int k = 0; k < {count}; ++k)",
            f"        result[(first + l) * {width} + place[k]] = v[k][l];",
            "  }",
            "}",
        ]
    )


def _block(name: str, plan: Plan, wanted: int) -> Iterator[str]:
    """A function for what depends on parameters only, and one for the entries of a chunk."""
    values = plan.graph.values
    scalars = _places_of(plan.scalars)
    lines = [f"static void scalars_{name}(const double *p, double *c) {{"]
    for i, k in scalars.items():
        lines.append(f"  c[{k}] = {_scalar(values[i], scalars)};")
    lines.append("}")
    loops, kept = _loops(plan, scalars)
    # Functions, not loops of one function, keep the compiler's time from growing with a square.
    for k, loop in enumerate(loops):
        lines += [f"static __attribute__((noinline)) void block_{name}_{k}({_PLACES}) {{"]
        lines += ["  for (int l = 0; l < B; ++l) {", *loop, "  }", "}"]
    lines.append(f"static void block_{name}(const double *c, double (*in)[B], double (*out)[B]) {{")
    lines.append(f"  double kept[{max(kept, 1)}][B] __attribute__((aligned(64)));")
    lines += [f"  block_{name}_{k}(c, in, kept, out);" for k in range(len(loops))]
    for row, i in enumerate(plan.wanted):
        if i in scalars:
            lines.append(f"  for (int l = 0; l < B; ++l) out[{row}][l] = c[{scalars[i]}];")
        elif values[i].kind == "sample":
            source = plan.inputs.index(i)
            lines.append(f"  for (int l = 0; l < B; ++l) out[{row}][l] = in[{source}][l];")
        elif plan.home[i] != row:
            lines.append(f"  for (int l = 0; l < B; ++l) out[{row}][l] = out[{plan.home[i]}][l];")
    lines.append("}")
    lines.append(f"enum {{ SCALARS_{name} = {max(len(scalars), 1)}, WANTED_{name} = {wanted},")
    lines.append(f"       INPUTS_{name} = {max(len(plan.inputs), 1)} }};")
    which = ", ".join(str(values[i].code) for i in plan.inputs) or "0"
    lines.append(f"static const int input_{name}[] = {{{which}}};")
    lines.append(f"static const int inputs_{name} = {len(plan.inputs)};")
    yield "\n".join(lines)


#: What a part of a chunk's instructions is given: scalars, signals, values of other parts, results.
_PLACES = (
    "const double *restrict c, const double (*restrict in)[B], double (*restrict kept)[B], "
    "double (*restrict out)[B]"
)


def _places_of(values: list[int]) -> dict[int, int]:
    return {i: k for k, i in enumerate(values)}


def _scalar(value: object, place: dict[int, int]) -> str:
    kind = value.kind  # type: ignore[attr-defined]
    if kind == "constant":
        return _number(value.constant)  # type: ignore[attr-defined]
    if kind == "parameter":
        return f"p[{value.code}]"  # type: ignore[attr-defined]
    operands = [f"c[{place[j]}]" for j in value.operands]  # type: ignore[attr-defined]
    return BY_CODE[value.code].c.format(*operands)  # type: ignore[attr-defined]


def _number(constant: float) -> str:
    if constant != constant:
        return "NAN"
    if constant in (float("inf"), float("-inf")):
        return "INFINITY" if constant > 0 else "-INFINITY"
    return f"({constant.hex()})"


def _loops(plan: Plan, scalars: dict[int, int]) -> tuple[list[list[str]], int]:
    """The per-sample instructions, in loops that each can be vectorised; rows kept between them."""
    values, inputs = plan.graph.values, {i: k for k, i in enumerate(plan.inputs)}
    segments = _segments(plan)
    segment_of = {i: k for k, segment in enumerate(segments) for i in segment}
    crossing = {
        j
        for i in plan.steps
        for j in values[i].operands
        if j in segment_of and segment_of[j] != segment_of[i]
    }
    rows = {i: k for k, i in enumerate(sorted(crossing - set(plan.home)))}

    def operand(j: int, segment: int) -> str:
        if j in scalars:
            return f"c[{scalars[j]}]"
        if j in inputs:
            return f"in[{inputs[j]}][l]"
        if segment_of[j] == segment:
            return f"v{j}"
        return f"out[{plan.home[j]}][l]" if j in plan.home else f"kept[{rows[j]}][l]"

    loops = []
    for k, segment in enumerate(segments):
        lines = []
        for i in segment:
            operands = (operand(j, k) for j in values[i].operands)
            expression = BY_CODE[values[i].code].c.format(*operands)
            lines.append(f"    const double v{i} = {expression};")
            if i in plan.home:
                lines.append(f"    out[{plan.home[i]}][l] = v{i};")
            elif i in rows:
                lines.append(f"    kept[{rows[i]}][l] = v{i};")
        loops.append(lines)
    return loops, len(rows)


def _segments(plan: Plan) -> list[list[int]]:
    """The per-sample instructions in order, cut where a loop must end."""
    segments: list[list[int]] = [[]]
    for i in plan.steps:
        if BY_CODE[plan.graph.values[i].code].alone:
            segments += [[i], []]
            continue
        if len(segments[-1]) == _LONGEST:
            segments.append([])
        segments[-1].append(i)
    return [segment for segment in segments if segment]


#: Signals arrive as one pointer and one stride (in numbers) per column.
_SIGNATURE = (
    "(const double *p, const double *const *column, const ptrdiff_t *stride, ptrdiff_t n, "
    "const double *w, double *result)"
)

#: Reads a chunk; past the end the last sample is repeated, and its values are left out below.
_READ = """\
    const int length = n - first < B ? (int)(n - first) : B;
    for (int k = 0; k < inputs_{name}; ++k) {{
      const double *from = column[input_{name}[k]];
      const ptrdiff_t step = stride[input_{name}[k]];
      if (length == B && step == 1)
        for (int l = 0; l < B; ++l) in[k][l] = from[first + l];
      else
        for (int l = 0; l < B; ++l)
          in[k][l] = from[(first + (l < length ? l : length - 1)) * step];
    }}
    block_{name}(c, in, v);
"""

_BUFFERS = """\
  double c[SCALARS_{name}];
  double in[INPUTS_{name}][B] __attribute__((aligned(64)));
  double v[WANTED_{name}][B] __attribute__((aligned(64)));
  scalars_{name}(p, c);
"""


def _normal(sizes: list[int]) -> str:
    """Sums of products, component by component, upper triangle row by row."""
    count = sum(q * (q + 1) // 2 for q in sizes)
    tiles, lanes, first = [], 0, 0
    order: list[int] = []
    for q in sizes:
        where: dict[tuple[int, int], int] = {}
        for i in range(0, q, _TILE):
            for j in range(i, q, _TILE):
                rows, columns = min(_TILE, q - i), min(_TILE, q - j)
                tiles.append((first, i, first + j, rows, columns, lanes))
                for a in range(rows):
                    for b in range(columns):
                        where[i + a, j + b] = lanes + a * columns + b
                lanes += rows * columns
        for i in range(q):
            for j in range(i, q):
                order.append(where[i, j])
        first += q
    shapes = sorted({(rows, columns) for *_, rows, columns, _ in tiles})
    lines = [f"TILE({rows}, {columns})" for rows, columns in shapes]
    lines += [f"void casest_normal{_SIGNATURE} {{", _BUFFERS.format(name="all")]
    widest = max(sizes)
    lines.append(f"  double weighted[{widest}][B] __attribute__((aligned(64)));")
    lines.append(f"  static const int order[] = {{{', '.join(map(str, order))}}};")
    lines.append("  int chunks = 0;")
    lines.append(f"  for (int k = 0; k < {count}; ++k) result[k] = 0;")
    lines.append(f"  lanes sum[{lanes}];")
    lines.append(f"  for (int k = 0; k < {lanes}; ++k) sum[k] = (lanes){{0}};")
    lines.append("  for (ptrdiff_t first = 0; first < n; first += B) {")
    lines.append(_READ.format(name="all"))
    lines.append("    if (length < B)")
    lines.append("      for (int k = 0; k < WANTED_all; ++k)")
    lines.append("        for (int l = length; l < B; ++l) v[k][l] = 0;")
    start = 0
    for m, q in enumerate(sizes):
        lines.append("    {")
        lines.append(f"      const double (*x)[B] = (const double (*)[B])(v + {start});")
        lines.append("      if (w) {")
        lines.append("        double weight[B];")
        lines.append("        for (int l = 0; l < B; ++l)")
        lines.append(f"          weight[l] = l < length ? w[(first + l) * {len(sizes)} + {m}] : 0;")
        lines.append(f"        for (int k = 0; k < {q}; ++k)")
        lines.append("          for (int l = 0; l < B; ++l)")
        lines.append(f"            weighted[k][l] = v[{start} + k][l] * weight[l];")
        lines.append("        x = (const double (*)[B])weighted;")
        lines.append("      }")
        for begin, i, j, rows, columns, at in tiles:
            if begin == start:
                lines.append(
                    f"      tile_{rows}_{columns}(x + {i}, "
                    f"(const double (*)[B])(v + {j}), sum + {at});"
                )
        lines.append("    }")
        start += q
    lines += [
        f"    if (++chunks % {_FLUSH} == 0 || first + B >= n) {{",
        f"      for (int k = 0; k < {count}; ++k) result[k] += total(sum[order[k]]);",
        f"      for (int k = 0; k < {lanes}; ++k) sum[k] = (lanes){{0}};",
        "    }",
        "  }",
        "}",
        f"const int casest_normal_count = {count};",
    ]
    return "\n".join(lines)


def _cost(count: int) -> str:
    return "\n".join(
        [
            f"void casest_cost{_SIGNATURE} {{",
            _BUFFERS.format(name="residual"),
            "  double sum[LANES] = {0};",
            "  int chunks = 0;",
            "  *result = 0;",
            "  for (ptrdiff_t first = 0; first < n; first += B) {",
            _READ.format(name="residual"),
            f"    for (int k = 0; k < {count}; ++k) {{",
            "      if (length < B)",
            "        for (int l = length; l < B; ++l) v[k][l] = 0;",
            "      if (w)",
            "        for (int l = 0; l < length; ++l)",
            f"          sum[l % LANES] += w[(first + l) * {count} + k] * v[k][l] * v[k][l];",
            "      else",
            "        for (int l = 0; l < B; l += LANES)",
            "          for (int a = 0; a < LANES; ++a) sum[a] += v[k][l + a] * v[k][l + a];",
            "    }",
            f"    if (++chunks % {_FLUSH} == 0 || first + B >= n) {{",
            "      double part = 0;",
            "      for (int a = 0; a < LANES; ++a) { part += sum[a]; sum[a] = 0; }",
            "      *result += part;",
            "    }",
            "  }",
            "}",
        ]
    )


def _sum(count: int) -> str:
    return "\n".join(
        [
            f"const int casest_normal_count = {count};",
            f"void casest_sum{_SIGNATURE} {{",
            _BUFFERS.format(name="all"),
            "  (void)w;",
            f"  lanes sum[{max(count, 1)}];",
            f"  for (int k = 0; k < {count}; ++k) sum[k] = (lanes){{0}};",
            "  for (ptrdiff_t first = 0; first < n; first += B) {",
            _READ.format(name="all"),
            f"    for (int k = 0; k < {count}; ++k) {{",
            "      for (int l = length; l < B; ++l) v[k][l] = 0;",
            "      for (int l = 0; l < B; l += LANES) sum[k] += *(const lanes *)(v[k] + l);",
            "    }",
            "  }",
            f"  for (int k = 0; k < {count}; ++k) result[k] = total(sum[k]);",
            "}",
        ]
    )


def _values(name: str, count: int) -> str:
    """Every entry of every sample: result[entry][sample]."""
    return "\n".join(
        [
            f"void casest_values_{name}{_SIGNATURE} {{",
            _BUFFERS.format(name=name),
            "  (void)w;",
            "  for (ptrdiff_t first = 0; first < n; first += B) {",
            _READ.format(name=name),
            f"    for (int k = 0; k < {count}; ++k)",
            "      for (int l = 0; l < length; ++l) result[k * n + first + l] = v[k][l];",
            "  }",
            "}",
        ]
    )
