"""Registries of named objects that users can extend, and plugins: the files that extend them."""

import difflib
import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from mi_refgs.errors import InputError, UnknownNameError, abbreviated

T = TypeVar("T")
GROUP = "mi_refgs.plugins"  # entry points of installed packages: modules that register
_loaded: set[str] = set()  # plugins of this process: files, and modules of entry points
_files: dict[tuple[str, str], str] = {}  # kind and name of a user's item: the file that registered it


class Registry(Mapping[str, T], Generic[T]):
    """Objects of one kind by name, in the order of registration, or the newest first.

    Items are objects of a class, `of`, or `classes` of settings below it; `check(item)` raises InputError for
    an unusable one. With a `package`, the first look-up imports it and its modules, which register theirs: a
    module can read a registry whose items are on a floor above it."""

    def __init__(
        self,
        kind: str,  # such as "reflectance model", for messages
        check: Callable[[T], None] = lambda item: None,
        package: str | None = None,
        *,
        of: type[Any] = object,
        classes: bool = False,
        newest_first: bool = False,
    ) -> None:
        self.kind, self._check, self._package = kind, check, package
        self._of, self._classes, self._newest_first = of, classes, newest_first
        self._registered: dict[str, T] = {}

    @property
    def _items(self) -> dict[str, T]:
        if (package := self._package) is not None:
            self._package = None
            for module in pkgutil.iter_modules(getattr(importlib.import_module(package), "__path__", ())):
                importlib.import_module(f"{package}.{module.name}")
        return self._registered

    def register(self, item: T) -> T:
        """Add an item, which is returned. Raises InputError for an item of another kind, without a name, with
        the name of another one, or that `check` refuses."""
        of = self._of
        if self._classes:
            made: Any = (
                isinstance(item, type) and issubclass(item, of) and vars(item).get("__dataclass_params__")
            )
            fits, wanted = made and made.frozen, f"a class below {of.__name__}, a @dataclass(frozen=True)"
        else:
            fits, wanted = isinstance(item, of) and not isinstance(item, type), f"an object of {of.__name__}"
        if not fits:
            raise InputError(f"{abbreviated(item)} cannot be registered", self.kind, remedy=f"give {wanted}")
        name = getattr(item, "name", "")
        if not name or name in self._registered:
            what = f"'{name}': the name is empty or in use"
            raise InputError(what, self.kind, remedy="choose another name")
        self._check(item)
        caller, added = sys._getframe(1).f_globals, {name: item}
        if caller.get("__name__", "").partition(".")[0] != "mi_refgs" and "__file__" in caller:
            _files[self.kind, name] = os.path.abspath(caller["__file__"])
        self._registered = added | self._registered if self._newest_first else self._registered | added
        return item

    def unregister(self, name: str) -> None:
        del self._items[name]
        _files.pop((self.kind, name), None)

    def find(self, name: str, field: str) -> T:
        """Return an item by name; raises UnknownNameError that names `field` and lists the names."""
        if name not in self._items:
            close = difflib.get_close_matches(str(name), self._items, 1)
            guess = f"did you mean {close[0]}? " if close else ""
            remedy = f"{guess}use {' or '.join(self._items)}; or load its file with --plugin"
            raise UnknownNameError(f"{abbreviated(name)} is unknown", field, remedy=remedy)
        return self._items[name]

    def __getitem__(self, name: str) -> T:
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)


def load_plugins(files: str | Path | Sequence[str | Path] = ()) -> None:
    """Run the modules of the entry points GROUP, then one or more Python files, each once in a process: they
    register what they add. Raises InputError for one that is missing or fails."""
    for point in importlib.metadata.entry_points(group=GROUP):
        _load(point.value, point.load, f"entry point {point.value}", "update or remove its package")
    for file in [files] if isinstance(files, str | Path) else files:
        path = os.path.abspath(file)
        if not (path.endswith(".py") and os.path.isfile(path)):
            raise InputError("no such file", path, "--plugin", "give a Python file, NAME.py")
        _load(path, partial(_run_file, path), path, "correct the file")


def _load(key: str, load: Callable[[], object], where: str, remedy: str) -> None:
    if key in _loaded:
        return
    _loaded.add(key)
    try:
        load()
    except Exception as error:
        _loaded.remove(key)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == key]
        line = f"line {lines[-1]}" if lines else None
        if isinstance(error, InputError):
            raise error.at(where, line) from error
        raise InputError(f"{type(error).__name__}: {error}", where, line, remedy) from error


def _run_file(path: str) -> None:
    spec = importlib.util.spec_from_file_location(path, path)
    assert spec is not None and spec.loader is not None
    sys.modules[path] = module = importlib.util.module_from_spec(spec)  # its dataclasses look it up there
    spec.loader.exec_module(module)


def plugin_files() -> list[str]:
    """Files outside the package that registered something in this process."""
    return list(dict.fromkeys(_files.values()))


def plugin_options(files: Sequence[str] | None = None) -> str:
    """Options of a command that load the files, by default those of this process; a space before each."""
    return "".join(f" --plugin {shlex.quote(file)}" for file in (plugin_files() if files is None else files))


def load_again(error: UnknownNameError, files: Sequence[str]) -> UnknownNameError:
    """The error about a name that a run needs; its remedy names the plugins that the fit had loaded."""
    if not files:
        return error
    gone = "".join(f"; {file} is gone" for file in files if not os.path.isfile(file))
    remedy = f"add{plugin_options(files)}, or import it in Python{gone}"
    return UnknownNameError(error.what, error.file, error.field, remedy)
