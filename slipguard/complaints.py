"""A pydantic complaint as one line a person can act on: key, value, what is allowed."""

from __future__ import annotations

import difflib
from typing import Any

from pydantic import ValidationError


def first_complaint(error: ValidationError) -> str:
    """The first problem of a validation error; how many more there are is said at the end."""
    problems = error.errors(include_url=False)
    more = f" ({len(problems) - 1} more after this one)" if len(problems) > 1 else ""
    return _one(problems[0]) + more


def _one(problem: Any) -> str:
    key = ".".join(str(part) for part in problem["loc"]) or "the file"
    kind, context, given = problem["type"], problem.get("ctx", {}), problem["input"]
    if kind == "extra_forbidden":
        return f"{key}: no such key; see the commented config.toml for those there are"
    if kind == "missing":
        return f"{key}: missing; it must be given"
    if kind in ("value_error", "assertion_error"):
        return f"{key} = {given!r}: {context.get('error', problem['msg'])}"
    return f"{key} = {given!r}: {problem['msg'][0].lower()}{problem['msg'][1:]}"


def closest(name: str, choices: list[str]) -> str:
    """`; did you mean 'x'?` for the nearest choice, or an empty string."""
    near = difflib.get_close_matches(name, choices, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
