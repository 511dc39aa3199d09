"""Let commands take their options in dataclasses, one for each group of related options."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from typing import TYPE_CHECKING, Any, get_type_hints

from sumo_adv.config import Settings

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let typer read a command whose parameters may be groups of options.

    A group is a frozen dataclass. Its fields are options, annotated like parameters of a command. The help lists them
    where the group stands among the parameters.

    Args:
        command: The command.

    Returns:
        The command with a parameter for each field of its groups. It builds the groups before it calls ``command``.
    """
    hints = get_type_hints(command, include_extras=True)
    hints.pop("return", None)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: list[inspect.Parameter] = []
    for name, own in inspect.signature(command).parameters.items():
        if name in groups:
            parameters += _parameters(groups[name])
        else:
            parameters.append(_parameter(name, hints[name], own.default))

    @wraps(command)
    def with_groups(**values: Any) -> None:
        built = {name: group(**{f.name: values.pop(f.name) for f in fields(group)}) for name, group in groups.items()}
        command(**built, **values)

    with_groups.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_groups.__annotations__ = {each.name: each.annotation for each in parameters}
    return with_groups


def named_settings(*groups: DataclassInstance) -> dict[str, Any]:
    """Return the settings that the user gave as options.

    Args:
        *groups: Groups of options. A field is a setting if it has the name of one.

    Returns:
        The value of each setting whose option was given.
    """
    values = {f.name: getattr(group, f.name) for group in groups for f in fields(group)}
    return {name: value for name, value in values.items() if name in Settings.model_fields and value is not None}


def _parameters(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        _parameter(f.name, hints[f.name], inspect.Parameter.empty if f.default is MISSING else f.default)
        for f in fields(group)
    ]


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
