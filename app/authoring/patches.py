"""Small changes to policy files as texts: comments, order and everything else stay as they are."""

from __future__ import annotations

from difflib import unified_diff
from typing import TYPE_CHECKING, Any, Final, cast

import yaml

from app.authoring.drafting import Sections
from app.governance.bundle_yaml import parse
from app.governance.errors import PolicyError, PolicyErrors

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.governance.bundle_yaml import Path
    from app.governance.policy import PolicySet

OWNERS: Final = ("organization", "authority")


class Patching:
    """Some files of a policy, changed bit by bit.

    Attributes:
        changed: the files that were changed, path → text.
    """

    def __init__(self, policy: PolicySet) -> None:
        """Begin with a policy as it stands."""
        self._files = policy.files
        self.changed: dict[str, str] = {}

    def text(self, file: str) -> str:
        """Return a file as it is by now."""
        return self.changed.get(file, self._files[file])

    def patch(self) -> str:
        """Return everything as a unified diff, for `patch -p1` in the policy directory."""
        return "".join(line for file in sorted(self.changed) for line in self._differences(file))

    def _differences(self, file: str) -> Iterator[str]:
        before, after = (text.splitlines(keepends=True) for text in (self._files[file], self.changed[file]))
        for line in unified_diff(before, after, f"a/{file}", f"b/{file}"):
            yield line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n"

    def set(self, file: str, path: Path, value: str) -> None:
        """Write another value in the place of one that stands on one line.

        Raises:
            PolicyErrors: there is none at this path, or it is written over several lines.
        """
        text = self.text(file)
        node = _node(text, path)
        if node is None or node.start_mark.line != node.end_mark.line:
            raise _unchangeable(file, path, "does not stand on one line")
        lines = text.splitlines(keepends=True)
        at = node.start_mark.line
        lines[at] = f"{lines[at][: node.start_mark.column]}{value}{lines[at][node.end_mark.column :]}"
        self.changed[file] = "".join(lines)

    def drop_rule(self, rule: str) -> None:
        """Take a rule out."""
        file, name = self.file_of(rule)
        sections = Sections(file, self.text(file))
        sections.drop("rules", lambda item: item["id"] == name)
        self.changed[file] = sections.text()
        if self.changed[file] == self._files[file]:
            raise _unchangeable(file, ("rules",), "are written between brackets")

    def add_rule(self, file: str, item: Mapping[str, Any]) -> None:
        """Add a rule behind the others."""
        sections = Sections(file, self.text(file))
        sections.append("rules", [item])
        self.changed[file] = sections.text()

    # -- where things stand ------------------------------------------------------------------------------------------

    def file_of(self, rule: str) -> tuple[str, str]:
        """Return the file of a rule or a limit by its full name, and its name there."""
        owner, _, name = rule.partition("/")
        return (f"{owner}.yaml" if owner in OWNERS else self.profile(owner)), name

    def place(self, rule: str) -> tuple[str, Path]:
        """Return where a rule stands: the file, and the path in it."""
        file, name = self.file_of(rule)
        items = cast("list[dict[str, Any]]", self._content(file)["rules"])
        return file, ("rules", next(index for index, item in enumerate(items) if item["id"] == name))

    def profile(self, name: str) -> str:
        """Return the file of a profile."""
        return self._of("profiles/", "profile", name)

    def capability(self, name: str) -> str:
        """Return the file of a capability."""
        return self._of("capabilities/", "name", name)

    def _of(self, folder: str, key: str, name: str) -> str:
        return next(file for file in self._files if file.startswith(folder) and self._content(file)[key] == name)

    def _content(self, file: str) -> dict[str, Any]:
        return cast("dict[str, Any]", parse(file, self._files[file])[0].value)


def _node(text: str, path: Path) -> yaml.Node | None:
    node: yaml.Node | None = yaml.compose(text, Loader=yaml.CSafeLoader)
    for step in path:
        match node:
            case yaml.MappingNode():
                entries = cast("list[tuple[yaml.Node, yaml.Node]]", node.value)
                node = next((value for key, value in entries if key.value == step), None)
            case yaml.SequenceNode():
                node = cast("list[yaml.Node]", node.value)[cast("int", step)]
            case _:
                return None
    return node


def _unchangeable(file: str, path: Path, why: str) -> PolicyErrors:
    key = ".".join(map(str, path))
    return PolicyErrors([PolicyError(file=file, line=1, key=key, message=f"cannot be changed here: it {why}")])
