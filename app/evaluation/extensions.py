"""Methods, tasks, faults and protocols from outside the package: a Python file, or an installed package.

A plugin is anything with a function `register(registry)`. It is found in two ways, and then treated alike:

1. `reins evaluate --plugin FILE.py`: the file is imported, its `register` is called;
2. an installed package names a function under the entry point group `reins.evaluation`.

Every process of a campaign loads the same plugins before it runs anything, and the digests of the files are part of the
campaign's configuration: rows made with another version of a plugin never end up in the same folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar, cast

from app.evaluation.methods import ABLATIONS, METHODS, Method
from app.evaluation.model import CAPABILITIES, TASKS, Task, Violation

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from app.governance.model import Json

GROUP: Final = "reins.evaluation"
ALL: Final = "all"
FAULT: Final = "fault-"
"""Trials of a plugin's fault are asked for like a task, by this and the fault's name."""

_T = TypeVar("_T")


class UnknownName(ValueError):
    """A name that nobody has registered."""

    def __init__(self, what: str, name: str, valid: Sequence[str]) -> None:
        """Name what was asked for, and what there is."""
        self.name = name
        super().__init__(f"no {what} `{name}`: valid are {', '.join(valid)}")


class PluginError(Exception):
    """A plugin that cannot be used."""


class ExtraFault(NamedTuple):
    """A physical fault from outside.

    Attributes:
        name: What rows and report call it.
        violation: Which of the six violations it provokes; truth is judged by that one's measure.
        draw: Takes a seeded generator and a size in units of the limit (1.15 to 1.85), and returns a fault as plain
            data, as `app.sim.faults.Fault.read` takes it: `{kind, at, …sizes}`. A time in `at` counts from the launch.
        capabilities: Which capabilities it can befall.
    """

    name: str
    violation: Violation
    draw: Callable[[np.random.Generator, float], Mapping[str, Json]]
    capabilities: tuple[str, ...]


class Registry:
    """What plugins add. A name is given once: nothing shadows a method or a task of the paper's."""

    def __init__(self) -> None:
        """Start with nothing but what the package has itself."""
        self.methods: dict[str, Method] = {}
        self.tasks: dict[str, Task] = {}
        self.faults: dict[str, ExtraFault] = {}
        self.protocols: dict[str, object] = {}

    def add_method(self, method: Method) -> None:
        """Add a method: which parts of governance there are, as data.

        Raises:
            PluginError: the name is taken.
        """
        _add("method", self.methods, {**METHODS, **ABLATIONS}, method.name, method)

    def add_task(self, task: Task) -> None:
        """Add a task type.

        Raises:
            PluginError: the name is taken or means something else, or one of its parts is no capability.
        """
        if task.name == ALL or task.name.startswith(FAULT):
            raise PluginError(f"task `{task.name}`: valid are names other than `{ALL}`, without `{FAULT}` before them")
        _check_capabilities("task", task.name, task.capabilities)
        _add("task", self.tasks, TASKS, task.name, task)

    def add_fault(self, fault: ExtraFault) -> None:
        """Add a physical fault.

        Raises:
            PluginError: the name is taken, or it befalls what is no capability.
        """
        _check_capabilities("fault", fault.name, fault.capabilities)
        _add("fault", self.faults, {}, fault.name, fault)

    def add_protocol(self, name: str, protocol: object) -> None:
        """Add a protocol: an object with `jobs`, `run` and `results`.

        Raises:
            PluginError: the name is taken, or one of the three is missing.
        """
        missing = [part for part in ("jobs", "run", "results") if not callable(getattr(protocol, part, None))]
        if missing:
            raise PluginError(
                f"protocol `{name}` lacks `{', '.join(missing)}`: valid are objects with jobs, run, results"
            )
        _add("protocol", self.protocols, dict.fromkeys(("paper", "physical")), name, protocol)


