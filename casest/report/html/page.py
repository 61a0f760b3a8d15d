"""HTML of a report: everything that a person wrote is escaped, and no request can leave the page.

A content security policy allows the one script and the one style sheet of the page, by their
digests, and nothing else: what slipped through the escaping would still not run.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import Any

from casest import __version__
from casest.escaping import terminal, visible


def escaped(text: Any) -> str:
    """The text as HTML shows it, characters without a shape as they are written."""
    return html.escape(terminal(str(text)), quote=True)


def tag(name: str, *inside: str, **attributes: str) -> str:
    """An element around HTML; a trailing underscore of an attribute's name is dropped."""
    names = {k: k.rstrip("_").replace("_", "-") for k in attributes}
    said = "".join(f' {names[k]}="{escaped(v)}"' for k, v in attributes.items() if v)
    return f"<{name}{said}>{''.join(inside)}</{name}>"


def paragraph(text: str, look: str = "") -> str:
    """A paragraph of plain text."""
    return tag("p", prose(text), class_=look)


def prose(text: str) -> str:
    """Escaped text in which `code` is set as code, and options of commands like it."""
    parts = escaped(text).split("`")
    if len(parts) % 2 == 0:  # an odd backtick is only a backtick
        return _options(escaped(text))
    return "".join(f"<code>{p}</code>" if k % 2 else _options(p) for k, p in enumerate(parts))


def code_block(text: str) -> str:
    """Lines of code, which scroll sideways where the screen is narrow, also by keyboard."""
    return tag("pre", tag("code", escaped(text)), tabindex="0")


def _options(text: str) -> str:
    """Text in which no line breaks behind the hyphens of --at-rest."""
    return re.sub(r"(?<![\w-])--[a-z][a-z-]*", r'<code class="option">\g<0></code>', text)


def points(texts: Iterable[str], kind: str = "ul") -> str:
    """A list of sentences; nothing where there is none."""
    items = "".join(tag("li", prose(t)) for t in texts)
    return tag(kind, items) if items else ""


def section(name: str, title: str, *inside: str) -> str:
    """A section with a heading; nothing where it would be empty."""
    body = "".join(inside)
    return tag("section", tag("h2", escaped(title)), body, id=name) if body else ""


def details(summary: str, *inside: str) -> str:
    """What is there for those who ask."""
    return tag("details", tag("summary", escaped(summary)), *inside)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table; the columns `numbers` are aligned on their decimal points."""
    if not rows:
        return ""
    columns = [list(c) for c in zip(*rows, strict=True)]
    for k in numbers:
        columns[k] = aligned(columns[k])
    look = ["number" if k in numbers else "" for k in range(len(head))]
    top = "".join(tag("th", escaped(h), class_=c) for h, c in zip(head, look, strict=True))
    body = "".join(
        tag("tr", *(tag("td", _cell(cell), class_=c) for cell, c in zip(row, look, strict=True)))
        for row in zip(*columns, strict=True)
    )
    return scrolled(tag("table", tag("thead", tag("tr", top)), tag("tbody", body)), head[0])


def _cell(text: str) -> str:
    """A long name may break before its parameter, on paper: channel_curve(Throttle).k."""
    return prose(text).replace(").", ")<wbr>.") if text.startswith("`") else prose(text)


def scrolled(inside: str, name: str) -> str:
    """A table in a box that scrolls sideways where the screen is narrow, also by keyboard."""
    return tag("div", inside, class_="wide", tabindex="0", role="group",
               aria_label=f"table of {name}")  # fmt: skip


def aligned(texts: Sequence[str]) -> list[str]:
    """Numbers padded with blanks as wide as digits, so that their decimal points meet."""
    tails = [_tail(text) for text in texts]
    digits = max((len(t.lstrip(".")) for t in tails), default=0)
    point = any(t.startswith(".") for t in tails)
    found = []
    for text, tail in zip(texts, tails, strict=True):
        blanks = "\u2007" * (digits - len(tail.lstrip(".")))
        found.append(text + ("\u2008" if point and not tail.startswith(".") else "") + blanks)
    return found


def _tail(text: str) -> str:
    """What stands from the decimal point on."""
    _, point, rest = text.partition(".")
    return point + rest


def document(
    title: str, body: str, figures: Sequence[Any], arrays: Sequence[Any], *, trusted: bool
) -> str:
    """The whole page, with its style, its script and the figures' data."""
    style, script = (_shipped(name) for name in ("style.css", "plot.js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    data = _for_script({"figures": figures, "arrays": arrays})
    return (
        "<!DOCTYPE html>\n"
        '<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{escaped(policy)}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="generator" content="casest {escaped(__version__)}">'
        '<link rel="icon" href="data:,">'
        f"<title>{escaped(title)}</title><style>{style}</style></head>\n"
        f"<body{'' if trusted else ' class=refused'}><main>{body}"
        f"{tag('noscript', paragraph(_STILL)) if figures else ''}</main>\n"
        f'<script type="application/json" id="data">{data}</script>\n'
        f"<script>{script}</script></body></html>\n"
    )


_STILL = (
    "Scripts are switched off: these pictures are still. With the script of this page they show "
    "values under the pointer, and long records can be zoomed."
)


def _shipped(name: str) -> str:
    return files("casest.report.html").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()


def _for_script(data: Any) -> str:
    """JSON that cannot end the element that holds it."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    text = visible(text)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text
