"""One registry for everything that can be named in a config: calibrators, effects, costs and importers.

A registered class carries a pydantic ``Options`` model and takes a validated instance of it as its only argument.
Built-in classes register when their module is imported; plug-ins do the same from a file or from an installed package.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict

from omnibench.config import Model, validate
from omnibench.errors import OmnibenchError, PluginError, require_choice
from omnibench.files import check_file

_MOST_BYTES = 1 << 24  # bytes: a larger plug-in file is refused; chosen
_IMPORT_SECONDS = 60.0  # in which a plug-in file must be imported, whatever command loads it; chosen: JAX takes 10 s

_FILE_MODULE = "omnibench_plugin_"  # begins the names of modules that are plug-in files

# Modules that hold today what plug-ins import from those beside them, which have gone.
_MOVED = {
    "omnibench.data.clock_matching": ("data.alignment",),
    "omnibench.data.importers.tum": ("data.importers.orientation",),
    "omnibench.data.recording": ("data.importers.recording_options", "data.importers.robot_option"),
    "omnibench.fit.article_methods": ("fit.differential", "fit.differential.axle", "fit.differential.driven_squares"),
    "omnibench.fit.motion_windows": ("fit.observations.motion_windows",),
    "omnibench.fit.calibrators.closed_form": ("fit.shrinkage.shrunk_matrix",),
    "omnibench.fit.uncertainty": ("fit.uncertainty.uncertainty",),
    "omnibench.robot.corrections": ("robot.domain.fade", "robot.domain.training_domain"),
    "omnibench.robot.effects.effect": ("robot.effects.weights",),
    "omnibench.robot.effects.learned": ("robot.effects.learned.network",),
    "omnibench.robot.kinematics": ("robot.planar", "robot.robot_class"),
}

T = TypeVar("T")
C = TypeVar("C", bound=type[Any])


class Options(Model):
    """Base of every ``Options`` model: unknown keys are refused, instances are immutable."""


class AnyOptions(BaseModel):
    """Options of a class that could not be loaded; any key is kept."""

    model_config = ConfigDict(extra="allow", frozen=True)


@dataclass(frozen=True)
class Entry(Generic[T]):
    """A registered class and where it comes from."""

    name: str
    cls: type[T]
    origin: str

    @property
    def summary(self) -> str:
        """First paragraph of the class's docstring."""
        return " ".join((inspect.getdoc(self.cls) or "").split("\n\n", 1)[0].replace("``", "").split())

    @property
    def options(self) -> type[BaseModel]:
        """The pydantic model of the class's options."""
        model = getattr(self.cls, "Options", Options)
        assert issubclass(model, BaseModel)
        return model


@dataclass(frozen=True)
class PluginFailure:
    """A plug-in that could not be loaded, and why, in one line."""

    origin: str
    error: str


class Registry(Generic[T]):
    """Registered classes of one kind by name.

    ``builtin`` is the package whose modules register the built-in ones; it is imported on the first look-up.
    """

    def __init__(self, kind: str, builtin: str) -> None:
        self.kind = kind
        self.group = f"omnibench.{kind}s"
        self.contract: type = object  # base class of all its classes; set by the module that defines it
        self._builtin = builtin
        self._entries: dict[str, Entry[T]] = {}
        self._former: dict[str, str] = {}  # name that it had -> name
        self._complete = False

    def register(self, name: str, former: Sequence[str] = ()) -> Callable[[C], C]:
        """Class decorator: make the class known as ``name``, and by the names that it or its forerunners had.

        Raises PluginError when the name is taken by another class, or the class does not keep the contract.
        """

        def decorate(cls: C) -> C:
            registered = self._entries.get(name)
            if registered is not None and registered.cls is not cls:
                raise PluginError(f"{self.kind} {name!r} is registered already, by {registered.origin}; rename it")
            if self.contract not in cls.__mro__:
                raise PluginError(f"{self.kind} {name!r}: the class must derive from {self.contract.__name__}")
            options = getattr(cls, "Options", Options)
            if not (isinstance(options, type) and issubclass(options, BaseModel)):
                raise PluginError(f"{self.kind} {name!r}: Options must be a class derived from omnibench's Options")
            origin = cls.__module__
            file = getattr(sys.modules.get(origin), "__file__", None)
            if origin.startswith("omnibench."):
                origin = "built in"
            elif file and origin.startswith(_FILE_MODULE):
                origin = str(Path(file).resolve())
            cls.name = name
            self._entries[name] = Entry(name, cls, origin)
            self._former |= dict.fromkeys(former, name)
            return cls

        return decorate

    def entries(self) -> list[Entry[T]]:
        """Everything registered, by name."""
        self._load_builtin()
        return [self._entries[name] for name in sorted(self._entries)]

    def entry(self, name: str, where: str = "") -> Entry[T]:
        """The entry called ``name``; UnknownNameError names the nearest one and lists all.

        A FutureWarning says the new name of one that has been renamed.
        """
        self._load_builtin()
        if (new := self._former.get(name)) is not None:
            warnings.warn(f"{self.kind} {name} is now called {new}", FutureWarning, stacklevel=2)
            name = new
        require_choice(self.kind, name, self._entries, where)
        return self._entries[name]

    def create(self, name: str, options: Mapping[str, Any] | None = None, where: str = "") -> T:
        """An instance of the class called ``name`` with validated ``options``. PluginError when it cannot be made."""
        entry = self.entry(name, where)
        place = f"{where}: {self.kind} {name!r}" if where else f"{self.kind} {name!r}"
        validated = validate(entry.options, options or {}, place)
        make: Any = entry.cls
        try:
            return make(validated)
        except OmnibenchError:
            raise
        except Exception as error:  # a plug-in may raise anything
            raise PluginError(f"{place} cannot be made: {type(error).__name__}: {error}") from error

    def _load_builtin(self) -> None:
        if self._complete:
            return
        self._complete = True
        package = importlib.import_module(self._builtin)
        for module in pkgutil.iter_modules(getattr(package, "__path__", ()), f"{self._builtin}."):
            importlib.import_module(module.name)


