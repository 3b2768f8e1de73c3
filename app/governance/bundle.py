"""Loads a policy directory into a `PolicySet`, or says everything that is wrong with it.

```
policies/
├── capabilities/*.yaml    one manifest each
├── profiles/*.yaml        E: one environment profile each
├── organization.yaml      O: rules of every profile, agents and their permissions
├── authority.yaml         H: what every profile shares
├── site.yaml              everything in the workshop that has a name
├── properties.yaml        what is promised of all this and proved by `reins policy check`; no part of the policy, nor
│                          of its digest: it decides nothing
└── tests/*.yaml           cases for `reins policy test`; likewise
```

1. `read_files` reads text; `load_files` works on text alone, so that a cell gets the same policy set over the link.
2. Every file is parsed and fitted into its shape; then everything that fits is checked against everything else.
3. All problems are reported together; with one problem nothing is loaded. What a file that does not fit may declare is
   taken to exist, so that nothing is called unknown for another file's fault.
4. What is sound is built and compiled; the digest is SHA-256 over every (path, bytes), in order of path.
"""

from __future__ import annotations

import hashlib
import stat
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

from app.governance import bundle_build, bundle_checks, bundle_checks_profile, bundle_checks_site, bundle_shapes
from app.governance.bundle_checks import Known
from app.governance.bundle_fit import fit
from app.governance.bundle_yaml import Reader, parse, turned
from app.governance.conditions import TESTS
from app.governance.control import TAKEOVER
from app.governance.errors import ExpressionError, PolicyError, PolicyErrors
from app.governance.fitting import validator
from app.governance.places import names
from app.governance.policy import Gate, Inputs, PolicySet
from app.governance.policy_code import Generator
from app.governance.policy_model import GOVERNANCE
from app.governance.vocabulary import Names, Vocabulary, properties, referring

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from app.governance.bundle_yaml import Document
    from app.governance.model import Capability, Site
    from app.governance.policy_code import Compiled
    from app.governance.policy_model import Profile, Rule

MOST_BYTES: Final = 32_000_000  # of one file: a hundred thousand rules; what never ends, or is no policy, is not read
TESTS_FOLDER: Final = "tests"
PROPERTIES: Final = "properties.yaml"
ORGANIZATION: Final = "organization.yaml"
AUTHORITY: Final = "authority.yaml"
SITE: Final = "site.yaml"
_SINGLE: Final[Mapping[str, type[Any]]] = {
    ORGANIZATION: bundle_shapes.OrganizationShape,
    AUTHORITY: bundle_shapes.AuthorityFileShape,
    SITE: bundle_shapes.SiteShape,
}
_FOLDERS: Final[Mapping[str, type[Any]]] = {
    "capabilities": bundle_shapes.CapabilityShape,
    "profiles": bundle_shapes.ProfileShape,
}
_LAYOUT: Final = (*(f"{folder}/*.yaml" for folder in _FOLDERS), *_SINGLE, PROPERTIES, f"{TESTS_FOLDER}/*.yaml")


def read_files(directory: Path) -> dict[str, str]:
    """Read the policy files of a directory (not its tests, nor its properties), path → text, in order of path.

    Raises:
        PolicyErrors: The directory cannot be read, or a file is not UTF-8 text of at most `MOST_BYTES`.
    """
    return {name: text for name, text in _read(directory, tests=False).items() if name != PROPERTIES}


def read_properties(directory: Path) -> str | None:
    """Read what a policy directory promises (`properties.yaml`); None where it has no such file.

    Raises:
        PolicyErrors: The directory cannot be read, or a file is not UTF-8 text of at most `MOST_BYTES`.
    """
    return _read(directory, tests=False).get(PROPERTIES)


def read_cases(directory: Path) -> dict[str, str]:
    """Read the case files of a policy directory, path relative to it → text, in order of path.

    Raises:
        PolicyErrors: The directory cannot be read, or a file is not UTF-8 text of at most `MOST_BYTES`.
    """
    return _read(directory, tests=True)


def _read(directory: Path, *, tests: bool) -> dict[str, str]:
    if not directory.is_dir():
        raise PolicyErrors(
            [PolicyError(file=str(directory), line=0, key="", message="there is no such directory", valid=_LAYOUT)]
        )
    files: dict[str, str] = {}
    problems = _linked(directory, (TESTS_FOLDER,) if tests else _FOLDERS)
    for path in sorted(directory.rglob("*")):
        name = path.relative_to(directory).as_posix()
        if not _meant(path) or (PurePosixPath(name).parts[0] == TESTS_FOLDER) is not tests:
            continue
        found = _text(path, name)
        if isinstance(found, PolicyError):
            problems.append(found)
        else:
            files[name] = found
    if problems:
        raise PolicyErrors(problems)
    return files


