"""Signatures: whether a file comes from who has the key, found out before a byte of it is run.

    dengine make-key cell.key
    dengine export engine.db --out model.ts --key cell.key          # model.ts.sig beside it
    load_exported("model.ts", key="cell.key")

HMAC-SHA256 (FIPS 198-1) with a secret that both sides have: it is symmetric, so whoever can check a signature can make
one. Keep the key's file where only the exporter and the controller read it. An earlier file that was signed with the same
key is as valid as the newest one.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from ..errors import ExportError

PREFIX = "hmac-sha256:"
SHORTEST_KEY = 16  # bytes
KEY_BYTES = 32

KeyFile = str | os.PathLike[str]


def make_key(path: KeyFile) -> Path:
    """Write a new random key, 64 hexadecimal digits, to a file that is not there yet and that only its owner reads.

    ExportError where there is a file already: models were signed with it.
    """
    target = Path(path)
    try:
        descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise ExportError(f"{target} is there already, and files may be signed with it; name a new one.") from error
    except OSError as error:
        raise _unwritable(target, error) from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(secrets.token_hex(KEY_BYTES) + "\n")
        file.flush()
        os.fsync(file.fileno())
    return target


def _unwritable(target: Path, error: OSError) -> ExportError:
    return ExportError(f"Cannot write {target}: {error.strerror}; choose a folder that exists and is writable.")


def read_key(path: KeyFile) -> bytes:
    """The secret in a key's file, without the line end; ExportError for what is too short to be one."""
    try:
        key = Path(path).read_bytes().rstrip(b"\r\n")
    except OSError as error:
        raise ExportError(
            f"The key's file {path} cannot be read: {error.strerror}; dengine make-key writes one."
        ) from error
    if len(key) < SHORTEST_KEY:
        raise ExportError(
            f"Expected a key of {SHORTEST_KEY} bytes or more in {path}, got {len(key)}; use dengine make-key."
        )
    return key


def signature_file(path: Path) -> Path:
    """Where the signature lies."""
    return path.with_name(path.name + ".sig")


def signature(content: bytes, key: bytes) -> str:
    """What a signature's line begins with."""
    return PREFIX + hmac.new(key, content, hashlib.sha256).hexdigest()


def listed(text: str, name: str) -> list[str]:
    """The first words of the lines that are about a file, or about none in particular.

    Two while a file is being replaced: the earlier one and the next. A file that was renamed together with its one line is
    still known by it.
    """
    found: list[str] = []
    others: list[str] = []
    for line in text.splitlines():
        word, _, about = line.strip().partition(" ")
        if word:
            (found if about.lstrip(" *") in ("", name) else others).append(word)
    return others if not found and len(others) == 1 else found


def check_signature(path: Path, content: bytes, key: KeyFile) -> None:
    """ExportError unless the content was signed with this key."""
    found = signature(content, read_key(key))
    try:
        known = listed(signature_file(path).read_text(encoding="utf-8"), path.name)
    except FileNotFoundError as error:
        raise ExportError(
            f"A key was given, and {path} is not signed: {error.filename} is missing; export it anew with it."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ExportError(f"The signature of {path} cannot be read: {error}.") from error
    if not any(hmac.compare_digest(each.encode(), found.encode()) for each in known):
        raise ExportError(f"{path} has no signature by the key in {key}: it was changed, or signed with another one.")


def write_signatures(path: Path, signatures: Sequence[str]) -> None:
    """One line each, all at once."""
    target = signature_file(path)
    partial = target.with_name(f"{target.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("x", encoding="utf-8") as file:
            file.writelines(f"{each}  {path.name}\n" for each in signatures)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        partial.unlink(missing_ok=True)


def earlier_signatures(path: Path) -> list[str]:
    """The signatures that may hold for the file that is there. ExportError for a file of that name that is none of ours."""
    known = signature_file(path)
    try:
        found = listed(known.read_text(encoding="utf-8"), path.name)
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError):
        found = [""]
    if not all(each.startswith(PREFIX) for each in found):
        raise ExportError(f"{known} is no signature of dengine's and would be replaced; move it away.")
    return found
