"""NIST's 27 nonlinear problems: which solver is right, and which says so truly?

    make study-nist       # python studies/nist.py: about a quarter of an hour on one core

First every solver from NIST's two starts of each problem, then casest's default way from 20 more
starts of each. Each fit is kept in `out/nist.jsonl`, so that an interrupted study goes on where it
stopped; remove that file to begin afresh. The tables are written to `studies/nist.md`.
"""

from __future__ import annotations

import json
import os
import sys
import time
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import resumed  # noqa: E402
from nist import MODELS, Certified, fewest_digits, read  # noqa: E402

from casest import Model, attempt  # noqa: E402
from casest.engine.threads import one_thread  # noqa: E402
from casest.leastsquares.problem import Point, Problem  # noqa: E402
from casest.solve.ipopt import ipopt  # noqa: E402
from casest.solve.others import sqpmethod  # noqa: E402
from casest.solve.trust_region import trust_region  # noqa: E402

KEPT, TABLE = ROOT / "out" / "nist.jsonl", ROOT / "studies" / "nist.md"
#: Digits in every parameter from which an answer is right.
RIGHT = 6.0
#: More starts of each problem, half of them around each of NIST's, and how far they are spread:
#: every parameter is multiplied by 1 + size·(a standard normal number).
MORE, SIZES = 20, (0.1, 0.2, 0.3)
DEFAULT = "casest (default)"


def scipy_tight(problem: Problem, start: Point, method: Any) -> tuple[Point, bool]:
    """SciPy's `least_squares` with the analytic Jacobian and tolerances near rounding."""

    def residual(x: np.ndarray) -> np.ndarray:
        return np.concatenate([r.ravel() for r in problem.residuals(Point(x, start.references))])

    found = least_squares(
        residual,
        start.x,
        lambda x: problem.jacobian(Point(x, start.references)),
        method=method,
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=5000,
    )
    return Point(found.x, start.references), bool(found.success)


def alone(solver: Callable[..., Any], problem: Problem, start: Point) -> tuple[Point, bool]:
    """One of casest's solvers by itself, without polish or second opinion, and its own claim."""
    found = solver(problem, start)
    return found.point, found.claims_success


#: Each solver by itself: (problem, start) -> (point, claims success).
ALONE: dict[str, Callable[[Problem, Point], tuple[Point, bool]]] = {
    "IPOPT, Gauss-Newton Hessian": partial(alone, ipopt),
    "IPOPT, exact Hessian": partial(alone, partial(ipopt, exact=True)),
    "trust region": partial(alone, trust_region),
    "SciPy lm": partial(scipy_tight, method="lm"),
    "SciPy trf": partial(scipy_tight, method="trf"),
    "SciPy dogbox": partial(scipy_tight, method="dogbox"),
    "CasADi sqpmethod": partial(alone, sqpmethod),
}


# -- fitting ---------------------------------------------------------------------------------------


@cache
def problem_of(name: str) -> Certified:
    """NIST's file of one problem."""
    stated = os.environ.get("CASEST_DATA")
    return read(Path(stated) if stated else ROOT.parent / "shared" / "data", name)


def start_of(certified: Certified, number: int) -> dict[str, float]:
    """NIST's start 1 or 2; from 3 on one of the starts around them."""
    if number <= 2:
        return dict(certified.starts[number - 1])
    rng = np.random.default_rng([zlib.crc32(certified.name.encode()), number])
    size = SIZES[number % len(SIZES)]
    around = certified.starts[number % 2]
    return {n: v * (1 + size * rng.standard_normal()) for n, v in around.items()}


def fit(solver: str, name: str, number: int) -> dict[str, Any]:
    """One fit, judged: digits that are right, what was claimed, how long it took."""
    certified = problem_of(name)
    model = certified.begun_at(start_of(certified, number))
    record = {"solver": solver, "problem": name, "start": number}
    began = time.perf_counter()
    own = by_default(certified, model) if solver == DEFAULT else by_itself(solver, certified, model)
    return record | own | {"seconds": time.perf_counter() - began}