def _linked(directory: Path, folders: Iterable[str]) -> list[PolicyError]:
    """Say which folders are links: what lies behind one is not read, and would be missed without a word."""
    message = "is a link to a directory, and such a link is not followed: valid is a directory of its own"
    linked = [name for name in folders if (path := directory / name).is_symlink() and path.is_dir()]
    return [PolicyError(file=name, line=0, key="", message=message) for name in linked]


def _text(path: Path, name: str) -> str | PolicyError:
    """Return what a file says, or why nobody can be told."""
    line, message = 0, f"cannot be read: valid is a regular file of at most {MOST_BYTES:,} bytes"
    shown = name.encode(errors="backslashreplace").decode()
    if shown != name:
        return PolicyError(file=shown, line=0, key="", message="has a name that is no UTF-8: valid is one that is")
    try:
        if (content := _content(path)) is not None:
            return content.decode()
    except OSError as error:  # a link that leads nowhere, a folder: what was meant to be read there does not decide
        message = f"cannot be read: {error.strerror}"
    except UnicodeDecodeError as error:
        line, message = error.object[: error.start].count(b"\n") + 1, f"cannot be read as UTF-8 text: {error}"
    return PolicyError(file=name, line=line, key="", message=message)


def _content(path: Path) -> bytes | None:
    """Return what a file holds; None if it is none, but a pipe or a device that never ends, or holds too much."""
    if not stat.S_ISREG(path.stat().st_mode):
        return None
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    return content if len(content) <= MOST_BYTES else None


def _meant(path: Path) -> bool:
    """Say whether something is meant to be read; what editors lock a file by is a hidden link that leads nowhere."""
    return path.suffix.lower() in (".yaml", ".yml", ".json") and (path.is_file() or not path.name.startswith("."))


def digest(files: Mapping[str, str]) -> str:
    """Return `sha256:…` over every (path, text), lengths included, in order of path."""
    state = hashlib.sha256()
    for name in sorted(files):
        for part in (name.encode(), files[name].encode()):
            state.update(len(part).to_bytes(8, "big"))
            state.update(part)
    return f"sha256:{state.hexdigest()}"


def load(directory: Path) -> PolicySet:
    """Load a policy directory.

    Raises:
        PolicyErrors: Something is wrong with it; everything that is.
    """
    return load_files(read_files(directory))


def load_files(files: Mapping[str, str]) -> PolicySet:
    """Load a policy set from its files, path → text; the same files give the same digest.

    Raises:
        PolicyErrors: Something is wrong with them; everything that is.
    """
    source = read_shapes(files)
    source.problems += [problem for name in sorted(files) for problem in turned(name, files[name])]
    untyped = _set_apart_untyped(source)
    if ORGANIZATION not in source.single or not source.capabilities or not source.profiles:  # nothing to hold names to
        raise PolicyErrors([*source.problems, *untyped])
    known = _known_of(source)
    problems = [*source.problems, *untyped, *check(source, known)]
    if problems:
        raise PolicyErrors(problems)
    return _assemble(files, source, known)


def load_kept(files: Mapping[str, str]) -> PolicySet:
    """Load a version that once was put in force, to decide as it decided: what a later release refuses is not refused.

    It was checked by the release of then. Its conditions may name what does not exist: they never held, or always.

    Raises:
        PolicyErrors: It cannot be compiled as it stands, so that nobody knows how it decided; everything that is wrong.
    """
    source = read_shapes(files)
    problems = [*source.problems, *_set_apart_untyped(source)]
    if problems:
        raise PolicyErrors(problems)
    known = _known_of(source)
    try:
        return _assemble(files, source, replace(known, vocabulary=Vocabulary(known.capabilities)))
    except (ExpressionError, LookupError):
        return load_files(files)  # which says what is wrong


def know(source: Source) -> Known:
    """Return every name there is in a source, for its checks.

    Raises:
        PolicyErrors: Capabilities declare parameters that no condition could speak of.
    """
    problems = _set_apart_untyped(source)
    if problems:
        raise PolicyErrors(problems)
    return _known_of(source)


