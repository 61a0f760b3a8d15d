"""Time of one step of an exported filter, compiled: nine states, six inputs, three readings.

Run `python benchmarks/filter_step.py`. The C of `casest export bias-gravity --to c --period 0.01`,
with every reading there and with each tenth; Estimator in Python beside it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casest.correction.filter_c import filter_source
from casest.dynamics import Estimator
from casest.dynamics.declare import Dynamics
from casest.dynamics.stepwise import stepwise
from casest_problems.bias_gravity import bias_gravity

PERIOD, STEPS = 0.01, 100_000
MAIN = r"""
#include <stdio.h>
#include <time.h>
int main(void) {
  filter_%(name)s f;
  real sample[W], x[N], P[N * N], sum = 0;
  filter_%(name)s_begin(&f);
  clock_t begin = clock();
  for (int k = 0; k < %(steps)d; ++k) {
    for (int i = 0; i < W; ++i) sample[i] = sin(0.001 * k * (i + 1));
    if (k %% %(every)d) for (int i = W - 3; i < W; ++i) sample[i] = NAN;
    if (filter_%(name)s_step(&f, sample, %(period)g * k, x, P)) return 1;
    sum += x[0];
  }
  printf("%%.3g\n", 1e6 * (clock() - begin) / CLOCKS_PER_SEC / %(steps)d);
  return sum == 0;
}
"""


def in_c(model: Dynamics, every: int, single: bool) -> float:
    """Microseconds of a step, compiled with -O2."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("there is no C compiler")
    name = model.name.replace("-", "_")
    said = {"name": name, "steps": STEPS, "every": every, "period": PERIOD}
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "step.c"
        source.write_text(filter_source(stepwise(model, PERIOD), single) + MAIN % said)
        program = str(source.with_suffix(""))
        subprocess.run([compiler, "-O2", str(source), "-o", program, "-lm"], check=True)
        done = subprocess.run([program], capture_output=True, text=True, check=True)
    return float(done.stdout)


def in_python(model: Dynamics, steps: int = 200) -> float:
    """Microseconds of a step of Estimator."""
    estimator = Estimator(model, PERIOD)
    sample = {s.name: np.zeros(s.size) for s in model.signals}
    estimator.step(sample, -PERIOD)
    begin = perf_counter()
    for k in range(steps):
        estimator.step(sample, PERIOD * k)
    return 1e6 * (perf_counter() - begin) / steps


def main() -> None:
    """Print a row for each."""
    print(f"{bias_gravity.name}, {bias_gravity.size} states: microseconds a step")
    for single, kind in ((False, "double"), (True, "float")):
        for every in (1, 10):
            spent = in_c(bias_gravity, every, single)
            print(f"  C, {kind}, a reading every {every:>2}{spent:10.2f}", flush=True)
    print(f"  Estimator in Python{in_python(bias_gravity):16.0f}")


if __name__ == "__main__":
    main()