def by_default(certified: Certified, model: Model) -> dict[str, Any]:
    """casest's default way, with its certificate."""
    found = attempt(model, [certified.run])
    certificate = found.certificate
    return {
        "digits": fewest_digits(found.values, certified.values),
        "std": fewest_digits(found.plain, certified.std),
        "claims": certificate.trusted,
        "profiled": certificate.profile is not None,
        "reason": certificate.reasons[0],
    }


def by_itself(solver: str, certified: Certified, model: Model) -> dict[str, Any]:
    """A solver's own answer and its own word."""
    problem = Problem(model, (certified.run,))
    try:
        with np.errstate(all="ignore"), one_thread():
            point, claims = ALONE[solver](problem, problem.start())
    except (ValueError, np.linalg.LinAlgError) as error:  # SciPy: not finite at the start
        return {"digits": 0.0, "claims": False, "reason": str(error)}
    values = problem.values(point)
    if model.canonicaliser is not None:
        values |= model.canonicaliser(model, values)
    return {"digits": fewest_digits(values, certified.values), "claims": claims, "reason": ""}


# -- the study -------------------------------------------------------------------------------------


def main() -> None:
    records = resumed.kept(KEPT)
    done = {(r["solver"], r["problem"], r["start"]) for r in records}
    tasks = [(s, n, k) for s in (DEFAULT, *ALONE) for n in MODELS for k in (1, 2)]
    tasks += [(DEFAULT, n, k) for n in MODELS for k in range(3, MORE + 3)]
    left = [task for task in tasks if task not in done]
    print(f"{len(tasks)} fits, {len(left)} to do")
    for name in MODELS:  # tracing a model is no part of a fit's time
        certified = problem_of(name)
        attempt(certified.begun_at(certified.values), [certified.run])
    KEPT.parent.mkdir(exist_ok=True)
    began = time.time()
    with KEPT.open("a", encoding="utf-8") as kept:
        for k, task in enumerate(left, 1):
            records.append(fit(*task))
            kept.write(json.dumps(records[-1]) + "\n")
            kept.flush()
            print(f"\r{k}/{len(left)}, {time.time() - began:.0f} s", end="", flush=True)
    print()
    TABLE.write_text(page(records), encoding="utf-8")
    print(f"written: {TABLE}")


# -- the page --------------------------------------------------------------------------------------


def is_right(record: dict[str, Any]) -> bool:
    return bool(record["digits"] >= RIGHT)


def page(records: list[dict[str, Any]]) -> str:
    """Markdown: solvers on NIST's starts, the default on more starts, and each exception."""
    nists = [r for r in records if r["start"] <= 2]
    more = [r for r in records if r["start"] > 2]
    lines = [
        "# NIST's nonlinear problems",
        "",
        "Made by `make study-nist` (`python studies/nist.py`). The 27 problems of NIST's",
        "Statistical Reference Datasets for nonlinear regression; the models are in",
        "`tests/nist.py`. An answer is right when every parameter agrees with the certified one",
        f"to {RIGHT:.0f} digits (log relative error; solutions that only exchange equal terms",
        "count as one). A false success is a wrong answer claimed to be right, a false failure",
        "a right one that is not. casest claims by its certificate (`trusted`), every other solver",
        "by its own status. No solver knows more than the one start.",
        "",
        "## From NIST's 54 starts",
        "",
        *solver_rows(nists),
        "",
        'SciPy: `x_scale="jac"`, tolerances 1e-15, at most 5000 evaluations. IPOPT, the trust',
        "region and sqpmethod have casest's own settings, without polish or second opinion: IPOPT",
        "ends at a tolerance of 1e-8, because a polish follows (with its own it is right more",
        "often). Mean digits count at least 0 and at most the 11 that are certified. Tracing the",
        "models is not in the times.",
        "",
        f"## From {MORE} more starts of each problem",
        "",
        "casest's default way; each parameter of NIST's starts multiplied by 1 + s·normal, s = "
        + ", ".join(map(str, SIZES))
        + " in turn.",
        "",
        *more_rows(more),
        "",
        "## Where the cost is no parabola",
        "",
        "There the 95 % intervals are those of the likelihood, each parameter profiled. How many",
        "of the right and trusted answers:",
        "",
        *profiled_rows(nists + more),
        "",
        "## Every exception of the default way",
        "",
        *exceptions(nists + more),
        "",
    ]
    return "\n".join(lines)


