"""Small changes to policy files as texts: comments, order and everything else stay as they are."""

from __future__ import annotations

from difflib import unified_diff
from typing import TYPE_CHECKING, Any, Final, cast

import yaml

from app.authoring.drafting import Sections
from app.governance.bundle_yaml import parse
from app.governance.errors import PolicyError, PolicyErrors

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

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
            raise _unchangeable(file, text, path, "does not stand on one line")
        self.changed[file] = _spliced(text, node.start_mark, node.end_mark, value)

    def hold(self, file: str, path: Path, names: Sequence[str]) -> None:
        """Let a list hold these names and no others: between brackets it is written anew, else its lines come and go.

        Raises:
            PolicyErrors: neither the list nor a mapping it could stand in is there, or an item is no name of its own.
        """
        text = self.text(file)
        node, flow = _node(text, path), f"[{', '.join(names)}]"
        if node is None:
            self.changed[file] = _with_key(file, text, path, flow)
        elif isinstance(node, yaml.SequenceNode) and not node.flow_style:
            self.changed[file] = _with_items(file, text, path, names)
        else:
            self.changed[file] = _spliced(text, node.start_mark, node.end_mark, flow)

    def drop_rule(self, rule: str) -> None:
        """Take a rule out."""
        file, name = self.file_of(rule)
        sections = Sections(file, self.text(file))
        sections.drop("rules", lambda item: item["id"] == name)
        self.changed[file] = sections.text()
        if self.changed[file] == self._files[file]:
            raise _unchangeable(file, self.text(file), ("rules",), "is written between brackets")

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


def _spliced(text: str, start: yaml.Mark, end: yaml.Mark, value: str) -> str:
    """Return a text with something else between two marks."""
    lines = text.splitlines(keepends=True)
    before, after = lines[start.line][: start.column], lines[end.line][end.column :]
    return "".join([*lines[: start.line], f"{before}{value}{after}", *lines[end.line + 1 :]])


def _with_key(file: str, text: str, path: Path, value: str) -> str:
    """Return a text with one more key in a mapping, before the others."""
    inside = _node(text, path[:-1])
    if not isinstance(inside, yaml.MappingNode):
        raise _unchangeable(file, text, path, "is nowhere")
    others = cast("list[tuple[yaml.Node, yaml.Node]]", inside.value)
    if not inside.flow_style:  # one without keys would be `{}`
        first = others[0][0].start_mark
        return _spliced(text, first, first, f"{path[-1]}: {value}\n{' ' * first.column}")
    lines, at = text.splitlines(keepends=True), inside.start_mark
    line, column = lines[at.line], at.column + 1
    lines[at.line] = f"{line[:column]}{path[-1]}: {value}{', ' if others else ''}{line[column:]}"
    return "".join(lines)


def _with_items(file: str, text: str, path: Path, names: Sequence[str]) -> str:
    """Return a text with other names in a list that has a line for each of them."""
    inside, lines = _node(text, path[:-1]), text.splitlines(keepends=True)
    keys = cast("list[tuple[yaml.Node, yaml.SequenceNode]]", cast("yaml.MappingNode", inside).value)
    key, listed = next((key, value) for key, value in keys if key.value == path[-1])
    items = cast("list[yaml.Node]", listed.value)
    if not all(isinstance(item, yaml.ScalarNode) and _before(lines, item) == "-" for item in items):
        raise _unchangeable(file, text, path, "has items that are no name on a line of its own")
    known = [str(item.value) for item in items]
    more = [f"{' ' * listed.start_mark.column}- {name}\n" for name in names if name not in known]
    last = items[-1].start_mark.line
    lines[last] = lines[last].rstrip("\n") + "\n" + "".join(more)
    for item in items:
        if item.value not in names:
            at = item.start_mark.line
            lines[at] = lines[at].partition("\n")[2]  # what came after the last one stays
    if not names:
        head, colon, rest = lines[key.end_mark.line].partition(":")
        lines[key.end_mark.line] = f"{head}{colon} []{rest}"
    return "".join(lines)


def _before(lines: list[str], node: yaml.Node) -> str:
    return lines[node.start_mark.line][: node.start_mark.column].strip()


def _unchangeable(file: str, text: str, path: Path, why: str) -> PolicyErrors:
    line, key, message = parse(file, text)[0].line(path), ".".join(map(str, path)), f"cannot be changed here: it {why}"
    return PolicyErrors([PolicyError(file=file, line=line, key=key, message=message)])
