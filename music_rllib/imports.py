"""Modules that take long to import, and that most processes never use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["imported_on_use"]


class _ImportedOnUse:
    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)


def imported_on_use(name: str) -> Any:
    """Return a stand-in for a module, which is imported when an attribute is first read."""
    return _ImportedOnUse(name)
