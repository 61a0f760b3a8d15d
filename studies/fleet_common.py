"""What a fleet has in common: how often it is named where it is there, and where it is not.

Run `python studies/fleet_common.py` (about two minutes). Fleets of triads of 24 poses, each sensor
with gains, skew and offset of its own, with a cubic of different sizes common to all or with none;
every effect that poses can show is asked. Writes studies/fleet_common.md.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import fleets  # noqa: E402

from casest import calibrate_many  # noqa: E402
from casest.effects import CATALOGUE  # noqa: E402
from casest.fleet.common import CHANCE, added, seen, trials  # noqa: E402
from casest.results.find import find_model  # noqa: E402

MODEL = find_model("norm-triangular").having(norm=fleets.GRAVITY)
LOWER = np.tril_indices(3)
#: Fleets without an effect, and sensors in each.
EMPTY, FEW = 200, 1000
#: Size of the cubic at 1 g, m/s², sensors in a fleet, and fleets of each kind.
SIZES, SENSORS, EACH = (0.0005, 0.001, 0.002, 0.0035), 10_000, 5


def asked(v):
    """Chance of each effect, and the cubic's size in one sensor's standard deviations."""
    found = calibrate_many(MODEL, {"v": v})
    x = np.concatenate([found.values["scale"][:, *LOWER], found.values["offset"]], axis=1)
    every = trials(MODEL, CATALOGUE)
    for trial in every:
        added(trial, x, [v], np.arange(len(v)) % 2, {})
    chances = {t.effect.name: t.whole.chance()[1] for t in every if seen(t)}
    cubic = next(t for t in every if t.effect.name == "cubic")
    _, covariance = cubic.whole.size
    return chances, np.sqrt(np.diag(covariance) * len(v)).mean()


def named(chances):
    """The effect that is named, if any is."""
    name = min(chances, key=chances.get)
    return name if chances[name] * len(chances) <= CHANCE else ""


def main():
    """Both tables."""
    least, wrong = [], 0
    for k in range(EMPTY):
        chances, _ = asked(fleets.readings(FEW, 10_000 + k))
        least.append(min(chances.values()) * len(chances))
        wrong += bool(named(chances))
    lines = [
        "# What a fleet has in common",
        "",
        "`python studies/fleet_common.py`",
        "",
        f"{EMPTY} fleets of {FEW} triads without an effect: {wrong} are told of one. The least "
        f"chance of any effect in a fleet, times their number, is below 0.05 in "
        f"{100 * np.mean(np.array(least) < 0.05):.1f} %, least {min(least):.2g}.",
        "",
        f"{EACH} fleets of {SENSORS} triads with a cubic common to all:",
        "",
        "| cubic at 1 g, m/s² | in one sensor's standard deviations | named | cubic | "
        "signed_quadratic | other |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for size in SIZES:
        said, own = [], []
        for k in range(EACH):
            v = fleets.readings(SENSORS, 20_000 + k)
            chances, std = asked(v + size * (v / fleets.GRAVITY) ** 3)
            said.append(named(chances))
            own.append(size / fleets.GRAVITY**3 / std)
        cubic, signed = said.count("cubic"), said.count("signed_quadratic")
        any_ = EACH - said.count("")
        lines.append(
            f"| {size} | {np.mean(own):.3f} | {any_} of {EACH} | {cubic} | {signed} | "
            f"{any_ - cubic - signed} |"
        )
    (ROOT / "studies" / "fleet_common.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
