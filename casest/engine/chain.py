"""x(k+1) = M(k)x(k) + b(k) for matrices of any size: what a filter does to what it lacks."""

from __future__ import annotations

import numpy as np

from casest.engine.compiled import Compiled
from casest.engine.operations import Floats

_SOURCE = """
void casest_chain(const double *M, const double *b, double *x, long count, long n, long p) {
  for (long k = 0; k < count; ++k, M += n * n, b += n * p, x += n * p)
    for (long i = 0; i < n; ++i) {
      double *restrict to = x + (n + i) * p;
      for (long j = 0; j < p; ++j) to[j] = b[i * p + j];
      for (long l = 0; l < n; ++l)
        for (long j = 0; j < p; ++j) to[j] += M[i * n + l] * x[l * p + j];
    }
}
"""


_CHAIN = Compiled("casest_chain", _SOURCE)


def chained(M: Floats, b: Floats, first: Floats) -> Floats:
    """All x, (K + 1, n, p), from x(0) = first (n, p); M (K, n, n) and b (K, n, p)."""
    if not _CHAIN.ready(len(b)):
        return _in_stretches(M, b, first)
    M, b = (np.ascontiguousarray(part, float) for part in (M, b))
    count, n, p = b.shape
    found = np.empty((count + 1, n, p))
    found[0] = first
    _CHAIN([M, b, found], [count, n, p])
    return found


def _in_stretches(M: Floats, b: Floats, first: Floats) -> Floats:
    """The same by NumPy: about √K stretches of √K steps go side by side, first what each does to
    any beginning, then, the beginnings known, every step."""
    count, n, p = b.shape
    length = max(1, int(np.sqrt(count)))
    stretches = -(-count // length)
    spare = stretches * length - count

    def cut(parts: Floats) -> Floats:
        padded = np.concatenate([parts, np.zeros((spare, *parts.shape[1:]))])
        return padded.reshape(stretches, length, *parts.shape[1:])

    M, b = cut(M), cut(b)
    whole, ends = np.broadcast_to(np.eye(n), (stretches, n, n)), np.zeros((stretches, n, p))
    for k in range(length):
        whole, ends = M[:, k] @ whole, M[:, k] @ ends + b[:, k]
    before = np.empty((stretches, n, p))
    before[0] = first
    for j in range(1, stretches):
        before[j] = whole[j - 1] @ before[j - 1] + ends[j - 1]
    found = np.empty((stretches, length, n, p))
    for k in range(length):
        found[:, k] = before = M[:, k] @ before + b[:, k]
    return np.concatenate([first[None], found.reshape(-1, n, p)[:count]])
