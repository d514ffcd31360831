"""Importing a class of the user, a reducer or a decision rule, by its name `module:Class`.
`Policy` and `make_reducer` call `import_class`.
"""

from pkgutil import resolve_name

from .errors import SettingError, instead, shortened


def import_class(path: str) -> type:
    """Import the class that `path`, a text `module:Class`, names, and return it.

    The module is imported, which runs its code. A text `module.Class` is accepted, too.

    Raises
    ------
    SettingError
        If `path` has another form, or the module cannot be imported, whatever subclass of Exception
        it raises, or has no class of that name. A SettingError that the module raises passes
        unchanged.
    """
    with instead(
        SettingError,
        f"Expected module:Class that can be imported here, got {shortened(path)}",
        Exception,
    ):
        value = resolve_name(path)
    if not isinstance(value, type):
        raise SettingError(
            f"Expected module:Class, {shortened(path)} is a {type(value).__name__} and no class."
        )
    return value
