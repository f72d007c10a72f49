"""Makes text from devices and certificates safe to print on one line of a terminal, a log or a table.

Knows characters only. Names in devices and certificates are chosen by others, who may be hostile. Printed unchanged, a
line break forges a line, an escape sequence changes what was printed before it, and a bidirectional control turns the
rest of the line around.
"""


def printable(text: str) -> str:
    """Return a text on one line, with escapes such as ``\\n`` and ``\\u202e`` in place of invisible characters.

    Escaped are all control and format characters, bidirectional ones among them, line and paragraph separators, every
    space but the plain one, private and unassigned characters, and lone surrogates. Other characters stay as they are,
    backslashes too.
    """
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)
