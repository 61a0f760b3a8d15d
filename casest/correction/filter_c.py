"""C99 source of a filter's step: states and covariance in fixed memory, sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from casest import __version__
from casest.correction.c import function, number
from casest.correction.program import steps_of
from casest.dynamics.stepwise import PARTS, Stepwise
from casest.errors import UsageError
from casest.escaping import c_comment, c_identifier

_BEGIN = """
void {name}_begin({name} *f) {{
  for (int i = 0; i < S; ++i) f->state[i] = {begin}[i];
  f->begun = 0;
}}
"""
_MOVED = """
/* The state after a step of h seconds, in as many parts as its motion asks for. */
static void moved(const {name} *f, const real *sample, real h{arguments}) {{
  real in[S + 2 * W + 3 + 4 * N];
  const int lost = h > GAP;
  int parts = 1;
{start}
  in[S + 2 * W] = h;
{cut}
{along}
  for (int k = 0; k < parts; ++k) {{
    for (int i = 0; i < S; ++i) in[i] = state[i];
    for (int i = 0; i < N; ++i) {{
      in[S + 2 * W + 1 + i] = lost && k == 0 ? forgotten[i] : 0;
      in[S + 2 * W + 1 + N + i] = lost && k == parts - 1 ? forgotten[i] : 0;
    }}
    in[S + 2 * W + 1 + 2 * N] = (real)k / parts;
    in[S + 2 * W + 2 + 2 * N] = (real)(k + 1) / parts;
    move(in, state);
  }}
}}
"""
_START = """\
  for (int i = 0; i < W; ++i) in[S + i] = f->last[i];
  for (int i = 0; i < W; ++i) in[S + W + i] = sample[i];"""
_CUT = """\
  real speed;
  fast(in + S, &speed);
  if (speed > SLOW) parts = speed / SLOW < MOST ? (int)ceil(speed / SLOW) : MOST;"""
_ALONG = """\
  for (int i = 0; i < N; ++i) in[S + 2 * W + 3 + 2 * N + i] = along[i];
  for (int i = 0; i < N; ++i) in[S + 2 * W + 3 + 3 * N + i] = later[i];"""
_READ = """
static void taken(const real *sample, real *state) {{
  static const int place[] = {{{places}}};
  real in[S + W + 2 * M];
  for (int i = 0; i < S; ++i) in[i] = state[i];
  for (int i = 0; i < W; ++i) in[S + i] = sample[i];
  for (int i = 0; i < M; ++i) {{
    const real y = sample[place[i]];
    in[S + W + i] = isfinite(y) ? y : 0;
    in[S + W + M + i] = isfinite(y) ? 1 : 0;
  }}
  read(in, state);
}}
"""
_STEP = """
int {name}_step({name} *f, const real *sample, double t, real *x, real *P) {{
  static const unsigned char needed[] = {{{needed}}};
  real state[S], told_[N + N * N];
{declared}  const real h = f->begun ? (real)(t - f->time) : 0;
  if (!isfinite(t) || (f->begun && !(h > 0))) return 1;
  for (int i = 0; i < W; ++i)
    if (needed[i] && !isfinite(sample[i])) return 2;
  for (int i = 0; i < S; ++i) state[i] = f->state[i];
{first}  if (f->begun) moved(f, sample, h{given}, state);
  taken(sample, state);
  told(state, told_);
  for (int i = 0; i < N + N * N; ++i)
    if (!isfinite(told_[i])) return 3;
  for (int i = 0; i < N; ++i) x[i] = told_[i];
  for (int i = 0; i < N * N; ++i) P[i] = told_[N + i];
  for (int i = 0; i < S; ++i) f->state[i] = state[i];
{kept}  for (int i = 0; i < W; ++i) f->last[i] = sample[i];
  f->time = t;
  f->begun = 1;
  return 0;
}}
"""
_FIRST = """\
  for (int i = 0; i < S; ++i) lead[i] = f->begun ? f->lead[i] : begin[i];
  if (f->begun) moved(f, sample, h, begin, begin, lead);
  taken(sample, lead);
