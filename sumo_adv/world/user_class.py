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

    Raises:
        UsageError: another form, a module that cannot be imported, no such class.
    """
    module_name, _, class_name = spec.partition(":")
    if not module_name or not class_name:
        raise UsageError(f"The {what} {spec!r} is not of the form 'module:Class'.")
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
    return found


def make_object(what: str, spec: str, parameters: Mapping[str, Any], methods: Mapping[str, str]) -> Any:
    """An object of the class ``module:Class``; ``methods``: name -> how it is called, for the sentence.

    Raises:
        UsageError: as ``find_class``, or it cannot be made, or it lacks a method.
    """
    try:
        made = find_class(what, spec)(**parameters)
    except UsageError:
        raise
    except Exception as error:  # user code: anything may come out of it
        raise UsageError(f"The {what} {spec!r} could not be made: {said(error)}.") from error
    for method in methods:
        if not callable(getattr(made, method, None)):
            raise UsageError(
                f"The {what} {spec!r} has no method {method!r}; it needs {' and '.join(methods.values())}."
            )
    return made


def said(error: Exception) -> str:
    """Exception type and message on one line, without a full stop at the end."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}" if message else type(error).__name__
