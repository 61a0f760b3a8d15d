"""The page around its sections."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from casest.data.logs import file_name
from casest.report.html.figures import Figures
from casest.report.html.page import document, escaped, paragraph, tag


def whole(
    name: str,
    verdict: str,
    under: str,
    body: Sequence[str],
    content: Mapping[str, Any],
    figures: Figures,
) -> str:
    """The page around its sections: where it comes from, the verdict, the contents."""
    data = ", ".join(file_name(d) for d in content.get("data") or [])
    origin = f"casest {content['casest']} · {name}" + (f" · {data}" if data else "")
    inside = "".join(body)
    sections = re.findall(r'<section id="(\w+)"><h2>(.*?)</h2>', inside)
    links = "".join(tag("a", title, href=f"#{anchor}") for anchor, title in sections)
    head = tag(
        "header",
        tag("p", escaped(origin), class_="origin"),
        tag("h1", escaped(verdict), id="verdict"),
        paragraph(under) if under else "",
        tag("nav", links),
    )
    trusted = bool(content.get("trusted", True))
    return document(
        f"{name}: {verdict}", head + inside, figures.figures, figures.arrays, trusted=trusted
    )