"""


def filter_source(step: Stepwise, single: bool = False) -> str:
    """The source file; `single` computes with `float` instead of `double`.

    Raises UsageError where the model knows something exactly.
    """
    if step.model.traced.g.numel():
        raise UsageError(
            f"{step.model.name}: what it knows exactly (constraint) is found by rounds that are "
            "not exported: export the model without it; Estimator in Python puts it in"
        )
    name = f"filter_{c_identifier(step.model.name)}"
    parts = [*_head(step, name, single), _values("begin", step.begin)]
    parts.append(_values("forgotten", step.forgotten))
    functions = {"move": step.move, "read": step.read, "told": step.told, "fast": step.fast}
    for called, own in functions.items():
        if own is not None:
            parts += function(called, *steps_of(own, "the filter"))
    parts.append(_BEGIN.format(name=name, begin="begin"))
    arguments = ", const real *along, const real *later" if step.leads else ""
    parts.append(
        _MOVED.format(
            name=name,
            arguments=f"{arguments}, real *state",
            start=_START,
            cut="" if step.fast is None else _CUT,
            along=_ALONG if step.leads else "",
        )
    )
    parts.append(_READ.format(places=", ".join(map(str, step.readings))))
    parts.append(
        _STEP.format(
            name=name,
            needed=", ".join(str(int(one)) for one in step.needed),
            declared="  real lead[S];\n" if step.leads else "",
            first=_FIRST if step.leads else "",
            given=", f->lead, lead" if step.leads else "",
            kept="  for (int i = 0; i < S; ++i) f->lead[i] = lead[i];\n" if step.leads else "",
        )
    )
    return "\n".join(parts)


def _values(name: str, values: Any) -> str:
    return f"static const real {name}[] = {{{', '.join(map(number, values))}}};"


def _head(step: Stepwise, name: str, single: bool) -> Iterator[str]:
    """What a reader must know to call it."""
    model, n = step.model, step.model.size
    said = [
        f"The filter of {model.name}, step by step, exported by casest {__version__}.",
        "",
        f"{name}_begin once; then {name}_step with each sample and its time t in s,",
        f"every {step.period:g} s as a rule; a step of more than {step.gap:g} s is a gap.",
        "sample:",
        *_places("sample", [(s.name, s.size, s.unit or "1") for s in model.signals]),
        f"  NAN where a reading ({', '.join(model.may_be_missing) or 'none'}) is missing.",
        "x: states,",
        *_places("x", [(s.name, s.size, s.unit) for s in model.states]),
        f"P: their covariance, {n} x {n}.",
        "Returns 0; 1 where time does not go on, 2 where a number is missing that may not be,",
        "3 where the states would not be finite: then nothing has changed.",
    ]
    yield from (f"{' *' if k else '/*'} {c_comment(line)}".rstrip() for k, line in enumerate(said))
    yield " */"
    yield "#include <math.h>\n#include <tgmath.h>\n"
    yield f"typedef {'float' if single else 'double'} real;"
    width, size = sum(s.size for s in model.signals), len(step.begin)
    sizes = {"S": size, "W": width, "N": n, "M": len(step.readings)}
    yield f"enum {{ {', '.join(f'{k} = {v}' for k, v in sizes.items())} }};"
    yield f"#define GAP {number(step.gap)}"
    if step.fast is not None:
        yield f"#define SLOW {number(step.slow)}\n#define MOST {PARTS}"
    lead = " real lead[S];" if step.leads else ""
    yield f"typedef struct {{ real state[S];{lead} real last[W]; double time; int begun; }} {name};"
    yield f"void {name}_begin({name} *f);"
    yield f"int {name}_step({name} *f, const real *sample, double t, real *x, real *P);\n"


def _places(array: str, parts: Sequence[tuple[str, int, str]]) -> Iterator[str]:
    place = 0
    for name, size, unit in parts:
        last = f"..{array}[{place + size - 1}]" if size > 1 else ""
        yield f"  {array}[{place}]{last}  {name} [{unit}]"
        place += size