def solver_rows(records: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| solver | right | claims | false success | false failure | mean digits | seconds |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for solver in (DEFAULT, *ALONE):
        own = [r for r in records if r["solver"] == solver]
        false_success = sum(r["claims"] and not is_right(r) for r in own)
        false_failure = sum(is_right(r) and not r["claims"] for r in own)
        digits = np.mean([max(r["digits"], 0.0) for r in own])
        lines.append(
            f"| {solver} | {sum(map(is_right, own))} of {len(own)} | "
            f"{sum(r['claims'] for r in own)} | {false_success} | {false_failure} | "
            f"{digits:.2f} | {sum(r['seconds'] for r in own):.1f} |"
        )
    return lines


def more_rows(records: list[dict[str, Any]]) -> list[str]:
    """Right or wrong against trusted or not: a row per problem with a wrong one, and the sum."""
    lines = [
        "| problem | right, trusted | right, refused | wrong, trusted | wrong, refused |",
        "| --- | --- | --- | --- | --- |",
    ]
    counts = {
        name: [
            sum(
                r["problem"] == name and is_right(r) == right and r["claims"] == trusted
                for r in records
            )
            for right, trusted in ((True, True), (True, False), (False, True), (False, False))
        ]
        for name in MODELS
    }
    plain = [name for name, own in counts.items() if own[0] == MORE]
    for name, own in counts.items():
        if name not in plain:
            lines.append(f"| {name} | " + " | ".join(map(str, own)) + " |")
    lines.append(f"| the other {len(plain)} | {MORE * len(plain)} | 0 | 0 | 0 |")
    total = np.sum(list(counts.values()), axis=0)
    lines.append("| **all** | " + " | ".join(f"**{n}**" for n in total) + " |")
    seconds = [r["seconds"] for r in records]
    std = min(r["std"] for r in records if is_right(r) and r["problem"] != "Lanczos1")
    lines += [
        "",
        f"Median {np.median(seconds):.2f} s a fit, {sum(seconds):.0f} s in all. Standard",
        f"deviations of right answers agree to at least {std:.1f} digits (Lanczos1 aside: its",
        "residual is rounding).",
    ]
    return lines


def profiled_rows(records: list[dict[str, Any]]) -> list[str]:
    lines = ["| problem | trusted | of them profiled |", "| --- | --- | --- |"]
    for name in MODELS:
        own = [r for r in records if r["problem"] == name and r["solver"] == DEFAULT]
        trusted = [r for r in own if r["claims"] and is_right(r)]
        profiled = sum(r["profiled"] for r in trusted)
        if profiled:
            lines.append(f"| {name} | {len(trusted)} | {profiled} |")
    return lines


def exceptions(records: list[dict[str, Any]]) -> list[str]:
    """What the default way got wrong, or did not trust."""
    lines = ["| problem | start | digits | trusted | reason |", "| --- | --- | --- | --- | --- |"]
    for r in records:
        if r["solver"] == DEFAULT and not (is_right(r) and r["claims"]):
            trusted = "yes" if r["claims"] else "no"
            lines.append(
                f"| {r['problem']} | {r['start']} | {r['digits']:.1f} | {trusted} | {r['reason']} |"
            )
    return lines if len(lines) > 2 else ["None."]


if __name__ == "__main__":
    main()
