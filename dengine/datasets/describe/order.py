"""In which order the parts were made, as far as names and columns prove it."""

import re

from ..description import UNKNOWN
from ..read.files import natural_key
from ..read.places import without_label, without_suffix
from .columns import Proposal

# Dates in names. Those in the group `odd` are not sorted by name: they have the day or the month
# first, the month as a word, or AM and PM.
DATE = re.compile(
    r"(?i)(?P<odd>(?<![a-z])(jan|feb|m[aä]r|apr|ma[iy]|jun|jul|aug|sep|o[ck]t|nov|de[cz])(?![a-z])"
    r"|\d ?[ap]m(?![a-z])|(?<!\d)\d\d?([-_])\d\d?\3(19|20)\d\d(?!\d)"
    r"|(?<!\d)[0-3]\d[01]\d20[0-3]\d(?!\d))|(?<!\d)(19|20)\d\d([-_.]?)[01]\d\6[0-3]\d"
)
ODD = (
    "name, if that is the order; the names have dates that are sorted otherwise: rename the files, "
    "with year, month and day in front"
)


def propose_order(p: Proposal) -> None:
    """Set `order` in `p` to `?`, with a note, if the file names, sorted, need not be the order.

    That is so if a file name stands in several folders, once the text of `label.path` is left out;
    if a file name has a date that is written with the day, the month or AM and PM so that names do
    not sort by it, or the names are not in the order of their dates; or if a column of `p.unused`
    has one date or time per recording, and these, as `natural_key` sorts texts, are in another
    order. If several hold, the note is on the last. An `order` that the user stated stays. Raises
    SettingError for a malformed `windows.trigger`.
    """
    paths = [without_label(p.description.label, without_suffix(name)) for name in p.names]
    names = [path.rpartition("/")[2] for path in paths]
    if len({*paths}) > len({*names}):
        p.put("order", UNKNOWN, "name: by file name, or path: folder by folder")
    matches = [*filter(None, map(DATE.search, names))]
    dates = [match.string[match.start() :] for match in matches]
    if any(match["odd"] for match in matches) or dates != sorted(dates, key=natural_key):
        p.put("order", UNKNOWN, ODD)
    for column in p.unused:
        ranks = [*map(natural_key, column.fixed)] if column.forms else []
        if ranks != sorted(ranks):
            p.put("order", UNKNOWN, f"name, or {column.name}, whose dates have another order")
