"""The small plausible mistakes of studies/mutation.py, the test files that should notice, and what
is to be said of those that nothing notices."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]

#: Fastest test files of each module, the likeliest to notice first.
TESTS: dict[str, tuple[str, ...]] = {
    "estimate/certificate": ("certificate_limits", "angles_and_rivals", "certificate"),
    "estimate/reasons": ("certificate_limits", "angles_and_rivals", "certificate", "batch"),
    "estimate/covariance": ("spread", "norm_statistics"),
    "estimate/correlation": ("spread", "adequacy"),
    "estimate/remembering": ("spread",),
    "estimate/spells": ("spells",),
    "estimate/held_out": ("cross_validation",),
    "leastsquares/weights": ("spread", "effect_kinds"),
    "leastsquares/sums": ("spread", "certificate_limits", "norm_limits"),
    "leastsquares/agreement": ("scatter", "false_alarms"),
    "fleet/": ("batch_certificate", "batch"),
    "diagnose/cross_validation": ("cross_validation",),
    "diagnose/evidence/held_out": ("cross_validation", "false_alarms"),
    "diagnose/evidence/linear": ("cross_validation", "evidence"),
    "diagnose/evidence/likelihood": ("evidence", "false_alarms"),
    "diagnose/evidence/score": ("evidence", "false_alarms"),
    "diagnose/levels": ("evidence", "cross_validation", "false_alarms", "formula", "loop"),
    "diagnose/protocol": ("cross_validation", "evidence", "false_alarms", "formula", "loop"),
    "diagnose/candidates/slopes": ("slopes",),
    "diagnose/motion/loop": ("cross_validation", "closing_motion"),
    "diagnose/misfit/structure": ("structure", "adequacy"),
    "diagnose/misfit/left": ("adequacy", "doubt", "slow_course"),
    "dynamics/extended": ("gaps", "extended"),
    "dynamics/filter": ("gaps", "extended", "dynamics"),
    "dynamics/discrete": ("discrete", "dynamics"),
    "dynamics/riccati": ("dynamics",),
    "dynamics/stepping": ("gaps", "dynamics"),
    "dynamics/gramian": ("gaps", "dynamics"),
    "dynamics/known": ("extended",),
    "dynamics/between": ("digits", "gaps"),
    "dynamics/factors": ("digits",),
    "dynamics/course": ("course",),
    "dynamics/record": ("gaps", "dynamics"),
    "dynamics/transition": ("gaps", "discrete", "dynamics", "intensities"),
    "correction/": ("two_roots", "apply"),
    "data/timing": ("time_units", "bind"),
    "data/bind": ("time_units", "bind"),
    "data/clock": ("time_units", "bind"),
    "data/splits": ("splits",),
    "data/rest": ("rest",),
    "data/scaling": ("time_units", "bind"),
    "data/delimited": ("table",),
    "data/converting": ("time_units", "bind"),
    "units": ("units", "time_units"),
}


class Mutant(NamedTuple):
    """A mistake: in a module, this snippet becomes that."""

    path: str
    old: str
    new: str

    @property
    def name(self) -> str:
        """How it is named: the module and a digest of the change."""
        digest = hashlib.sha256(f"{self.old}\n{self.new}".encode()).hexdigest()[:6]
        return f"{self.path.removesuffix('.py')} {digest}"

    @property
    def tests(self) -> tuple[str, ...]:
        """Names of the test files that run, in order."""
        found = [names for prefix, names in TESTS.items() if self.path.startswith(prefix)]
        if not found:
            raise SystemExit(f"{self.path}: no test files are named for it; add them to TESTS")
        return tuple(f"test_{name}.py" for name in found[-1])

    def identity(self, root: Path = ROOT) -> str:
        """Of the module and of the tests as they are there: what a record holds for."""
        parts = [root / "casest" / self.path, *(root / "tests" / test for test in self.tests)]
        digest = hashlib.sha256(b"".join(p.read_bytes() for p in parts)).hexdigest()[:12]
        return f"{self.name} {digest}"


CERTIFICATE, JUDGE = "estimate/certificate.py", "fleet/judge.py"
REASONS = "estimate/reasons.py"
SCORE, LIKELIHOOD = "diagnose/evidence/score.py", "diagnose/evidence/likelihood.py"
PARTS, LINEAR = "diagnose/evidence/held_out.py", "diagnose/evidence/linear.py"
CROSS, CONFIRMING = "diagnose/cross_validation.py", "diagnose/protocol/confirming.py"
LEVELS = "diagnose/levels.py"
TRANSITION, EXTENDED = "dynamics/transition.py", "dynamics/extended.py"

MUTANTS = tuple(
    Mutant(*parts)
    for parts in (
        # -- the certificate -----------------------------------------------------------------------
        (REASONS, "SLOPE = 1e-5", "SLOPE = 1e-2"),
        (REASONS, "STEP = 1e-4", "STEP = 1.0"),
        (REASONS, "PRACTICALLY_NULL = 1e-5", "PRACTICALLY_NULL = 1e-9"),
        (REASONS, "SHAPE, FAR = (0.5, 10.0), 1000.0", "SHAPE, FAR = (0.05, 100.0), 1000.0"),
        (REASONS, "SECOND_ORDER = 0.07", "SECOND_ORDER = 0.7"),
        (REASONS, "CURVATURE = 1e-9", "CURVATURE = -1e9"),
        (REASONS, "ALIKE, APART = 1.92, 10.0", "ALIKE, APART = 0.0192, 10.0"),
        (REASONS, "ALIKE, APART = 1.92, 10.0", "ALIKE, APART = 1.92, 1000.0"),
        (REASONS, "ALIKE, APART = 1.92, 10.0", "ALIKE, APART = 1.92, 1.0"),
        (CERTIFICATE, '{"rad": 2 * np.pi, "deg": 360.0}', '{"rad": np.pi, "deg": 180.0}'),
        (CERTIFICATE, "against += misshapen or _ambiguous", "against += misshapen and _ambiguous"),
        (REASONS, "ON_BOUND = 1e-3", "ON_BOUND = 0.0"),
        (CERTIFICATE, "excess <= max(SAME", "excess <= 1e4 * max(SAME"),
        (
            CERTIFICATE,
            "step = sign * 2 * sigma / singular[k]",
            "step = sign * 0.2 * sigma / singular[k]",
        ),
        # -- the covariance ------------------------------------------------------------------------
        (
            "estimate/covariance.py",
            "robust, _ = _sandwich(problem, point, R, correlated_over, free)",
            "robust, _ = _sandwich(problem, point, R, 1.0, free)",
        ),
        ("estimate/remembering.py", "-0.5 * (told.sum()", "0.5 * (told.sum()"),
        (
            "leastsquares/sums.py",
            "residual = _without_leverage(block, moved)",
            "residual = block.residual",
        ),
        ("estimate/covariance.py", "10 * correlated_over", "1 * correlated_over"),
        ("estimate/covariance.py", "groups / (groups - 1)", "(groups - 1) / groups"),
        ("estimate/correlation.py", "2 * pairs.sum() - 1", "pairs.sum()"),
        ("estimate/correlation.py", "neighbours < 2.33", "neighbours < 23.3"),
        ("leastsquares/weights.py", "/ dof / np.mean(slope) ** 2", "/ dof / np.mean(w) ** 2"),
        ("leastsquares/weights.py", "np.sum((w * r) ** 2)", "np.sum(w * r**2)"),
        ("leastsquares/weights.py", "np.median(everything)) / 0.6745", "np.median(everything))"),
        (
            "leastsquares/sums.py",
            "return np.asarray(-bread @ slope)",
            "return np.asarray(0 * slope)",
        ),
        ("leastsquares/sums.py", 'np.einsum("nmk,nk->nm", inverse, residual)', "residual"),
        ("leastsquares/agreement.py", "/ variance / correlated_over", "/ variance"),
        # -- many sensors --------------------------------------------------------------------------
        (JUDGE, "suspect = ~_parabolic(ratios)", "suspect = np.zeros(len(k), bool)"),
        (JUDGE, "(near & (away > APART)) | lower", "near & (away > APART)"),
        (JUDGE, "(near & (away > APART)) | lower", "lower"),
        (JUDGE, "found.covariance[:] += shift", "pass"),
        ("fleet/on_bounds.py", "found.add(Code.BOUND,", "(lambda *_: None)(Code.BOUND,"),
        (
            JUDGE,
            "np.where(inside & np.isfinite(rise), rise, np.inf)",
            "np.where(np.isfinite(rise), rise, np.inf)",
        ),
        (JUDGE, "elongated = found.smallest <= 0.1", "elongated = found.smallest <= 0.001"),
        (JUDGE, "SAFETY = 3.5", "SAFETY = 0.035"),
        (JUDGE, "SHRUNK = 0.1", "SHRUNK = 1e9"),
        (REASONS, "TIME_SERIES = 5.0", "TIME_SERIES = 50.0"),
        (
            JUDGE,
            "found.add(Code.NO_REDUNDANCY, freedom <= 0)",
            "found.add(Code.NO_REDUNDANCY, freedom < 0)",
        ),
        (
            "fleet/local.py",
            "2 * fits.cost / np.where(freedom > 0, freedom, np.nan)",
            "2 * fits.cost / count",
        ),
        ("fleet/fit.py", "np.clip(x + step, bounds.lower, bounds.upper) - x, held)", "step, held)"),
        # -- cross-validation and held-out data ----------------------------------------------------
        (CROSS, "run.take(fold != k)", "run.take(fold != k - 99)"),
        (
            CROSS,
            "weighted(Problem(model, seen), values)",
            "weighted(Problem(model, tuple(runs)), values)",
        ),
        (CROSS, "10 * correlated_over", "0.1 * correlated_over"),
        (CROSS, "spread < LEVELS.uncertain * held", "spread < 1e9 * held"),
        (PARTS, "rest = A - square", "rest = A"),
        (PARTS, "(b - product)", "b"),
        (PARTS, "gained = float(np.sum(b**2)) - left", "gained = float(np.sum(b**2)) + left"),
        (PARTS, "max(float(np.sum(wide**2)), white)", "white"),
        (PARTS, "max(float(np.sum(wide**2)), white)", "float(np.sum(wide**2))"),
        (PARTS, "np.clip(np.where(nearer, a, b), -far, far)", "np.where(nearer, a, b)"),
        (
            LINEAR,
            "stretches = place * LEVELS.stretches // size",
            "stretches = batches % LEVELS.folds",
        ),
        (LINEAR, "regions = _regions(inputs, LEVELS.regions)", "regions = batches % LEVELS.folds"),
        (CONFIRMING, "all(f.ratio < 1 for f in found.values())", "True"),
        (CONFIRMING, "if not holds_out(seen, ranking.linear):", "if False:"),
        (LEVELS, "confirmed: float = 1.64", "confirmed: float = 0.0"),
        (
            "estimate/held_out.py",
            "with_own(model, values, (fitted,))",
            "with_own(model, values, (scored,))",
        ),
        ("diagnose/motion/loop.py", "H[~hidden], z[~hidden]", "H, z"),
        ("data/splits.py", "(run.count > 1).any()", "(run.count > 1e9).any()"),
        # -- evidence and score tests --------------------------------------------------------------
        (LEVELS, "strong: float = 6.0", "strong: float = 0.0"),
        (LEVELS, "chance: float = 0.01", "chance: float = 0.1"),
        (LEVELS, "described: float = 30.0", "described: float = -1000.0"),
        (
            SCORE,
            "gain - freedom * float(np.log(rest))",
            "gain - 0.2 * freedom * float(np.log(rest))",
        ),
        (SCORE, "- 2 * searched\n    left", "\n    left"),
        (SCORE, "(rest - freedom) * np.log1p(n)", "rest * np.log1p(n)"),
        (SCORE, "* rest / freedom", "* n / freedom"),
        (SCORE, "for t in trials) + several", "for t in trials)"),
        (SCORE, "if freedom < len(own):", "if False:"),
        (SCORE, "away @ (weight / weight.sum())", "away[:, 0]"),
        (SCORE, "weight = np.exp(0.5 * (scores - scores.max()))", "weight = np.ones_like(scores)"),
        (
            LIKELIHOOD,
            "np.clip(1 - taken / self.sums.count, LEFT, 1)",
            "np.ones_like(taken)",
        ),
        (LIKELIHOOD, "self.sums.count * np.log(S) + power / S", "power / S"),
        (LIKELIHOOD, "kept = values > max(self.linear.least**2,", "kept = values > min(0.0,"),
        ("diagnose/misfit/structure.py", "(1 - ratio)", "(1 - 0.9 * ratio)"),
        ("diagnose/misfit/structure.py", "* len(z) * tried", "* tried"),
        # -- filters -------------------------------------------------------------------------------
        ("dynamics/between.py", "X1 - tau * (X1 - X0)", "X1"),
        (TRANSITION, "np.where(moved @ driven,", "np.where(driven,"),
        (TRANSITION, "Phi[wide].transpose(0, 2, 1) + own", "Phi[wide].transpose(0, 2, 1)"),
        (TRANSITION, "np.full(len(steps), usual(steps))", "steps"),
        (TRANSITION, "h**2 / 12 * bend", "h**2 / 6 * bend"),
        (TRANSITION, "0.5 * (step[1:] + step[:-1])", "step[1:]"),
        (EXTENDED, "Phi @ lost @ Phi.T + Q + lost", "Q"),
        (EXTENDED, "driven(path(tau),", "driven(path(0),"),
        (EXTENDED, "Q = with_lost(self.model, self.steps[first:last, 0], Phi, Q, pace)", "pass"),
        (EXTENDED, "- ca.dot(c, found - along)", ""),
        ("dynamics/filter.py", "first = first or (along, P)", "first = (along, P)"),
        (
            "dynamics/filter.py",
            "variances(model, system.steps, system.pace)",
            "variances(model, system.steps) * system.steps.mean()",
        ),
        ("dynamics/factors.py", "D[j] * (last * one_over)", "D[j]"),
        ("dynamics/discrete.py", "np.where(self.present[:, :, None], self.C, 0.0)", "self.C"),
        ("dynamics/riccati.py", "both[:, n:, n:] = -A", "both[:, n:, n:] = A"),
        ("dynamics/riccati.py", "W = _even(W + back @ W", "W = _even(back @ W"),
        ("dynamics/stepping.py", "ca.vertcat(weight, 1 / R)", "ca.vertcat(weight, R)"),
        ("dynamics/course.py", "_back(found, pieces, [*begun, state])", "pass"),
        ("dynamics/gramian.py", "pace.usual / system.steps)", "0 * system.steps + 1)"),
        ("dynamics/known.py", "S[:, np.arange(count), np.arange(count)] += hidden", "pass"),
        # -- corrections and readers ---------------------------------------------------------------
        (
            "correction/c.py",
            "fabs(value[i] - MIDDLE) > away) away = fabs(value[i] - MIDDLE)",
            "fabs(value[i]) > away) away = fabs(value[i])",
        ),
        ("correction/c.py", "<= CLOSE * {largest}", "<= 1e30 * CLOSE * {largest}"),
        ("correction/runtime.py", 'np.abs(v - newton["middle"])', "np.abs(v)"),
        ("correction/inverse.py", "np.abs(found - middle).max", "np.abs(found).max"),
        ("data/timing.py", '1000.0 if found[2] == "kHz" else 1.0', "1.0"),
        ("data/timing.py", "return values * factor, []", "return values, []"),
        ("data/timing.py", "GAP = 5.0", "GAP = 50.0"),
        ("data/bind.py", "labels[np.sort(first)]", "labels[first]"),
        ("data/clock.py", "(time * factor)[:, None]", "time[:, None]"),
        ("data/rest.py", "covariance[0] * inflation / (n - 1)", "covariance[0] / (n - 1)"),
        ("data/scaling.py", "unsigned >= range_ / 2", "unsigned > range_ / 2"),
        ("data/delimited.py", 'replace(",", ".").split', 'replace(",", "").split'),
        ("units.py", '"mGal": _si(1e-5', '"mGal": _si(1e-3'),
        ("units.py", '"kHz": _si(1e3', '"kHz": _si(1e6'),
    )
)
#: What is to be said of those that survive, by module and mistake.
JUDGED: dict[tuple[str, str], str] = {
    (REASONS, "ALIKE, APART = 1.92, 1.0"): (
        "what ended near the best is followed first and ends in it; a solution of its own between "
        "one deviation and eight bends the cost, which is asked before"
    ),
    ("estimate/covariance.py", "(groups - 1) / groups"): (
        "too small to matter: 3 % of a standard deviation with the fewest batches, 20 an unknown"
    ),
    (JUDGE, "np.where(np.isfinite(rise), rise, np.inf)"): (
        "equivalent: the walk ends at the bound, so that it is always inside"
    ),
    (JUDGE, "SHRUNK = 1e9"): (
        "equivalent in the verdict: where the cost is no parabola second derivatives are asked "
        "anyway, and fits end in no maximum"
    ),
    ("data/splits.py", "(run.count > 1e9).any()"): (
        "equivalent: a mean of a rest interval is one sample, which is not cut"
    ),
}