calibrators: Registry[Any] = Registry("calibrator", "omnibench.fit.calibrators")
costs: Registry[Any] = Registry("cost", "omnibench.fit.cost")
effects: Registry[Any] = Registry("effect", "omnibench.robot.effects")
importers: Registry[Any] = Registry("importer", "omnibench.data.importers")
REGISTRIES: tuple[Registry[Any], ...] = (calibrators, costs, effects, importers)

_loaded: dict[Path, PluginFailure | None] = {}
_copies: dict[Path, Path] = {}  # of plug-in files that another machine sent, by their paths there


def load_plugins(folders: Path | str | Iterable[Path | str] = (), installed: bool = True) -> list[PluginFailure]:
    """Load every plug-in of the folders (``*.py``, without tests) and of the installed packages' entry points.

    A plug-in that fails is returned with its error and the others are loaded. PluginError: a folder is missing.
    """
    failures: list[PluginFailure | None] = []
    for folder in map(Path, [folders] if isinstance(folders, str | Path) else folders):
        failures += [load_plugin_file(path) for path in _files_in(folder)]
    if installed:
        points = [point for registry in REGISTRIES for point in entry_points(group=registry.group)]
        failures += [_attempt(f"{point.group}: {point.value}", point.load) for point in points]
    return [failure for failure in failures if failure is not None]


def load_plugin_file(path: Path) -> PluginFailure | None:
    """Import one plug-in file, once a process; returns the failure, None if it was imported."""
    path = path if path in _copies else path.resolve()
    if path not in _loaded:
        _loaded[path] = _attempt(str(path), lambda: _import_file(path))
    return _loaded[path]


def loaded_plugin_files() -> dict[Path, PluginFailure | None]:
    """The plug-in files that this process has tried to import, with their failures."""
    return dict(_loaded)


def import_copies(copies: Mapping[Path, Path]) -> list[PluginFailure]:
    """Import plug-in files of another machine from their copies here, by the names that they have there.

    Loading their folders finds them, whether or not the folders are here. Returns the failures of those that fail.
    """
    _copies.update(copies)
    return [failure for path in copies if (failure := load_plugin_file(path)) is not None]


def plugin_text(path: Path) -> str:
    """The text of a plug-in file, empty if there is none."""
    file = _copies.get(path, path)
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""


def registered_from(path: Path) -> list[tuple[Registry[Any], Entry[Any]]]:
    """Entries that the file at ``path`` registered, each with its registry."""
    origin = str(path.resolve())
    return [(registry, entry) for registry in REGISTRIES for entry in registry.entries() if entry.origin == origin]


def _files_in(folder: Path) -> list[Path]:
    """The plug-in files of a folder; of one that another machine has, those that it sent."""
    if copied := [path for path in _copies if path.parent in (folder, folder.resolve())]:
        return sorted(copied)
    if folder.suffix == ".py" and (folder.is_file() or folder in _copies):  # one that a comparison adds
        return [folder]
    if folder.is_file():
        raise PluginError(f"plug-in folder {folder} is a file; name the folder that it lies in with --plugins")
    if not folder.is_dir():
        raise PluginError(f"plug-in folder {folder} does not exist; make it or name another with --plugins")
    return [path for path in sorted(folder.glob("*.py")) if not path.name.startswith(("test_", "_", "conftest"))]


def _attempt(origin: str, load: Callable[[], object]) -> PluginFailure | None:
    for registry in REGISTRIES:  # first, so that no plug-in takes a built-in name unnoticed
        registry._load_builtin()
    for today, gone in _MOVED.items():
        for name in gone:
            module = ModuleType(f"omnibench.{name}")
            module.__getattr__ = partial(_found_today, today)  # type: ignore[method-assign]
            sys.modules.setdefault(module.__name__, module)
    before = [dict(registry._entries) for registry in REGISTRIES]
    try:
        load()
    except (Exception, SystemExit) as error:  # a plug-in may raise anything while it is imported
        for registry, entries in zip(REGISTRIES, before, strict=True):
            registry._entries = entries
        return PluginFailure(origin, " ".join(f"{type(error).__name__}: {error}".split()))
    return None


def _found_today(module: str, name: str) -> Any:
    if name.startswith("__"):  # what tools ask of every module
        raise AttributeError(name)
    return getattr(importlib.import_module(module), name)


def _import_file(path: Path) -> None:
    check_file(_copies.get(path, path), _MOST_BYTES, text=True)
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:8]
    name = f"{_FILE_MODULE}{path.stem}_{digest}"
    spec = importlib.util.spec_from_file_location(name, _copies.get(path, path))
    if spec is None or spec.loader is None:
        raise PluginError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    with _limited_time(path):
        spec.loader.exec_module(module)


@contextmanager
def _limited_time(path: Path) -> Iterator[None]:
    """PluginError: the block takes longer than an import may. Without a limit in other threads than the main one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def over(number: int, frame: object) -> None:  # noqa: ARG001 (a handler of signals)
        raise PluginError(f"{path}: is not imported within {_IMPORT_SECONDS:g} s; what takes long belongs in a method")

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, _IMPORT_SECONDS, 1.0)  # again if the file catches it
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
