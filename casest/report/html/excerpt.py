"""What a notebook shows of a fit: the verdict and the values, without the page around them."""

from __future__ import annotations

from casest.report.html.fitted import parameter_rows
from casest.report.html.page import escaped, points, table, tag
from casest.results.fitted import Fitted

#: Colours of what is believed, of what is believed with a doubt, and of what is not.
_GOOD, _DOUBTFUL, _BAD = "#1a7f37", "#9a6700", "#b3261e"


def excerpt(result: Fitted, said: str) -> str:
    """What is `said` of a fit first, in the colour of its verdict, then its values and notes."""
    doubtful = result.misfit or result.verdict == "extended"
    colour = _DOUBTFUL if doubtful else _GOOD
    if not result.trusted or result.verdict == "unexplained":
        colour = _BAD
    head = tag("p", tag("b", escaped(said), style=f"color:{colour}"))
    names = ["parameter", "value", "± std", "95 % from", "to", "unit"]
    return tag("div", head, table(names, parameter_rows(result), range(1, 5)), points(result.notes))
