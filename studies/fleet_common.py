"""What a fleet has in common: how often it is named where it is there, and where it is not.

Run `python studies/fleet_common.py` (some eight minutes). Fleets of triads of 24 poses, each sensor
with gains, skew and offset of its own, with a cubic of different sizes common to all, with one of
its own in each, or with none; every effect that poses can show is asked. Writes
studies/fleet_common.md.
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
from casest.fleet.spread import excess, in_errors  # noqa: E402
from casest.results.find import find_model  # noqa: E402

MODEL = find_model("norm-triangular").having(norm=fleets.GRAVITY)
LOWER = np.tril_indices(3)
#: Fleets without an effect, and sensors in each.
EMPTY, FEW = 200, 1000
#: Size of the cubic at 1 g, m/s², sensors in a fleet, and fleets of each kind.
SIZES, SENSORS, EACH = (0.0005, 0.001, 0.002, 0.0035), 10_000, 5
#: Root mean square of the cubic at 1 g where each sensor has its own, m/s².
SPREADS = (0.005, 0.01, 0.015, 0.02)


def asked(v):
    """Chance of each effect in common, the cubic's error in one sensor, each effect's spread."""
    found = calibrate_many(MODEL, {"v": v})
    x = np.concatenate([found.values["scale"][:, *LOWER], found.values["offset"]], axis=1)
    every = trials(MODEL, CATALOGUE)
    for trial in every:
        added(trial, x, [v], np.arange(len(v)) % 2, {})
    chances = {t.effect.name: t.whole.chance()[1] for t in every if seen(t)}
    cubic = next(t for t in every if t.effect.name == "cubic")
    _, covariance = cubic.whole.size
    own = {t.effect.name: excess(t, x, [v]) for t in every if seen(t)}
    own = {name: e for name, e in own.items() if e.told > len(v) / 2}
    return chances, np.sqrt(np.diag(covariance) * len(v)).mean(), own


def named(chances):
    """The effect that is named, if any is."""
    name = min(chances, key=chances.get)
    return name if chances[name] * len(chances) <= CHANCE else ""


def main():
    """Both tables."""
    least, wrong, spread, taken = [], 0, [], 0
    for k in range(EMPTY):
        chances, _, own = asked(fleets.readings(FEW, 10_000 + k))
        least.append(min(chances.values()) * len(chances))
        wrong += bool(named(chances))
        alone = {name: e.chance()[1] for name, e in own.items()}
        spread.append(min(alone.values()) * len(alone))
        taken += bool(named(alone))
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
            chances, std, _ = asked(v + size * (v / fleets.GRAVITY) ** 3)
            said.append(named(chances))
            own.append(size / fleets.GRAVITY**3 / std)
        cubic, signed = said.count("cubic"), said.count("signed_quadratic")
        any_ = EACH - said.count("")
        lines.append(
            f"| {size} | {np.mean(own):.3f} | {any_} of {EACH} | {cubic} | {signed} | "
            f"{any_ - cubic - signed} |"
        )
    lines += [
        "",
        f"The same asked for a spread: {taken} of the {EMPTY} fleets without an effect are told of "
        "one, the least chance times the number of effects is below 0.05 in "
        f"{100 * np.mean(np.array(spread) < 0.05):.1f} %, least {min(spread):.2g}.",
        "",
        f"{EACH} fleets of {SENSORS} triads with a cubic of its own in each, around nothing:",
        "",
        "| rms at 1 g, m/s² | in one sensor's standard deviations | named | cubic, or as well | "
        "rms found, median |",
        "| --- | --- | --- | --- | --- |",
    ]
    for size in SPREADS:
        said, alike, found = [], 0, []
        for k in range(EACH):
            v = fleets.readings(SENSORS, 30_000 + k)
            own = size * np.random.default_rng(k).standard_normal((SENSORS, 1, 3))
            _, std, told = asked(v + own * (v / fleets.GRAVITY) ** 3)
            name = named({n: e.chance()[1] for n, e in told.items()})
            said.append(name)
            alike += bool(name) and in_errors(told[name].over - told["cubic"].over) < 2
            found.append(np.median(told["cubic"].size[0]) * fleets.GRAVITY**3)
        lines.append(
            f"| {size} | {size / fleets.GRAVITY**3 / std:.2f} | "
            f"{EACH - said.count('')} of {EACH} | {alike} | {np.median(found):.3g} |"
        )
    (ROOT / "studies" / "fleet_common.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