def _set_apart_untyped(source: Source) -> list[PolicyError]:
    """Count capabilities whose parameters no condition could speak of as unread, and return what is wrong with them."""
    problems: list[PolicyError] = []
    sound: list[tuple[Reader, bundle_shapes.CapabilityShape]] = []
    for reader, shape in source.capabilities:
        found = [
            *bundle_checks.inputs(reader, shape),
            *bundle_checks.vocabulary(reader, bundle_build.capability(shape)),
        ]
        if found:
            source.unread["capabilities"].add(shape.name)
        else:
            sound.append((reader, shape))
        problems += found
    source.capabilities = sound
    return problems


def _known_of(source: Source) -> Known:
    capabilities = {shape.name: bundle_build.capability(shape) for _, shape in source.capabilities}
    unread = frozenset(source.unread["capabilities"])
    profiles = frozenset(shape.profile for _, shape in source.profiles) | source.unread["profiles"]
    permissions = frozenset(source.organization[1].permissions)
    site = bundle_build.site(source.site[1]) if SITE in source.single else None
    known = Names(capabilities=unread.union(capabilities), profiles=profiles, permissions=permissions, site=site)
    return Known(
        capabilities=capabilities,
        recoveries=unread.union(name for name, found in capabilities.items() if found.recovery) - {TAKEOVER},
        profiles=profiles,
        permissions=permissions,
        vocabulary=Vocabulary(capabilities, known),
        names={} if site is None else names(site),
        modes={shape.profile: frozenset(shape.authority.modes) for _, shape in source.profiles},
        unread=unread,
    )


@dataclass(slots=True)
class Source:
    """The files as shapes, each with the reader that writes problems about it; `problems` is what does not fit.

    `unread` are, by folder, the names that files which do not fit may declare: nothing is known of them, but they may
    be named.
    """

    capabilities: list[tuple[Reader, bundle_shapes.CapabilityShape]] = field(default_factory=list[Any])
    profiles: list[tuple[Reader, bundle_shapes.ProfileShape]] = field(default_factory=list[Any])
    single: dict[str, tuple[Reader, Any]] = field(default_factory=dict[str, Any])
    problems: list[PolicyError] = field(default_factory=list[PolicyError])
    unread: dict[str, set[str]] = field(default_factory=lambda: {folder: set[str]() for folder in _FOLDERS})

    @property
    def organization(self) -> tuple[Reader, bundle_shapes.OrganizationShape]:
        """Return `organization.yaml`."""
        return self.single[ORGANIZATION]

    @property
    def authority(self) -> tuple[Reader, bundle_shapes.AuthorityFileShape]:
        """Return `authority.yaml`."""
        return self.single[AUTHORITY]

    @property
    def site(self) -> tuple[Reader, bundle_shapes.SiteShape]:
        """Return `site.yaml`."""
        return self.single[SITE]


def shape_of(name: str) -> type[Any] | None:
    """Return the shape of a policy file by its path; None where nothing would read it."""
    path = PurePosixPath(name)
    if len(path.parts) == 2 and path.suffix == ".yaml" and path.as_posix() == name:  # one file has one name
        return _FOLDERS.get(path.parts[0])
    return _SINGLE.get(name)


def read_shapes(files: Mapping[str, str]) -> Source:
    """Fit every file into its shape; what does not fit is among the problems."""
    source = Source()
    for name in sorted(files):
        shape = shape_of(name)
        if shape is None:
            message = "is no policy file: nothing would read it"
            source.problems.append(PolicyError(file=name, line=0, key="", message=message, valid=_LAYOUT))
            continue
        document, problems = parse(name, files[name])
        found, misfits = fit(shape, document) if not problems else (None, [])
        source.problems += [*problems, *misfits]
        _file(source, name, document, found)
    for name in _SINGLE:
        if name not in files:
            source.problems.append(PolicyError(file=name, line=0, key="", message="is missing", valid=_LAYOUT))
    for folder in _FOLDERS:
        if not any(name.startswith(f"{folder}/") for name in files):
            source.problems.append(PolicyError(file=folder, line=0, key="", message="has no files", valid=_LAYOUT))
    return source


def _file(source: Source, name: str, document: Document, found: object) -> None:
    reader, path = Reader(document=document), PurePosixPath(name)
    match found:
        case None if name in _SINGLE:
            pass
        case None:
            source.unread[path.parts[0]].add(path.stem)
        case bundle_shapes.CapabilityShape():
            source.capabilities.append((reader, found))
        case bundle_shapes.ProfileShape():
            source.profiles.append((reader, found))
        case _:
            source.single[name] = (reader, found)


