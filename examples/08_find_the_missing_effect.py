"""What does the model lack? A wheel out of balance, which nobody declared."""

import numpy as np

from casest import close, load_runs
from casest.demo import WHEEL
from casest_problems.wheel import wheel

found = close(wheel, load_runs([WHEEL], wheel.signals), say=print)

for added in found.effects:
    print(f"added: {added.candidate.label}, p = {added.p_value:.1g}")
    for name in added.names:
        print(f"  {name} = {found.after.values[name]:.3g} ± {found.after.std[name]:.2g}")
truth = np.array([0.35, -0.20, 0.15])
for name, estimate in (("before", found.before), ("after", found.after)):
    error = estimate.values["offset"] - truth
    print(f"{name}: the offset is wrong by {np.abs(error).max():.3f} m/s^2")

assert [added.candidate.effect.name for added in found.effects] == ["imbalance"]
assert np.abs(found.before.values["offset"] - truth).max() > 0.7
assert np.all(np.abs(found.after.values["offset"] - truth) < 4 * found.after.std["offset"])
