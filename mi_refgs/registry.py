"""A registry of named objects that users can extend: reflectance models, primitives, attributes, formats."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from typing import Generic, Protocol, TypeVar

from mi_refgs.errors import InputError, UnknownNameError, abbreviated


class Named(Protocol):
    """An item of a registry; its name is unique there."""

    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=Named)


class Registry(Mapping[str, T], Generic[T]):
    """Objects of one kind by name, in the order of registration.

    `check(item)` raises InputError for an unusable item. With a `package`, the first look-up imports its
    modules, which register theirs: a module can read a registry whose items are on a floor above it.
    """

    def __init__(
        self, kind: str, check: Callable[[T], None] = lambda item: None, package: str | None = None
    ) -> None:
        self.kind = kind  # such as "reflectance model", for messages
        self._check = check
        self._package = package
        self._registered: dict[str, T] = {}

    @property
    def _items(self) -> dict[str, T]:
        if (package := self._package) is not None:
            self._package = None
            for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
                importlib.import_module(f"{package}.{module.name}")
        return self._registered

    def register(self, item: T, first: bool = False) -> T:
        """Add an item, which is returned; `first`: before the others.

        Raises InputError for an item without a name, with the name of another one, or that `check` refuses.
        """
        name = getattr(item, "name", "")
        if not name or name in self._registered:
            what = f"'{name}': the name is empty or in use"
            raise InputError(what, self.kind, remedy="choose another name")
        self._check(item)
        added = {name: item}
        self._registered = added | self._registered if first else self._registered | added
        return item

    def unregister(self, name: str) -> None:
        del self._items[name]

    def find(self, name: str, field: str) -> T:
        """Return an item by name; raises UnknownNameError that names `field` and lists the names."""
        if name not in self._items:
            remedy = f"use {' or '.join(self._items)}; or register it first"
            raise UnknownNameError(f"{abbreviated(name)} is unknown", field, remedy=remedy)
        return self._items[name]

    def __getitem__(self, name: str) -> T:
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)
