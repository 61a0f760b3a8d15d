"""Several recursions side by side in the lanes of one processor: the same steps from other states.

A step's instructions wait for one another; those of other states need not. The C that CasADi writes
for a step is turned, line by line, into the same with a vector in the place of each number: the
digits are the same. What has lines of another kind is run one after the other.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence

import numpy as np

from casest.engine.kernel import library
from casest.engine.operations import Floats

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
static void casest_step(const lanes *from, const double *given, %(arguments)s) {
%(body)s
}
void casest_lanes(const double *state, const double **part, const long *own, const long *step,
                  const long *late, long parts, long n, double **out) {
  lanes first[%(size)d], second[%(size)d];
  double given[%(wide)d];
  for (long i = 0; i < %(size)d; ++i) first[i] = ((const loose *)state)[i];
  for (long k = 0; k < n; ++k) {
    double *to = given;
    for (long p = 0; p < parts; ++p) {
      const double *at = part[p] + (k - late[p]) * step[p];
      for (long i = 0; i < own[p]; ++i) *to++ = k < late[p] ? 0.0 : at[i];
    }
    casest_step(k %% 2 ? second : first, given, k %% 2 ? first : second%(outputs)s);
  }
  for (long i = 0; i < %(size)d; ++i) ((loose *)out[0])[i] = (n %% 2 ? second : first)[i];
}
"""

_NUMBER = r"(?:a\d+|\d+\.?\d*(?:e[-+]?\d+)?)"
#: Lines of a step in CasADi's C, and what they become.
_LINES = [
    (r"casadi_real (a[\d, a]*);", r"lanes \1;"),
    (r"(a\d+)=arg\[0\]\? arg\[0\]\[(\d+)\] : 0;", r"\1=from[\2];"),
    (r"(a\d+)=arg\[1\]\? arg\[1\]\[(\d+)\] : 0;", r"\1=ALL(given[\2]);"),
    (r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=(a\d+);", r"to\1[\2]=\3;"),
    (rf"(a\d+)=(-?{_NUMBER});", r"\1=ALL(\2);"),
    (rf"(a\d+)=\(-({_NUMBER})\);", r"\1=-\2;"),
    (rf"(a\d+)=\(({_NUMBER}[-+*/]{_NUMBER})\);", r"\1=\2;"),
    (r"(a\d+)=\((a\d+(?:<|<=|==|!=)a\d+)\);", r"\1=(lanes)((\2) & (whole)ALL(1.));"),
    (r"(a\d+)=\((a\d+)\?(a\d+):0\);", r"\1=(lanes)((\2!=0) & (whole)\3);"),
    (r"(a\d+)=\(!(a\d+)\);", r"\1=(lanes)((\2==0) & (whole)ALL(1.));"),
    (r"(a\d+)=casadi_sq\((a\d+)\);", r"\1=\2*\2;"),
    (r"(a\d+)=casadi_fmax\((a\d+),(a\d+)\);", r"\1=most(\2,\3);"),
]
_RULES = [(re.compile(f"^{pattern}$"), to) for pattern, to in _LINES]


def source(text: str, sizes: Sequence[int], wide: int, count: int) -> str | None:
    """C of a step of CasADi's, `text`, in `count` lanes; None where a line is of no known kind.

    `sizes`: of its outputs, the state first; `wide`: how many numbers a step is given.
    """
    found = re.search(r"static int casadi_f0\([^)]*\) \{\n(.*?)\n  return 0;\n\}", text, re.S)
    if found is None or "casadi_f1" in text:
        return None
    body = [_turned(line.strip()) for line in found[1].split("\n")]
    if any(line is None for line in body):
        return None
    several = range(1, len(sizes))
    arguments = ["lanes *to0", *(f"loose *to{i}" for i in several)]
    outputs = [f", (loose *)out[{i}] + k * {sizes[i]}" for i in several]
    return _HEAD % {
        "bytes": 8 * count,
        "arguments": ", ".join(arguments),
        "body": "\n".join(map(str, body)),
        "size": sizes[0],
        "wide": max(wide, 1),
        "outputs": "".join(outputs),
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
    return min(8, 1 << max(count - 1, 1).bit_length())


def interleaved(states: Floats, count: int) -> Floats:
    """States (L, S) as (S, count): spare lanes run along with the last one."""
    rows = np.minimum(np.arange(count), len(states) - 1)
    return np.ascontiguousarray(states[rows].T, float)
