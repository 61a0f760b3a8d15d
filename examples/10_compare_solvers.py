"""Which solver can be believed from how far away? A thermocouple that settles, from far starts."""

import numpy as np

import casest as c
from casest.comparison.judge import compare


@c.model
def settling(
    t=c.signal("s"),
    reading=c.signal("mV"),
    *,
    end=c.param("mV", start=1.0),
    change=c.param("mV", start=-1.0),
    constant=c.param("s", start=1.0),
):
    """Exponential approach to a new temperature."""
    predicted = c.quantity("predicted", end + change * c.exp(-t / constant), "mV")
    return c.Residual(measured=reading, predicted=predicted)


t = np.arange(0, 30, 0.25)
reading = 4.1 - 3.2 * 0.5 ** (t / 3.0) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
signals = {"t": t[:, None], "reading": reading[:, None]}
run = c.Run.raw("step", signals, units={"t": "s", "reading": "mV"}, time=t)

found = compare(settling, [run], starts=6, sizes=(0.5, 2.0))
print("certified:", found.certified, found.estimate.values["constant"])
for row in found.rows:
    print(f"{row.solver:<14} right {row.right} of {len(row.spread)}, false successes", end=" ")
    print(f"{row.false_successes}, {1e3 * row.seconds:.1f} ms")
assert abs(found.estimate.values["constant"] - 3 / np.log(2)) < 4 * found.estimate.std["constant"]
assert {row.solver for row in found.rows} >= {"ipopt", "trust-region", "scipy-lm"}
