"""Several recursions side by side in the lanes of one processor: the same steps from other states,
or stretches of one record, where the states that they begin from are known.

A step's instructions wait for one another; those of other states need not. The C that CasADi writes
for a step is turned, line by line, into the same with a vector in the place of each number: the
digits are the same. What has lines of another kind is run one after the other.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casest.engine.kernel import library
from casest.engine.operations import Floats

#: Lanes at most; steps below which lanes are not worthwhile.
MOST, SHORTEST = 8, 64

_FLAGS = [["-O2", "-march=native", "-ffp-contract=off", "-fno-math-errno"]]

_HEAD = """
typedef double lanes __attribute__((vector_size(%(bytes)d)));
typedef long long whole __attribute__((vector_size(%(bytes)d)));
typedef double loose __attribute__((vector_size(%(bytes)d), aligned(8)));
#define ALL(x) ((x) - (lanes){})
static inline lanes most(lanes x, lanes y) {
  const whole first = (x > y) | (y != y);
  return (lanes)((first & (whole)x) | (~first & (whole)y));
}
static inline lanes roots(lanes x) {
  for (int l = 0; l < %(count)d; ++l) x[l] = __builtin_sqrt(x[l]);
  return x;
}
"""

#: The same numbers to all lanes; a state and what is given of it lie lane beside lane.
_BESIDE = """
#define GIVEN(p, i) ALL(given[p][i])
static void casest_step(const lanes *from, const double **given, %(arguments)s) {
%(body)s
}
void casest_lanes(const double *state, const double **part, const long *step, const long *late,
                  long n, double **out) {
  lanes first[%(size)d], second[%(size)d];
  const double *given[%(parts)d];
  for (long i = 0; i < %(size)d; ++i) first[i] = ((const loose *)state)[i];
  for (long k = 0; k < n; ++k) {
    for (long p = 0; p < %(parts)d; ++p) given[p] = part[p] + k * step[p];
    casest_step(k %% 2 ? second : first, given, k %% 2 ? first : second%(outputs)s);
  }
  for (long i = 0; i < %(size)d; ++i) ((loose *)out[0])[i] = (n %% 2 ? second : first)[i];
}
"""

#: Each lane along a stretch of its own, from place begin[l] of the record, where it also writes.
_APART = """
#define GIVEN(p, i) ((lanes){%(each)s})
static void casest_step(const lanes *from, const double *given[][%(count)d], %(arguments)s) {
%(body)s
}
void casest_lanes(const double *state, const double **part, const long *step, const long *begin,
                  long n, double **out) {
  lanes one[%(size)d], other[%(size)d], found[%(more)d];
  const double *given[%(parts)d][%(count)d];
  static const long size[] = {%(sizes)s}, place[] = {%(places)s};
  for (long i = 0; i < %(size)d; ++i) one[i] = ((const loose *)state)[i];
  for (long k = 0; k < n; ++k) {
    for (long p = 0; p < %(parts)d; ++p)
      for (long l = 0; l < %(count)d; ++l) given[p][l] = part[p] + (begin[l] + k) * step[p];
    lanes *to = k %% 2 ? one : other;
    casest_step(k %% 2 ? other : one, given, to%(outputs)s);
    for (long o = 0; o < %(several)d; ++o)
      for (long l = 0; l < %(count)d; ++l) {
        const lanes *from = o ? found + place[o] : to;
        double *row = out[o] + (begin[l] + k) * size[o];
        for (long i = 0; i < size[o]; ++i) row[i] = from[i][l];
      }
  }
}
"""

_NUMBER = r"(?:a\d+|\d+\.?\d*(?:e[-+]?\d+)?)"
#: Lines of a step in CasADi's C, and what they become.
_LINES = [
    (r"casadi_real (a[\d, a]*);", r"lanes \1;"),
    (r"(a\d+)=arg\[0\]\? arg\[0\]\[(\d+)\] : 0;", r"\1=from[\2];"),
    (r"(a\d+)=arg\[(\d+)\]\? arg\[\2\]\[(\d+)\] : 0;", r"\1=GIVEN(\2 - 1, \3);"),
    (r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=(a\d+);", r"to\1[\2]=\3;"),
    (rf"(a\d+)=(-?{_NUMBER});", r"\1=ALL(\2);"),
    (rf"(a\d+)=\(-({_NUMBER})\);", r"\1=-\2;"),
    (rf"(a\d+)=\(({_NUMBER}[-+*/]{_NUMBER})\);", r"\1=\2;"),
    (r"(a\d+)=\((a\d+(?:<|<=|==|!=)a\d+)\);", r"\1=(lanes)((\2) & (whole)ALL(1.));"),
    (r"(a\d+)=\((a\d+)\?(a\d+):0\);", r"\1=(lanes)((\2!=0) & (whole)\3);"),
    (r"(a\d+)=\(!(a\d+)\);", r"\1=(lanes)((\2==0) & (whole)ALL(1.));"),
    (r"(a\d+)=casadi_sq\((a\d+)\);", r"\1=\2*\2;"),
    (r"(a\d+)=sqrt\((a\d+)\);", r"\1=roots(\2);"),
    (r"(a\d+)=casadi_fmax\((a\d+),(a\d+)\);", r"\1=most(\2,\3);"),
]
_RULES = [(re.compile(f"^{pattern}$"), to) for pattern, to in _LINES]


def source(
    text: str, sizes: Sequence[int], parts: int, count: int, *, apart: bool = False
) -> str | None:
    """C of a step of CasADi's, `text`, in `count` lanes; None where a line is of no known kind.

    `sizes`: of its outputs, the state first; `parts`: in how many it is given its numbers, the
    same in all lanes, or (`apart`) of each lane's own stretch of the record.
    """
    step = re.search(r"static int casadi_f0\([^)]*\) \{\n(.*?)\n  return 0;\n\}", text, re.S)
    if step is None or "casadi_f1" in text:
        return None
    body = [_turned(line.strip()) for line in step[1].split("\n")]
    if any(line is None for line in body):
        return None
    several = range(1, len(sizes))
    kind = "lanes" if apart else "loose"
    arguments = ["lanes *to0", *(f"{kind} *to{i}" for i in several)]
    places = [sum(sizes[1:i]) for i in range(len(sizes))]
    found_at = [f", found + {places[i]}" for i in several]
    outputs = [f", (loose *)out[{i}] + k * {sizes[i]}" for i in several]
    return (_HEAD + (_APART if apart else _BESIDE)) % {
        "bytes": 8 * count,
        "count": count,
        "arguments": ", ".join(arguments),
        "body": "\n".join(map(str, body)),
        "size": sizes[0],
        "sizes": ", ".join(map(str, sizes)),
        "places": ", ".join(map(str, places)),
        "several": len(sizes),
        "more": max(sum(sizes[1:]), 1),
        "parts": max(parts, 1),
        "each": ", ".join(f"given[p][{lane}][i]" for lane in range(count)),
        "outputs": "".join(found_at if apart else outputs),
    }


def _turned(line: str) -> str | None:
    for pattern, to in _RULES:
        if pattern.match(line):
            return pattern.sub(to, line)
    return None if line else ""


def built(text: str | None, *, build: bool) -> ctypes.CDLL | None:
    """Compiled, or from the cache folder; None where neither can be."""
    return None if text is None else library(text, _FLAGS, build=build)


def wide_enough(count: int) -> int:
    """Lanes for so many states: a power of two, up to eight."""
    return min(MOST, 1 << max(count - 1, 1).bit_length())


def interleaved(states: Floats, count: int) -> Floats:
    """States (L, S) as (S, count): spare lanes run along with the last one."""
    rows = np.minimum(np.arange(count), len(states) - 1)
    return np.ascontiguousarray(states[rows].T, float)


def stretches(count: int) -> NDArray[np.intp]:
    """Where lanes begin that go along `count` steps together, all of one length; the last ones
    overlap. One where that is too short to be worthwhile."""
    if count < SHORTEST:
        return np.zeros(1, int)
    length = -(-count // MOST)
    return np.minimum(np.arange(MOST) * length, count - length)
