"""Does the loop in motion find what is missing, and nothing else? Simulated flights of 60 s.

    make study-flights                        # 200 of each kind: a day on one core
    python studies/flight_loop.py --only null # worlds whose names match this pattern
    python studies/flight_loop.py --table     # of what is there so far

Flights and sensors come from `tests/flights.py`, closed forms that share no code with the filter or
the catalogue. Each world is kept in `out/flight_loop.jsonl`, so that an interrupted study goes on
where it stopped; the table is written to `studies/flight_loop.md`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import flights  # noqa: E402
from flights import Sensors  # noqa: E402
from scipy.stats import beta  # noqa: E402

from casest.diagnose.levels import LEVELS  # noqa: E402
from casest.diagnose.motion.loop import close_motion  # noqa: E402
from casest.results.motion import rms_settled  # noqa: E402
from casest_problems.bias_gravity import bias_gravity  # noqa: E402

KEPT, TABLE = ROOT / "out" / "flight_loop.jsonl", ROOT / "studies" / "flight_loop.md"
#: Flights of each kind, in turns of so many of all kinds; the first seed.
COUNT, TURN, FIRST = 200, 5, 420_000

#: World -> its sensors at full size, the label that should be found, the size in words.
WORLDS: dict[str, tuple[Sensors, str, str]] = {
    "gyro bias": (Sensors(gyro_bias=(0.002, -0.001, 0.0015)), "bias of omega", "0.15 °/s"),
    "velocity delay": (Sensors(delay=0.02), "time_delay of v", "20 ms"),
    "long velocity delay": (Sensors(delay=0.2), "time_delay of v", "200 ms"),
    "lever arm": (Sensors(lever=(0.1, -0.05, 0.07)), "lever_arm of v", "0.13 m"),
    "accelerometer scale": (Sensors(gain=0.01), "gain of a", "1 %"),
    "coloured noise": (
        Sensors(colour=0.5, coloured=0.01),
        "coloured_noise of v",
        "0.01 m/s over 0.5 s",
    ),
}
SHARES = (5.0, 1.0, 0.2)
#: Nothing missing, but noise of another kind.
KINDS = {
    "null, Student's t noise (4)": Sensors(tails=True),
    "null, readings in steps of one σ": Sensors(quantised=True),
    "null, bias that wanders (1e-5 m²/s⁵)": Sensors(wander=1e-5),
}
#: A gyro so noisy, rad/s (ten times Batista's): its rates are an input of the model.
NOISY = {**flights.SIGMA, "omega": np.radians(0.5)}
#: What is planted beside it.
BESIDE = ("gyro bias", "velocity delay", "lever arm", "accelerometer scale", "knock", "motor")
#: Two at once.
PAIR = Sensors(gyro_bias=(0.002, -0.001, 0.0015), lever=(0.1, -0.05, 0.07))


def smaller(sensors: Sensors, share: float) -> Sensors:
    return Sensors(
        gyro_bias=tuple(share * x for x in sensors.gyro_bias),
        lever=tuple(share * x for x in sensors.lever),
        gain=share * sensors.gain,
        delay=share * sensors.delay,
        colour=sensors.colour,
        coloured=share * sensors.coloured,
    )


#: Name, seed, sensors, rate (Hz).
Task = tuple[str, int, Sensors, float]


def tasks() -> Iterator[Task]:
    """Flights of nothing missing first; then some of every kind, some more, …"""
    for seed in range(FIRST, FIRST + COUNT):
        yield "null", seed, Sensors(), 50.0 if seed % 2 else 25.0
    for first in range(FIRST, FIRST + COUNT, TURN):
        seeds = range(first, first + TURN)
        for share in (1.0, None, 5.0, 0.2):
            for seed in seeds:
                yield from _others(seed) if share is None else _planted_ones(seed, share)


def _planted_ones(seed: int, share: float) -> Iterator[Task]:
    for name, (sensors, _, _) in WORLDS.items():
        yield f"{name} x{share:g}", seed, smaller(sensors, share), 50.0
    for name in flights.CHANGES:
        yield f"{name} x{share:g}", seed, Sensors(), 50.0


def _others(seed: int) -> Iterator[Task]:
    """Two at once, noise of other kinds, a noisy gyro."""
    yield "gyro bias and lever arm", seed, PAIR, 50.0
    for name, sensors in KINDS.items():
        yield name, seed, sensors, 50.0
    yield "noisy gyro", seed, Sensors(), 50.0
    for name in BESIDE:
        yield f"{name}, noisy gyro", seed, WORLDS.get(name, (Sensors(),))[0], 50.0


def world(name: str, seed: int, sensors: Sensors, rate: float) -> dict[str, Any]:
    """One flight, closed. Nulls have noises of their own: up to three times Batista's."""
    rng = np.random.default_rng(seed)
    flight = flights.somewhere(rng)
    worse = rng.uniform(1, 3, 3) if name == "null" else np.ones(3)
    base = NOISY if name.endswith("noisy gyro") else flights.SIGMA
    sigma = {k: s * w for (k, s), w in zip(base.items(), worse, strict=True)}
    t = np.arange(0, 60, 1 / rate)
    run = flights.record(flight, t, rng, sensors, sigma)
    kind, share = kind_of(name)
    if kind in flights.CHANGES:
        run = flights.CHANGES[kind][0](run, flight, t, share)
    begin = process_time()
    found = close_motion(bias_gravity, run)
    before, after = rms_settled(found)
    return {
        "name": name,
        "seed": seed,
        "seconds": process_time() - begin,
        "found": [a.candidate.label for a in found.effects],
        "alike": [list(a.indistinguishable_from) for a in found.effects],
        "unexplained": found.left.p_value < LEVELS.coloured,
        "numbers": {c.label: v.tolist() for c, v in found.after.added},
        "stds": found.after.std.tolist(),
        "undecided": list(found.undecided),
        "verdict": found.verdict,
        "before": before,
        "after": after,
        "gain": found.after.likelihood - found.before.likelihood,
    }