def check(source: Source, known: Known) -> list[PolicyError]:
    """Check everything that could be read against everything else."""
    problems: list[PolicyError] = []
    for reader, shape in source.capabilities:
        problems += bundle_checks.capability(reader, shape, known)
    for reader, shape in source.profiles:
        problems += bundle_checks_profile.profile(reader, shape, known)
        problems += bundle_checks.rules(reader, shape.rules, known)
    reader, organization = source.organization
    problems += bundle_checks_site.organization(reader, organization)
    problems += bundle_checks.rules(reader, organization.rules, known)
    if AUTHORITY in source.single:
        reader, authority = source.authority
        problems += bundle_checks_site.authority(reader, authority, known)
        problems += bundle_checks.rules(reader, authority.rules, known)
    if SITE in source.single:
        problems += bundle_checks_site.site(*source.site)
    return problems


def _assemble(files: Mapping[str, str], source: Source, known: Known) -> PolicySet:
    profiles = {shape.profile: bundle_build.profile(shape) for _, shape in source.profiles}
    rules = rules_of(source)
    site = bundle_build.site(source.site[1])
    return PolicySet(
        digest=digest(files),
        capabilities=known.capabilities,
        profiles=profiles,
        site=site,
        agents=bundle_build.agents(source.organization[1]),
        authority=bundle_build.authority(source.authority[1]),
        rules={rule.id: rule for rule in rules},
        gates=_gates(known, profiles, rules, site),
        inputs={name: make_inputs(found) for name, found in known.capabilities.items()},
        permissions=known.permissions,
        files=dict(sorted(files.items())),
    )


def rules_of(source: Source) -> list[Rule]:
    """Build all rules, in the order of their evaluation: the profile's, the organization's, authority's."""
    rules = [
        bundle_build.rule(shape.profile, rule, frozenset({shape.profile}))
        for _, shape in source.profiles
        for rule in shape.rules
    ]
    for owner, shapes in (("organization", source.organization[1].rules), ("authority", source.authority[1].rules)):
        for rule in shapes:
            rules.append(bundle_build.rule(owner, rule, None if rule.profiles is None else frozenset(rule.profiles)))
    return rules


def _gates(
    known: Known, profiles: Mapping[str, Profile], rules: Sequence[Rule], site: Site
) -> dict[tuple[str, str], Gate]:
    """Compile every enabled pair from the rules that apply to it."""
    applying: dict[tuple[str, str], list[Rule]] = {
        (name, profile): [] for name in known.capabilities for profile in profiles
    }
    for rule in rules:
        for name in known.capabilities if rule.applies_to is None else rule.applies_to:
            for profile in profiles if rule.profiles is None else rule.profiles:
                applying[name, profile].append(rule)
    gates: dict[tuple[str, str], Gate] = {}
    for (name, profile), chosen in applying.items():
        found = known.capabilities[name]
        if found.env_profile[profile] != "forbidden":
            gates[name, profile] = make_gate(found, profiles[profile], chosen, site, known.vocabulary)
    return gates


def make_gate(
    capability: Capability, profile: Profile, rules: Sequence[Rule], site: Site, vocabulary: Vocabulary
) -> Gate:
    """Compile one pair from the rules that apply to it."""
    return bind_gate(capability, profile, site, Generator(capability, profile, site, vocabulary).compile(rules))


def bind_gate(capability: Capability, profile: Profile, site: Site, compiled: Compiled) -> Gate:
    """Return a pair's gate from what its rules were compiled to."""
    reserved = {GOVERNANCE} if capability.recovery else set[str]()
    return Gate(
        capability=capability,
        profile=profile,
        site=site,
        permissions=capability.permissions | reserved,
        tests=tuple(TESTS[name] for name in capability.preconditions),
        known=_known(capability, site),
        actions=_actions(capability),
        check=compiled.check,
        source=compiled.source,
        parts=compiled.parts,
    )


def _known(capability: Capability, site: Site) -> tuple[tuple[str, str, frozenset[str]], ...]:
    there = names(site)
    found = referring(capability)
    return tuple((param, kind, there[kind]) for kind, param in found.items() if kind != "action")


def _actions(capability: Capability) -> tuple[str, str] | None:
    found = referring(capability)
    return (found["tool"], found["action"]) if "action" in found and "tool" in found else None


def make_inputs(capability: Capability) -> Inputs:
    """Compile a capability's input schema."""
    specs = properties(capability)
    return Inputs(
        validator=validator(capability.inputs),
        defaults={name: spec["default"] for name, spec in specs.items() if "default" in spec},
        numbers=frozenset(name for name, spec in specs.items() if spec.get("type") == "number"),
        integers=frozenset(name for name, spec in specs.items() if spec.get("type") == "integer"),
    )
