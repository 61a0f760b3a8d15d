"""A gyroscope at rest: its declared bias is constant, and the record says what it follows."""

from dataclasses import replace

import numpy as np

import casest as c


@c.model
def constant_bias(v=c.signal(3, "rad/s"), *, bias=c.param(3, "rad/s")):
    """A gyroscope at rest reads its bias."""
    reading = c.quantity("reading", bias, "rad/s")
    return c.Residual(measured=v, predicted=reading)


# Bursts of 5 s at 50 Hz, one every 305 s, while the surroundings cool and warm up again.
rng = np.random.default_rng(3)
t = (305.0 * np.arange(25)[:, None] + np.arange(0, 5, 0.02)).ravel()
temperature = 20 - 4 * np.sin(2 * np.pi * t / 5000) + 0.05 * rng.standard_normal(len(t))
v = np.array([-0.065, 0.057, 0.029]) + np.outer(temperature - 20, [4e-4, -2e-4, 1e-4])
v += 1e-3 * rng.standard_normal(v.shape)
run = c.Run.raw("cooling", {"v": v}, units={"v": "rad/s"}, time=t)
burst = np.repeat(np.arange(25), 250)
run = replace(run, columns={"temp": temperature}, block=burst)

found = c.close(constant_bias, [run])
for effect in found.effects:
    print(effect.candidate.label, *(found.after.values[name] for name in effect.names))
assert [e.candidate.label for e in found.effects] == ["temperature_bias(temp)"]
slope = found.after.values["temperature_bias(temp).k"]
assert np.allclose(slope, [4e-4, -2e-4, 1e-4], atol=3e-5)
