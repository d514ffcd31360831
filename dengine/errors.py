"""The exception tree: everything dengine raises on purpose derives from `DengineError`."""

from .wording import without_password


class DengineError(Exception):
    """Base of every error that dengine raises on purpose; the passwords of database URLs in its text are masked."""

    def __init__(self, *said: object) -> None:
        super().__init__(*(without_password(each) if isinstance(each, str) else each for each in said))


class TraceError(DengineError, ValueError):
    """A trace of the wrong shape or type: the caller's bug, not the world's fault."""


class SettingError(DengineError, ValueError):
    """A setting (policy, recipe, reducer, cell) outside its range or unknown by name."""


class DataError(DengineError, ValueError):
    """A data set that cannot be read, or whose parts do not fit together."""


class ReportError(DengineError, ValueError):
    """A report that says nothing (no label, no id), on an unknown decision, a second one, or one against the first."""


class StoreError(DengineError, RuntimeError):
    """A store that cannot be opened, belongs to something else, or lost its writer."""


class BusyError(DengineError, RuntimeError):
    """A server that has as much to do as it takes, or is closing: whoever asked goes on without it, and verifies."""


class ExportError(DengineError, RuntimeError):
    """A model that cannot be exported, or an exported file that must not be used."""


class OutputError(DengineError, RuntimeError):
    """A file that cannot be written, or that holds something else than an earlier output of the same kind."""


class CellError(DengineError, RuntimeError):
    """A robot cell that cannot be reached, does not answer in time, or says that it could not do what it was told."""