def kind_of(name: str) -> tuple[str, float]:
    """What is planted, and how many times its size."""
    kind, _, share = name.removesuffix(", noisy gyro").partition(" x")
    return kind, float(share or 1)


# -- table -------------------------------------------------------------------------------------

HEAD = """# The loop in motion on simulated flights

Made by `python studies/flight_loop.py` (`make study-flights`). Flights of 60 s by closed forms
(`tests/flights.py`), Batista's sensor noises; `casest close bias-gravity` as it is shipped, with
the published intensities as its start. Each section says which flights it is of: one of which none
are at hand stays as it was. No rule looked at their seeds.
"""

#: Sections: titles, and what stands there.
SECTIONS = {
    "Nothing missing": """
{nulls} flights, half at 25 Hz, half at 50 Hz, with noises of one to three times Batista's, which
the loop is not told: an effect was reported in {false} ({share:.1%}, at most {upper:.1%} with 95 %
confidence); called unexplained: {unexplained}. Median processor time {seconds:.1f} s.

{kinds}
""",
    "One effect planted": """
At 50 Hz. Named: first, or among at most two that it cannot be told apart from. Errors are one-step
innovations of the velocity (m/s, rms, held-out time; noise of 0.01 m/s stays in any case), and what
a flight's log-likelihood gained. `error` is the median distance of the found number from the
planted one, in its own standard deviations.

{rows}
""",
    "Effects of the sensors' catalogue": """
As above. A constant wind changes nothing of gravity and bias that a speed through air shows, and
nothing should be found.

{others}
""",
    "A noisy gyro": """
White noise of 0.5 °/s in one reading, ten times Batista's, which the loop is not told either.

{noisy}
""",
    "Two at once": """
{pair}
""",
}

#: Columns of the tables.
KIND_HEAD = ("other noise", "flights", "with an effect", "unexplained")
ROW_HEAD = ("planted", "size", "named", "of them alone", "anything else", "before", "after",
            "log-likelihood", "error")  # fmt: skip
OTHER_HEAD = ("planted", "size", "named", "anything else", "unexplained", "before", "after")


def _table(head: Sequence[str], lines: Iterable[str]) -> str:
    """A table, or that there is none yet."""
    lines = [line for line in lines if line]
    if not lines:
        return "Not made yet."
    return "\n".join([f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *lines])


def read() -> dict[tuple[str, int], dict[str, Any]]:
    lines = KEPT.read_text(encoding="utf-8").splitlines() if KEPT.exists() else []
    kept = [json.loads(line) for line in lines]
    return {(k["name"], k["seed"]): k for k in kept}


def page(kept: dict[tuple[str, int], dict[str, Any]], before: str) -> str:
    """The page with the sections of which there are flights; the others as they were `before`."""
    parts = {part.partition("\n")[0]: part for part in before.split("\n## ")[1:]}
    sections = [HEAD]
    for title, body in SECTIONS.items():
        own = {key: k for key, k in kept.items() if section_of(key[0]) == title}
        if own:
            minutes = sum(k["seconds"] for k in own.values()) / 60
            first = min(k["seed"] for k in own.values())
            made = (
                f"{len(own)} flights, seeds from {first} on; {minutes:.0f} minutes of a processor."
            )
            parts[title] = f"{title}\n\n{made}\n{body.format(**_filled(own))}"
        if title in parts:
            sections.append(parts[title].strip("\n") + "\n")
    return "\n## ".join(sections)


def section_of(name: str) -> str:
    """In which section a world stands."""
    kind, _ = kind_of(name)
    if name == "gyro bias and lever arm":
        return "Two at once"
    if name.endswith("noisy gyro"):
        return "A noisy gyro"
    if name.startswith("null"):
        return "Nothing missing"
    return "One effect planted" if kind in WORLDS else "Effects of the sensors' catalogue"


