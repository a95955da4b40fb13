"""A JSON file of options, such as the `best.json` of `tune-worldmodel` or the `config.json` of a run."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from envs.errors import UsageError

Options = TypeVar("Options")


def read_config(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        UsageError: there is no such file, or something else is in it.
    """
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--config {path} cannot be read ({error}); give a JSON file of options such as best.json"
        ) from error
    if not isinstance(values, dict):
        raise UsageError(f"--config {path} holds no JSON object; give options by name, as in best.json")
    return values


def changed(options: Options, values: dict[str, Any], where: object) -> Options:
    """Options with some of their values changed.

    Args:
        options: a dataclass, of others where they have groups.
        values: new values by name, a dictionary for a group; all that it does not name stays.
        where: the file that they come from.

    Raises:
        UsageError: a name that is no option, or a value that cannot be one.
    """
    hints = get_type_hints(type(options))
    known = {field.name for field in fields(options)} - {"out", "config"}  # type: ignore[arg-type]
    new = {}
    for name, value in values.items():
        if name not in known:
            raise UsageError(f"--config {where} has '{name}', which is no option; there are {', '.join(sorted(known))}")
        before = getattr(options, name)
        if is_dataclass(before):
            if not isinstance(value, dict):
                raise UsageError(f"--config {where} has {name} = {value!r}; give a JSON object of its options")
            new[name] = changed(before, value, where)
            continue
        try:
            new[name] = _as(hints[name], value)
        except (TypeError, ValueError):
            raise UsageError(f"--config {where} has {name} = {value!r}; give {_describe(hints[name])}") from None
    return replace(options, **new)  # type: ignore[type-var]


def _as(hint: Any, value: Any) -> Any:
    """What JSON says as the type that is asked for; TypeError or ValueError where it is none."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None and NoneType in arguments:
            return None
        return _as(next(kind for kind in arguments if kind is not NoneType), value)
    if origin is Literal:
        if value not in arguments or isinstance(value, bool):
            raise ValueError
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise TypeError
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_as(kind, item) for kind, item in zip(kinds, value, strict=True))
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(value) is hint:
        return value
    raise TypeError


def _describe(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return "one of " + ", ".join(json.dumps(choice) for choice in get_args(hint))
    if get_origin(hint) is tuple:
        return "a list, as config.json of a run has it"
    return {float: "a number", int: "a whole number", bool: "true or false"}.get(hint, "a string")
