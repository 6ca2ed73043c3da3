"""Scaffolding a plug-in file, and running the conformance cases on one."""

from __future__ import annotations

import importlib.util
import keyword
import os
import re
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

from omnibench.config import validate
from omnibench.errors import ConfigError, OmnibenchError, PluginError, require_choice
from omnibench.files import refuse_existing, write_text
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, run_jobs
from omnibench.jobs.job_process import Processes
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import REGISTRIES, Registry, calibrators, costs, effects, importers, registered_from
from omnibench.testing import cases
from omnibench.testing.cases import CaseOutcome, CaseResult, Conformance, load_plugin, run_cases
from omnibench.testing.effect_cases import EffectConformance

PluginKind = Literal["calibrator", "importer", "cost", "effect"]
PLUGIN_KINDS: tuple[PluginKind, ...] = get_args(PluginKind)
_TEMPLATES = files("omnibench.testing") / "plugin_templates"
_SUITES: dict[Registry[Any], type[Conformance]] = {
    calibrators: cases.CalibratorConformance,
    costs: cases.CostConformance,
    effects: EffectConformance,
    importers: cases.ImporterConformance,
}


@dataclass(frozen=True)
class CheckReport:
    """Results of the conformance cases on one plug-in file."""

    path: Path
    results: tuple[CaseResult, ...]

    @property
    def passed(self) -> bool:
        """True if no case failed."""
        return all(result.passed for result in self.results)

    @property
    def failures(self) -> tuple[CaseResult, ...]:
        """The cases that failed."""
        return tuple(result for result in self.results if not result.passed)


def new_plugin(
    name: str, kind: str = "calibrator", folder: Path | str = "plugins", *, force: bool = False
) -> list[Path]:
    """Write a working plug-in ``<name>.py`` and its test ``test_<name>.py`` into ``folder``; return the files written.

    force: replace files that exist. ConfigError: ``kind`` is unknown, ``name`` is no identifier in lower case or is
    taken, or a file exists already. DataError: a file cannot be written.
    """
    require_choice("kind of plug-in", kind, PLUGIN_KINDS)
    if not name.isidentifier() or not name.isascii() or keyword.iskeyword(name) or name != name.lower():
        raise ConfigError(f"{name!r} cannot name a plug-in; use lower-case letters, digits and _, as in my_search")
    if name.startswith(("_", "test_", "conftest")):
        raise ConfigError(f"{name!r} cannot name a plug-in; files that begin with _, test_ or conftest are not loaded")
    targets = {Path(folder) / f"{start}{name}.py": f"{start}{kind}.py.txt" for start in ("", "test_")}
    refuse_existing(*targets, force=force)
    for registry in REGISTRIES:
        for entry in registry.entries() if registry.kind == kind else ():
            if entry.name == name:
                raise ConfigError(f"there is a {kind} {name!r} already ({entry.origin}); choose another name")
    # pytest puts the folder first on Python's path, where the file would hide the module from everyone.
    if importlib.util.find_spec(name) is not None:
        raise ConfigError(f"{name}.py would hide the Python module {name!r}; choose another name")
    texts = {path: (_TEMPLATES / template).read_text(encoding="utf-8") for path, template in targets.items()}
    title = "".join(part.capitalize() for part in name.split("_"))
    if any(re.search(rf"\b{title}\b", text) for text in texts.values()):  # it would hide an import
        title += kind.capitalize()
    for path, text in texts.items():
        write_text(path, Template(text).substitute(name=name, title=title))
    return list(targets)


def check_plugin_apart(path: Path, sample: Path | None = None, seconds: float = 600.0) -> CheckReport:
    """As ``check_plugin``, in a process of its own, which the plug-in may crash, leave or keep for ``seconds`` only.

    PluginError, in one line, names these ends, too, and during what they came.
    """
    watch = _CheckWatch(path)
    job = Job("report", _check_apart, (path.absolute(), sample), seconds)
    with TemporaryDirectory() as folder:
        store = ResultStore(Path(folder), CheckReport)
        run_jobs([job], store, Processes(1, (__name__,)), watch)
    assert watch.report is not None  # run_jobs tells of every end
    return watch.report


class _CheckWatch(JobWatch[CheckReport]):
    """Takes the report of a check, or raises PluginError. stage: what the check is at."""

    def __init__(self, path: Path) -> None:
        self.report: CheckReport | None = None
        self._path, self._stage = path, "it is imported"

    def moved(self, number: int, event: Progress) -> None:  # noqa: ARG002 (there is one job)
        self._stage = event.task

    def ended(self, number: int, ending: CheckReport | Failure, reused: bool) -> None:  # noqa: ARG002
        if isinstance(ending, CheckReport):
            self.report = replace(ending, path=self._path)
        elif isinstance(ending.error, OmnibenchError):
            raise ending.error
        else:
            raise PluginError(f"{self._path}: {ending.reason} while {self._stage}")


def _check_apart(arguments: tuple[Path, Path | None], report: Reporter) -> CheckReport:
    path, sample = arguments
    with redirect_stdout(sys.stderr):  # a plug-in that prints must not spoil the report
        checked = check_plugin(path, sample, report)
    try:
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:  # none that still runs, or for whose end nobody has waited
        return checked
    message = "it started or forked a process that still runs or was not waited for; end what it starts"
    failed = CaseResult("plug-in", path.stem, "it leaves no process behind", CaseOutcome.FAILED, message)
    return replace(checked, results=(*checked.results, failed))


def check_plugin(path: Path | str, sample: Path | str | None = None, watch: Reporter = no_progress) -> CheckReport:
    """Load a plug-in file and run the conformance cases on every class that it registers.

    sample: recordings for an importer; without them only its refusals are tested. watch: told of every case.
    PluginError, in one line: there is no such file, it cannot be imported, or it registers nothing.
    """
    path = Path(path)
    load_plugin(path)
    registered = registered_from(path)
    if not registered:
        raise PluginError(f"{path} registers nothing; decorate a class with @calibrators.register(...), for example")
    source = None if sample is None else Path(sample)
    results: list[CaseResult] = []
    for registry, entry in registered:
        try:
            validate(entry.options, {}, f"{registry.kind} {entry.name!r}")
        except ConfigError as error:
            message = f"{error}; give every option a default, or subclass the conformance class and set options there"
            failed = CaseResult(registry.kind, entry.name, "can be made without options", CaseOutcome.FAILED, message)
            results.append(failed)
            continue
        base = _SUITES.get(registry, Conformance)
        suite = type("Checked", (base,), {"name": entry.name, "registry": registry, "source": source})
        results += run_cases(suite(), watch)
    return CheckReport(path, tuple(results))
