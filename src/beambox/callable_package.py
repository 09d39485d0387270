"""Packages that have the name of a verb: ``beambox.train(...)`` trains, ``beambox.train.loop`` is a module in it.

Importing a module of a package binds the package's name in its parent. A function of the same name would be a function
or a package by what was imported before; so the package itself can be called.
"""

from __future__ import annotations

import inspect
import sys
from importlib import import_module
from types import ModuleType
from typing import Any

__all__ = ["make_callable"]


class _CallablePackage(ModuleType):
    """A package whose call is that of a function elsewhere, which is imported when it is called."""

    def _verb(self) -> Any:
        return getattr(import_module("beambox.verbs"), self.__name__.rpartition(".")[2])

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._verb()(*args, **kwargs)

    @property
    def __signature__(self) -> inspect.Signature:
        return inspect.signature(self._verb())


def make_callable(name: str) -> None:
    """Let a package be called as the function of its name in :mod:`beambox.verbs`; ``name`` is its ``__name__``."""
    sys.modules[name].__class__ = _CallablePackage
