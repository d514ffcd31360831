"""The encoding of a text file: UTF-8, UTF-16, what the user states, or Windows-1252.

Almost any bytes are a text in Windows-1252. A file whose text looks wrong in it, as `ŽžŠÔ` for
`時間`, is not read: the error shows it in the encodings that it may be in, by which the user states
one. `text.read_table` decodes each file by `decode`.
"""

import re
from collections.abc import Iterable
from contextlib import suppress

from ..errors import shortened
from .dataset import UnreadableError

WESTERN = "Windows-1252"
# Letters and marks that texts in Windows-1252 have in them, besides ASCII.
USUAL = frozenset(
    "äöüßÄÖÜéèêëàâáãåçñíìîïóòôõúùûøæœÿÉÈÊËÀÂÁÃÅÇÑÍÌÎÏÓÒÔÕÚÙÛØÆŒýÝðþÐÞ"
    "µ°²³±·×–—’‘“”„…€§«»¿¡ªº©®¼½¾÷\xa0\xad"
)
HIGH = re.compile("[^\x00-\x7f]+")
# Encodings of other scripts -> the encoding of their usual characters, and the range of these.
OTHERS = {
    "cp932": ("shift_jis", "[\u3041-\u30ff\u4e00-\u9fff]"),
    "gb18030": ("gb2312", "[\u4e00-\u9fff]"),
    "big5": ("big5", "[\u4e00-\u9fff]"),
    "cp949": ("euc_kr", "[\uac00-\ud7a3]"),
    "euc_jp": ("euc_jp", "[\u3041-\u30ff\u4e00-\u9fff]"),
    "cp1251": ("cp1251", "[А-яЁё]"),
}
# In which a text may have the names that a user states; Windows-1252 reads most of them, too.
BY_NAME = ("cp1250", *OTHERS, "cp1253", "cp1254", "cp1257")
FEW = 3  # encodings that an error proposes
SHOWN = 24  # characters of a text


def decode(content: bytes, stated: str | None = None) -> tuple[str, str]:
    """Return the text of a file, and the name of its encoding.

    UTF-16 is known by its mark or its zeros. Else UTF-8 is tried (the name is utf-8-sig), then the
    stated encoding; without one Windows-1252, and at last Latin-1, which reads anything.

    Parameters
    ----------
    content : bytes
    stated : str, optional
        Encoding that the user states for files that are not UTF-8.

    Raises
    ------
    UnreadableError
        If the text is not in the stated encoding, or looks wrong in Windows-1252 and right in
        another one, which the error names.
    """
    head = content[:400]
    encodings = ["utf-8-sig", stated or WESTERN]
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = ["UTF-16"]
    elif b"\0" in head:
        is_little = head[1::2].count(0) > head[::2].count(0)
        encodings = ["UTF-16-LE" if is_little else "UTF-16-BE"]
    for encoding in encodings:
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            if encoding != WESTERN or _is_western(text):
                return text, encoding
    if stated is not None:
        raise UnreadableError(
            f"Expected text in {stated}, as stated, or UTF-8, got another{_advice(content)}"
        )
    if advice := _advice(content):
        raise UnreadableError(f"Expected text in UTF-8 or {WESTERN}, got another encoding{advice}")
    return content.decode("latin-1"), "Latin-1"


def missing_name(content: bytes, names: Iterable[str], stated: str | None = None) -> str:
    """Return what to do, for an error, if a text has one of some names only in another encoding.

    "" if it has not. Names in ASCII, and a text in UTF-8 or UTF-16, tell nothing.

    content, stated : as for `decode`.
    """
    with suppress(UnreadableError):
        text, encoding = decode(content, stated)
        if encoding.lower().startswith("utf"):
            return ""
        names = [name for name in names if name.lower() not in text.lower()]
    for name in names:
        for encoding in () if name.isascii() else BY_NAME:
            with suppress(UnicodeDecodeError):
                if name.lower() in content.decode(encoding).lower():
                    do = f"state its encoding, in which it is there, encoding={encoding!r}"
                    return f"Expected the text {name!r}, found none; {do}"
    return ""


def _is_western(text: str) -> bool:
    """Return whether a text that was decoded as Windows-1252 looks right in it.

    It does if at most a quarter of its runs of characters beyond ASCII are odd: longer than two, of
    unusual characters, or a letter beside a mark.
    """
    runs = HIGH.findall(text)
    odd = [
        run
        for run in runs
        if len(run) > 2
        or not USUAL.issuperset(run)
        or (len(run) == 2 and run[0].isalpha() != run[1].isalpha())
    ]
    return len(odd) <= len(runs) / 4


def _advice(content: bytes) -> str:
    """Return advice for an error: up to three encodings that a text may be in, with a line in each.

    The likeliest comes first; "" if there is none.
    """
    scores = dict[str, float]()
    texts = dict[str, str]()
    for encoding, (usual, letters) in OTHERS.items():
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            high = "".join(HIGH.findall(text))
            # Characters that are rare in the script are left out.
            usual_text = high.encode(usual, "ignore").decode(usual)
            scores[encoding] = len(re.findall(letters, usual_text)) / max(len(high), 1)
            first = HIGH.search(text)
            start = text.rfind("\n", 0, first.start() if first else 0) + 1
            texts[encoding] = text[start:].partition("\n")[0].strip()[:SHOWN]
    best = sorted((e for e in scores if scores[e] > 0.5), key=lambda e: -scores[e])[:FEW]
    proposals = [
        f"encoding={encoding!r} if {shortened(texts[encoding])} is right" for encoding in best
    ]
    return f"; state it, {', or '.join(proposals)}" if proposals else ""
