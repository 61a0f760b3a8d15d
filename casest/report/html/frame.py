"""The page around its sections."""

from __future__ import annotations

import re
from collections.abc import Sequence

from casest import __version__
from casest.data.logs import file_name
from casest.report.html.figures import Figures
from casest.report.html.page import document, escaped, paragraph, tag


def whole(
    name: str,
    verdict: str,
    under: str,
    body: Sequence[str],
    figures: Figures,
    data: Sequence[str],
    *,
    trusted: bool = True,
    look: str = "",
) -> str:
    """The page around its sections: where it comes from, the verdict, the contents.

    `look` is the verdict's: good, doubtful, bad, or nothing.
    """
    files = ", ".join(file_name(d) for d in data)
    origin = f"casest {__version__} · {name}" + (f" · {files}" if files else "")
    inside = "".join(body)
    sections = re.findall(r'<section id="(\w+)"><h2>(.*?)</h2>', inside)
    links = "".join(tag("a", title, href=f"#{anchor}") for anchor, title in sections)
    head = tag(
        "header",
        tag("p", escaped(origin), class_="origin"),
        tag("h1", escaped(verdict), id="verdict", class_=look),
        paragraph(under) if under else "",
        tag("nav", links, aria_label="Contents"),
    )
    return document(
        f"{name}: {verdict}", head + inside, figures.figures, figures.arrays, trusted=trusted
    )