def _filled(kept: dict[tuple[str, int], dict[str, Any]]) -> dict[str, Any]:
    """What stands in the places of a section."""

    def of(name: str) -> list[dict[str, Any]]:
        return [k for k in kept.values() if k["name"] == name]

    nulls = of("null")
    false = sum(bool(k["found"]) for k in nulls)
    both = of("gyro bias and lever arm")
    named = sum({"bias of omega", "lever_arm of v"} == set(k["found"]) for k in both)
    return {
        "nulls": len(nulls),
        "false": false,
        "share": false / max(len(nulls), 1),
        "upper": float(beta.ppf(0.95, false + 1, max(len(nulls) - false, 1))),
        "unexplained": _unexplained(nulls),
        "seconds": float(np.median([k["seconds"] for k in nulls])) if nulls else np.nan,
        "kinds": _table(KIND_HEAD, (_kind(name, of(name)) for name in KINDS)),
        "rows": _table(ROW_HEAD, (_row(n, s, of(f"{n} x{s:g}")) for n in WORLDS for s in SHARES)),
        "others": _table(
            OTHER_HEAD,
            (_other(n, s, of(f"{n} x{s:g}")) for n in flights.CHANGES for s in SHARES),
        ),
        "noisy": _table(
            OTHER_HEAD,
            [_other("", 1.0, of("noisy gyro"))]
            + [_other(n, 1.0, of(f"{n}, noisy gyro")) for n in BESIDE],
        ),
        "pair": f"Gyro bias and lever arm of the table's sizes: exactly both named in {named} of "
        f"{len(both)} flights.",
    }


def _unexplained(kept: list[dict[str, Any]]) -> int:
    return sum(k["verdict"] == "unexplained" for k in kept)


def _kind(name: str, kept: list[dict[str, Any]]) -> str:
    if not kept:
        return ""
    found = sorted({label for k in kept for label in k["found"]})
    said = f" ({', '.join(found)})" if found else ""
    some = sum(bool(k["found"]) for k in kept)
    title = name.removeprefix("null, ")
    return f"| {title} | {len(kept)} | {some}{said} | {_unexplained(kept)} |"


def _row(name: str, share: float, kept: list[dict[str, Any]]) -> str:
    if not kept:
        return ""
    sensors, label, size = WORLDS[name]
    named, alone, other, errors = 0, 0, 0, []
    for k in kept:
        for found, alike in zip(k["found"], k["alike"], strict=True):
            if label == found or label in alike:
                named += 1
                alone += not alike
            else:
                other += 1
        truth = _planted(smaller(sensors, share), label)
        if truth is not None and label in k["numbers"] and len(k["found"]) == 1:
            z = (np.array(k["numbers"][label]) - truth) / np.array(k["stds"])
            errors.append(float(np.median(np.abs(z))))
    before, after, gain = (np.median([k[w] for k in kept]) for w in ("before", "after", "gain"))
    error = f"{np.median(errors):.2f}" if errors else "–"
    planted = size if share == 1 else f"{share:g} times that"
    return (
        f"| {name} | {planted} | {named} of {len(kept)} | {alone} | {other} | {before:.5f} | "
        f"{after:.5f} | {gain:.0f} | {error} |"
    )


def _other(name: str, share: float, kept: list[dict[str, Any]]) -> str:
    """A line of what changes readings beyond `Sensors`."""
    if not kept:
        return ""
    _, label, size = flights.CHANGES.get(name) or WORLDS.get(name) or (None, "", "–")
    named = other = 0
    for k in kept:
        right = [label == f or label in a for f, a in zip(k["found"], k["alike"], strict=True)]
        named, other = named + any(right), other + (len(right) - sum(right) > 0)
    before, after = (np.median([k[w] for k in kept]) for w in ("before", "after"))
    said = f"{named} of {len(kept)}" if label else f"– ({len(kept)})"
    planted = size if share == 1 else f"{share:g} times that"
    return (
        f"| {name or 'nothing'} | {planted} | {said} | {other} | {_unexplained(kept)} | "
        f"{before:.5f} | {after:.5f} |"
    )


def _planted(sensors: Sensors, label: str) -> Any:
    return {
        "bias of omega": np.array(sensors.gyro_bias),
        "time_delay of v": sensors.delay,
        "lever_arm of v": np.array(sensors.lever),
        "gain of a": sensors.gain,
    }.get(label)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--seconds", type=float, default=np.inf, help="of work, then stop")
    parser.add_argument(
        "--table", action="store_true", help="of what there is, and no more flights"
    )
    options = parser.parse_args()
    KEPT.parent.mkdir(exist_ok=True)
    done, begin = read(), perf_counter()
    left = [x for x in tasks() if x[:2] not in done and re.search(options.only, x[0])]
    left = [] if options.table else left
    for k, (name, seed, sensors, rate) in enumerate(left):
        if perf_counter() - begin > options.seconds:
            break
        made = world(name, seed, sensors, rate)
        with KEPT.open("a", encoding="utf-8") as file:
            file.write(json.dumps(made) + "\n")
        print(f"{k + 1}/{len(left)} {name}, {seed}: {made['verdict']} {made['found']}", flush=True)
    else:
        before = TABLE.read_text(encoding="utf-8") if TABLE.exists() else ""
        TABLE.write_text(page(read(), before), encoding="utf-8")


if __name__ == "__main__":
    main()
