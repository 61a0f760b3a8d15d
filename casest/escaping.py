"""Text that others wrote (names of columns, units, files, models) put into code and terminals.

One function for each target, so that nothing of it is read as anything but text there.
"""

from __future__ import annotations

import re
import unicodedata

#: Control, format (among them what turns the direction of writing), surrogate, private or unknown
#: characters, and separators of lines and paragraphs.
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")


def visible(text: str, keep: str = "") -> str:
    r"""The text with every character that has no shape, but those to `keep`, written as \u001b.

    That is also how JSON writes them, so that printed JSON stays what it was.
    """
    if text.isprintable():
        return text
    for character in set(text) - set(keep):
        if _unseen(character):
            text = text.replace(character, _written(character))
    return text


def _unseen(character: str) -> bool:
    return not character.isprintable() and unicodedata.category(character) in _UNSEEN


def _written(character: str) -> str:
    """By its one or two units of UTF-16."""
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k]:02x}{units[k + 1]:02x}" for k in range(0, len(units), 2))


def terminal(text: str) -> str:
    """For a terminal: lines and tabs are kept, escape sequences become visible."""
    return visible(text, keep="\n\t")


def one_line(text: str) -> str:
    """For a message of one line."""
    return visible(text.replace("\n", " ").replace("\r", " "))


def c_comment(text: str) -> str:
    """For one line within a C comment: it can neither end it nor begin another.

    A backslash, also written as a trigraph, would join lines.
    """
    text = visible(text).replace("\\", "/").replace("??", "? ?")
    while "*/" in text or "/*" in text:
        text = text.replace("*/", "* /").replace("/*", "/ *")
    return text


def c_identifier(text: str) -> str:
    """For a part of a name in C that does not stand at its beginning."""
    return re.sub(r"[^A-Za-z0-9_]", "_", text)


def python_docstring(text: str) -> str:
    """For the inside of a triple-quoted string; its lines are kept."""
    return visible(text, keep="\n").replace("\\", "\\\\").replace('"', '\\"')
