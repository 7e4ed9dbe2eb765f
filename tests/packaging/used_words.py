"""Which words stand together in one statement of a test: how a command and its options are found in it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path


@cache
def statements(file: Path) -> tuple[frozenset[str], ...]:
    """The strings of every statement, those of the names in it included; docstrings are none."""
    tree = ast.parse(file.read_text())
    named: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                for name in ast.walk(target):
                    if isinstance(name, ast.Name):
                        named.setdefault(name.id, set()).update(_strings(node.value))
    return tuple(frozenset(_with_names(one, named)) for one in _simple(tree))


def together(file: Path, *words: str) -> bool:
    """Whether one statement has them all."""
    return any(set(words) <= one for one in statements(file))


def _simple(tree: ast.AST) -> Iterator[ast.AST]:
    """Statements without others in them, and the heads of those with."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue
        if isinstance(node, (ast.With, ast.AsyncWith)):
            yield from node.items
        elif isinstance(node, (ast.If, ast.While)):
            yield node.test
        elif isinstance(node, (ast.For, ast.AsyncFor)):
            yield node.iter
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from node.decorator_list
        elif isinstance(node, ast.stmt) and not hasattr(node, "body"):
            yield node


def _strings(node: ast.AST) -> set[str]:
    return {one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str)}


def _with_names(node: ast.AST, named: dict[str, set[str]]) -> set[str]:
    found = _strings(node)
    for one in ast.walk(node):
        if isinstance(one, ast.Name):
            found |= named.get(one.id, set())
    return {word for text in found for word in (text, *text.split())}
