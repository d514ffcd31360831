"""The exception tree: everything dengine raises on purpose derives from `DengineError`."""


class DengineError(Exception):
    """Base of every error that dengine raises on purpose."""


class TraceError(DengineError, ValueError):
    """A trace of the wrong shape or type: the caller's bug, not the world's fault."""


class SettingError(DengineError, ValueError):
    """A setting (policy, recipe, reducer, cell) outside its range or unknown by name."""


class DataError(DengineError, ValueError):
    """A data set that cannot be read, or whose parts do not fit together."""


class ReportError(DengineError, ValueError):
    """A report on an unknown decision, a second report, or one that contradicts the first."""


class StoreError(DengineError, RuntimeError):
    """A store that cannot be opened, belongs to something else, or lost its writer."""


class ExportError(DengineError, RuntimeError):
    """A model that cannot be exported, or an exported file that must not be used."""
