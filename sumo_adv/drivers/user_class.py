"""Loading a user's own class, named ``module:Class``: a driver, or a generator for the benchmark."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError


def find_class(what: str, spec: str) -> type:
    """The class ``module:Class``, found on ``sys.path`` or in the current folder; ``what`` names it in sentences.

    Python's standard library is refused before anything is imported: no driver lives there, and its classes do things
    as they are made (``subprocess:Popen`` starts a program).

    Raises:
        UsageError: another form, a class of the standard library, a module that cannot be imported, no such class.
    """
    module_name, _, class_name = spec.partition(":")
    if not module_name or not class_name:
        raise UsageError(f"The {what} {spec!r} is not of the form 'module:Class'.")
    if _is_pythons_own(module_name):
        raise _not_yours(what, spec)
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # last, so that nothing of the user's shadows an installed package
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # user code runs on import
        raise UsageError(
            f"The module of the {what} {spec!r} could not be imported from {here} or Python's path: {said(error)}."
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UsageError(f"The module {module_name!r} has no class {class_name!r} for the {what} {spec!r}.")
    if _is_pythons_own(found.__module__):  # a module of the user's may have imported one
        raise _not_yours(what, spec)
    return found


def _is_pythons_own(module_name: str) -> bool:
    """Whether the module belongs to Python's standard library; a script that runs as ``__main__`` does not."""
    top = module_name.partition(".")[0]
    return top != "__main__" and (top in sys.stdlib_module_names or top in sys.builtin_module_names)


def _not_yours(what: str, spec: str) -> UsageError:
    return UsageError(f"The {what} {spec!r} is a class of Python's standard library: name a class of your own.")


def make_object(what: str, spec: str, parameters: Mapping[str, Any], methods: Mapping[str, str]) -> Any:
    """An object of the class ``module:Class``; ``methods``: name -> how it is called, for the sentence.

    The class is checked for its methods before an object is made, so that a class of another kind is never run.

    Raises:
        UsageError: as ``find_class``, or the class lacks a method, or the object cannot be made.
    """
    found = find_class(what, spec)
    for method in methods:
        if not callable(getattr(found, method, None)):
            raise UsageError(
                f"The {what} {spec!r} has no method {method!r}; it needs {' and '.join(methods.values())}."
            )
    try:
        return found(**parameters)
    except Exception as error:  # user code: anything may come out of it
        raise UsageError(f"The {what} {spec!r} could not be made: {said(error)}.") from error


def said(error: Exception) -> str:
    """Exception type and message on one line, without a full stop at the end."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}" if message else type(error).__name__
