"""Which model versions keep their state, and what a store says of each."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from ..errors import StoreError

KEEP = 5  # newest versions that keep their states


class VersionError(StoreError):
    """A version whose state is not kept, or is damaged; the store itself is well."""


@dataclass(frozen=True, slots=True)
class StoredVersion:
    """A retrain as a store lists it.

    version : its number; of a dropped candidate that of the version which went on answering.  time : in seconds.
    n_bytes : of its state; 0 where none is kept.  kept : whether `load_version` can load it.
    """

    version: int
    time: float
    accepted: bool
    reason: str
    n_bytes: int
    kept: bool


def keeps_state(version: int, newest: int, keep: int | None) -> bool:
    """Say whether a version keeps its state: the first, the `keep` newest (None: all), and of older ones ever fewer.

    Of the newest hundred every tenth, of the newest thousand every hundredth, and so on: what is kept grows with the
    logarithm of what was trained.
    """
    age = newest - version
    if keep is None or version == 1 or age < keep:
        return True
    step = 10
    while age >= 10 * step:
        step *= 10
    return version % step == 0


def check_keep(keep: int | None) -> int | None:
    """Return how many newest versions keep their states, once it is a number that leaves one to fall back on."""
    if keep is not None and (isinstance(keep, bool) or not isinstance(keep, int) or keep < 2):
        raise StoreError(f"Expected keep_versions of 2 or more, or None for all, got {keep!r}; leave it at {KEEP}.")
    return keep


def not_kept(version: int, kept: Collection[int], why: str = "is not kept") -> VersionError:
    """Return the error for a version that cannot be loaded; it names those that can."""
    others = ", ".join(str(each) for each in sorted(set(kept) - {version})) or "none"
    return VersionError(f"Expected a version whose state is held, got {version}, which {why}; load one of these: {others}.")
