"""Cases of a test as a table: a line each, its words apart."""


def rows(table: str, words: int = 0, at: str | None = None) -> list[list[str]]:
    """Split a table into lines, and each of them into words, of which the last keeps its spaces.

    words : in each line; 0: as many as there are. at : what parts them, spaces by default.
    """
    return [line.split(at, words - 1) for line in table.strip().splitlines()]
