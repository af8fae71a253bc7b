"""Text from files and other processes, for a terminal."""


def printable(text: object) -> str:
    """The text in one line, with escapes in place of control characters, which a terminal obeys, and of characters that
    reorder or hide others.
    """
    return "".join(c if c == " " or c.isprintable() else repr(c)[1:-1] for c in str(text))


def printable_lines(text: object) -> str:
    """As `printable`, for a text of several lines."""
    return "\n".join(map(printable, str(text).split("\n")))
