"""What speaks for a valley and against it, in figures and in words.

That several starts end alike is no proof: around one start they share its error. Evidence is a
residual no larger than what rows with nearly the same inputs differ by, where these show a course;
else a search over all that the data span must have found nothing lower, and what it found must be
better than chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casest.estimate.certificate import Certificate
from casest.estimate.reasons import Code
from casest.leastsquares.neighbours import Scatter
from casest.leastsquares.problem import Point, Problem
from casest.solve.global_search import Search

#: Chance of noise from which on the residual is as large as neighbours say (no search), and below
#: which it is larger than they say (a misfit).
AS_LARGE, LARGER = 0.01, 1e-3
#: And variance of the residual over that of neighbours up to which these vouch for it.
MOST = 1.5
#: Share of the readings' spread that neighbours must show as a course to vouch for a valley.
COURSE = 0.75
#: Share of that course that a model must explain for its valley to be believed beside a misfit.
EXPLAINED = 0.5
#: And from which on there is too little left to go on looking for more.
LITTLE_LEFT = 0.9
#: Chance, over all valleys seen, of explaining so much by accident.
ACCIDENT = 1e-3
#: Share of a search's starts that end in one valley, from which on it is believed beside a misfit.
MAJORITY = 0.5
#: Times that a search must have come to one valley from different places.
AGAIN = 3


@dataclass(frozen=True)
class Evidence:
    """For a valley: the scatter of neighbours at the best point, and the search, where one was.

    `equal`: other points that are the same function of the inputs; `aliases`: rates that the rows
    cannot tell from those given; of differential equations where another course through them is.
    """

    scatter: Scatter | None
    search: Search | None = None
    equal: tuple[Point, ...] = ()
    aliases: tuple[str, ...] = ()

    @property
    def vouched(self) -> bool:
        """Do the neighbours by themselves say that nothing is left, and could they tell?"""
        found = self.scatter
        if found is None:
            return False
        exact = found.explained > 1 - 1e-9
        # Few rows refuse little: as large means so in size too.
        as_large = found.p_value() >= AS_LARGE and found.residual <= MOST * found.neighbours
        return exact or (as_large and found.resolved >= COURSE)

    @property
    def settled(self) -> bool:
        """Is there no reason to look any further?"""
        found = self.scatter
        if self.vouched:
            return True
        little = found is None or found.explained >= LITTLE_LEFT * found.resolved
        return _against(self, 0) is None and (self.most or little or not self.misfit)

    @property
    def most(self) -> bool:
        """Did most of the starts that were followed end here? What lies elsewhere is then small."""
        looked = self.search
        return looked is not None and looked.arrived >= MAJORITY * looked.followed

    @property
    def lacking(self) -> bool:
        """Of what neighbouring readings share, is more left than a small rest?"""
        found = self.scatter
        return self.misfit and found is not None and found.explained < LITTLE_LEFT * found.resolved

    @property
    def misfit(self) -> bool:
        """Is there something left that rows with nearly the same inputs share?"""
        found = self.scatter
        return found is not None and min(found.p_value(), found.p_value(left=True)) < LARGER


def judged(problem: Problem, certificate: Certificate, evidence: Evidence | None) -> Certificate:
    """The certificate in the light of the evidence: refused, or with one more reason."""
    if evidence is None or not certificate.trusted:
        return certificate
    # Of those that agree one is the answer itself, and one what the search handed back.
    others = max(certificate.agreeing - 2, 0)
    if rival := _rival(problem, evidence):
        return certificate.refused(Code.AMBIGUOUS, rival)
    if against := _against(evidence, others):
        return certificate.refused(Code.POOR_VALLEY, against)
    if problem.model.traced.integrates and evidence.lacking:
        return certificate.refused(Code.POOR_VALLEY, _undriven(evidence))
    found = evidence.search
    if found is not None:
        more = (
            f"no lower valley in a search over what the data span: {found.places} places, of "
            f"{found.followed} followed {found.arrived} ended here"
        )
    elif certificate.agreeing < certificate.starts and evidence.vouched:
        more = "the residual is no larger than what rows with nearly the same inputs differ by"
    else:
        return certificate
    return replace(certificate, reasons=(*certificate.reasons, more))


def _against(evidence: Evidence, agreeing: int) -> str | None:
    """What speaks against the valley, in words; None where nothing does.

    `agreeing` other ways ended there, beside those of the search.
    """
    found, looked = evidence.scatter, evidence.search
    if looked is None or evidence.vouched:
        return None
    if looked.given_up and looked.arrived < AGAIN:
        return (
            f"a search for a better valley was given up: {looked.followed} of its starts could be "
            f"followed in its time, and {looked.arrived} ended here, since the equations are stiff "
            "there or the record is long; give --start near the solution, or bounds that keep the "
            "search away from what is stiff"
        )
    advice = "give --start near the solution, bounds, or more rows"
    if found is None:
        if evidence.most or looked.arrived + agreeing >= AGAIN:
            return None
        return (
            f"{looked.followed} starts over what the data span ended in {looked.valleys} places, "
            f"{looked.arrived} of them here: there may be a better one; {advice}"
        )
    if evidence.misfit:
        enough = found.explained >= EXPLAINED * max(found.resolved, 0.0)
        if evidence.most or (enough and looked.arrived + agreeing >= AGAIN):
            return None
        return (
            f"it explains {100 * max(found.explained, 0.0):.0f} % of the readings' variance, of "
            f"which rows with nearly the same inputs share {100 * found.resolved:.0f} %, and a "
            f"search over {looked.places} places found nothing better: a wrong valley, or a wrong "
            f"model; {advice}"
        )
    if evidence.most or _accident(found, looked) < ACCIDENT:
        return None
    return (
        f"no better than chance: {looked.valleys} valleys were seen, and the best explains "
        f"{100 * max(found.explained, 0.0):.0f} % of the readings' variance; {advice}"
    )


def _undriven(evidence: Evidence) -> str:
    """Equations without driving noise that leave a course: one like it would move every constant.

    Standard deviations of a misfit hold where it has nothing to do with what drives the states;
    a course as large as this is another input, or another term.
    """
    found = evidence.scatter
    assert found is not None
    return (
        f"the equations explain {100 * max(found.explained, 0.0):.0f} % of the readings' variance, "
        f"of which neighbouring readings share {100 * found.resolved:.0f} %: a term or an input is "
        "missing, and no interval of a constant would hold; measure what drives the states, or "
        "add the term (casest close looks for it)"
    )


def _rival(problem: Problem, evidence: Evidence) -> str | None:
    """Another valley that the data do not refuse at a level of 0.001, in words."""
    looked = evidence.search
    if looked is None or evidence.vouched or not looked.rivals:
        return None
    here, there = looked.outcome.point.x, looked.rivals[0].point.x
    size = np.maximum(np.maximum(np.abs(here), np.abs(there)), 1e-300)
    i = int(np.argmax(np.abs(there - here) / size))
    return (
        f"two valleys fit nearly alike: `{problem.names[i]}` = {here[i]:.6g} and {there[i]:.6g}; "
        "give bounds that leave out one of them, or more rows"
    )


def _accident(found: Scatter, looked: Search) -> float:
    """Chance that the best of so many valleys explains so much of mere noise."""
    from scipy.special import fdtrc

    freedom = found.freedom[0]
    gained = found.spread * (freedom + looked.bent) - found.residual * freedom
    F = gained / looked.bent / found.residual if found.residual > 0 else np.inf
    return float(fdtrc(looked.bent, freedom, max(F, 0.0)) * looked.valleys)


def remarks(problem: Problem, evidence: Evidence | None) -> Iterator[str]:
    """That something is left which neighbours share; that there are equal solutions elsewhere."""
    if evidence is None:
        return
    if evidence.search is not None and evidence.scatter is not None and evidence.misfit:
        yield _misfit(evidence.scatter)
    if evidence.aliases and problem.model.traced.integrates:
        yield (
            "these rows are met as well by a faster course, which turns whole turns more between "
            f"them ({evidence.aliases[0]}): what is given is the slowest, or that most like the "
            "stated start; bounds leave the others out"
        )
    elif evidence.aliases:
        yield (
            f"evenly spaced rows cannot tell rates that turn whole turns more from one row to the "
            f"next: {', '.join(evidence.aliases)} (and multiples) fits alike; what is given is "
            "the slowest, or that at the stated start; bounds leave the others out"
        )
    if evidence.equal:
        there = ", ".join(
            f"`{name}` = {x:.6g}"
            for name, x in zip(problem.names, evidence.equal[0].x, strict=True)
        )
        yield (
            f"other values are the same function of the inputs ({there}): of such equal solutions "
            "the one most like the start is given"
        )


def _misfit(found: Scatter) -> str:
    times = np.sqrt(found.residual / max(min(found.neighbours, found.left), 1e-300))
    return (
        f"misfit: the residual is {times:.3g} times what rows with nearly the same inputs differ "
        "by, and no better valley was found: the model lacks something (casest close looks for "
        "it), or the noise is alike in neighbouring rows"
    )