REGISTRY: Final = Registry()
"""What this process knows beyond the package."""

_loaded: set[str] = set()


def load_plugins(files: Sequence[Path]) -> None:
    """Load installed plugins and those files into `REGISTRY`; once each, however often it is called.

    Raises:
        PluginError: a plugin cannot be imported, has no `register`, raised, or takes a name that is taken.
    """
    for name, get in _sources(files):
        if name not in _loaded:
            try:
                get()(REGISTRY)
            except PluginError:
                raise
            except Exception as error:
                raise PluginError(f"plugin `{name}` failed: {type(error).__name__}: {error}") from error
            _loaded.add(name)


def plugin_digests(files: Sequence[Path]) -> dict[str, str]:
    """Return what identifies the plugins of a campaign: file name → SHA-256, entry point → version of its package.

    Of several with one name, each is told, in the order in which they are given.
    """
    found = [(file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in files]
    for point in entry_points(group=GROUP):
        found.append((point.name, f"{point.value} {point.dist.version if point.dist else ''}".strip()))
    digests: dict[str, str] = {}
    for name, digest in found:
        digests[name] = f"{digests[name]} {digest}" if name in digests else digest
    return dict(sorted(digests.items()))


def all_methods() -> dict[str, Method]:
    """Return every method, ablation and method of a plugin by name, in the order of the tables."""
    return {**METHODS, **ABLATIONS, **REGISTRY.methods}


def all_tasks() -> dict[str, Task]:
    """Return every task type by name, those of plugins last."""
    return {**TASKS, **REGISTRY.tasks}


def find_method(name: str) -> Method:
    """Return a method, an ablation, or a method of a plugin.

    Raises:
        UnknownName: there is none of that name.
    """
    return _find("method", all_methods(), name)


def find_task(name: str) -> Task:
    """Return a task type.

    Raises:
        UnknownName: there is none of that name.
    """
    return _find("task", all_tasks(), name)


def find_fault(name: str) -> ExtraFault:
    """Return a plugin's fault by the name that its trials are asked for, `fault-NAME`.

    Raises:
        UnknownName: there is none of that name.
    """
    known = {f"{FAULT}{fault}": one for fault, one in REGISTRY.faults.items()}
    if not known:
        raise UnknownName("fault", name, ("none, as no plugin has registered any",))
    return _find("fault", known, name)


def _find(what: str, known: Mapping[str, _T], name: str) -> _T:
    if name not in known:
        raise UnknownName(what, name, tuple(known))
    return known[name]


def _add(what: str, mine: dict[str, _T], taken: Mapping[str, object], name: str, value: _T) -> None:
    if name in mine or name in taken:
        raise PluginError(f"there is a {what} `{name}` already: valid is a name of its own")
    mine[name] = value


def _check_capabilities(what: str, name: str, capabilities: Sequence[str]) -> None:
    unknown = [one for one in capabilities if one not in CAPABILITIES]
    if unknown or not capabilities:
        wrong = ", ".join(unknown) or "nothing"
        raise PluginError(f"{what} `{name}` names as capabilities `{wrong}`: valid are {', '.join(CAPABILITIES)}")


def _sources(files: Sequence[Path]) -> Iterator[tuple[str, Callable[[], Callable[[Registry], None]]]]:
    for point in sorted(entry_points(group=GROUP)):
        yield f"{point.name} ({point.value})", point.load
    for file in files:
        yield str(file), lambda file=file: _register_of(file)


def _register_of(file: Path) -> Callable[[Registry], None]:
    spec = spec_from_file_location(f"reins_plugin_{file.stem}", file)
    if not file.is_file() or spec is None or spec.loader is None:
        raise PluginError(f"plugin `{file}` cannot be read: valid is a Python file")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    register = getattr(module, "register", None)
    if not callable(register):
        raise PluginError(f"plugin `{file}` has no function `register(registry)`")
    return cast("Callable[[Registry], None]", register)
