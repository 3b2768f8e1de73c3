"""A copy of a policy with a profile more in it, made from a template's draft; comments and order of the files stay.

| file | what changes |
|---|---|
| `profiles/NAME.yaml` | is new: the model profile, with the draft's sections and limits in the place of its own |
| `capabilities/*.yaml` | name the new profile in `env_profile`, with the standing they have in the model |
| `organization.yaml`, `authority.yaml` | name it beside the model, in rules for some profiles and in `confirm_before` |
| `properties.yaml` | promises what the draft is for, so that a later change cannot quietly undo it |

Everything else is the copied policy's. The profile's own cases are found when it is whole (`holding`).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, cast

import orjson
import yaml

from app.governance.bundle_schema import KINDS
from app.governance.bundle_yaml import parse
from app.governance.errors import PolicyError, PolicyErrors
from app.governance.model import Intervention, Risk
from app.governance.policy_model import LIMIT_UNITS
from app.governance.vocabulary import always_there, properties

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from app.authoring.questions import Answers
    from app.authoring.templates import Draft, Template
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Profile, WatchRow

PROPERTIES: Final = "properties.yaml"
_KEY: Final = re.compile(r"^([a-z_]+):", re.MULTILINE)


class Sections:
    """The top-level keys of a YAML file as texts, each with the comments above it, in order."""

    def __init__(self, file: str, text: str) -> None:
        """Take a file apart.

        Raises:
            PolicyErrors: its keys do not stand at the beginnings of lines, so that nothing can be exchanged in it.
        """
        self._file = file
        document, problems = parse(file, text)
        starts = [match.start() for match in _KEY.finditer(text)]
        keys = [match[1] for match in _KEY.finditer(text)]
        if problems or not isinstance(document.value, dict) or list(document.value) != keys:
            message = "cannot be taken as a model: its keys do not stand at the beginnings of lines"
            raise PolicyErrors([*problems, PolicyError(file=file, line=1, key="", message=message)])
        starts = [_above(text, start) for start in starts]
        self.head = text[: starts[0]] if starts else text
        ends = [*starts[1:], len(text)]
        self.parts = {key: text[start:end] for key, start, end in zip(keys, starts, ends, strict=True)}

    def put(self, key: str, value: object, *, comments: bool = False) -> None:
        """Set a key to a value, at its place or at the end, with the comments above it or without."""
        was = self.parts.get(key, "\n\n")
        above = was[: was.index(f"{key}:")] if comments and key in self.parts else ""
        self.parts[key] = above + written(key, value) + ("\n" if was.endswith("\n\n") else "")

    def append(self, key: str, items: Iterable[Mapping[str, Any]]) -> None:
        """Add items to the end of a list."""
        added = list(items)
        if not added:
            return
        part = self.parts.get(key, f"{key}: []\n")
        if _flow(part):  # `rules: []` has no items to add one after
            above = part[: part.index(f"{key}:")]
            part = f"{above}{key}:\n" + "".join(f"  - {_flow_text(item)}\n" for item in _items(self._file, part))
        body, indent = part.rstrip(), " " * _column(part)
        more = "".join(f"{indent}- {written_item(item, indent)}\n" for item in added)
        self.parts[key] = f"{body}\n{more}" + part[len(body) :].partition("\n")[2]

    def drop(self, key: str, unwanted: Callable[[Mapping[str, Any]], bool]) -> None:
        """Take items out of a list, with their lines."""
        part = self.parts.get(key)
        if part is None or _flow(part):
            return
        document, _ = parse(self._file, part)
        items, lines = _items(self._file, part), part.splitlines(keepends=True)
        starts = [document.line((key, index)) - 1 for index in range(len(items))]
        for index, (start, end) in reversed([*enumerate(zip(starts, [*starts[1:], len(lines)], strict=True))]):
            if unwanted(items[index]):
                del lines[start:end]
        self.parts[key] = "".join(lines) if len(lines) > starts[0] else f"{key}: []\n"

    def text(self) -> str:
        """Return the file."""
        return self.head + "".join(self.parts.values())


def _above(text: str, start: int) -> int:
    """Return where the comments right above a key begin; the first line of a file belongs to no key."""
    while start > 0:
        line = text.rfind("\n", 0, start - 1) + 1
        if line == 0 or not text[line:start].startswith("#"):
            return start
        start = line
    return start


def _items(file: str, part: str) -> list[Any]:
    value = parse(file, part)[0].value
    return cast("list[Any]", next(iter(cast("dict[str, Any]", value).values())) or [])


def _flow(part: str) -> bool:
    """Say whether a list is written between brackets, or is not there at all."""
    return bool(_list(part).flow_style)


def _column(part: str) -> int:
    """Return how far in the items of a list stand; one without any has two blanks before the first."""
    return _list(part).start_mark.column if _list(part).value else 2


def _list(part: str) -> yaml.CollectionNode:
    node = cast("yaml.MappingNode", yaml.compose(part, Loader=yaml.CSafeLoader))
    return cast("list[tuple[yaml.Node, yaml.CollectionNode]]", node.value)[0][1]


def _scalar(value: object) -> str:
    """Write a scalar: a plain word as it is, everything else as JSON, which YAML reads the same."""
    if isinstance(value, str) and re.fullmatch(r"[a-z][a-z0-9_-]*", value) and value not in ("null", "true", "false"):
        return value
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() else repr(value)
    return orjson.dumps(value).decode()


def _flow_text(value: object) -> str:
    match value:
        case dict():
            inside = cast("dict[str, object]", value)
            return "{" + ", ".join(f"{key}: {_flow_text(item)}" for key, item in inside.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(_flow_text(item) for item in cast("list[object]", value)) + "]"
        case _:
            return _scalar(value)


def written(key: str, value: object) -> str:
    """Write a top-level key: a scalar on its line, a mapping with a line for each of its keys."""
    if not isinstance(value, dict):
        return f"{key}: {_flow_text(value)}\n"
    inside = cast("dict[str, object]", value)
    return f"{key}:\n" + "".join(f"  {name}: {_flow_text(item)}\n" for name, item in inside.items())


def written_item(item: Mapping[str, Any], indent: str) -> str:
    """Write an item of a list, a line for each of its keys."""
    return f"\n{indent}  ".join(f"{key}: {_flow_text(value)}" for key, value in item.items())


# A draft, written --------------------------------------------------------------------------------------------------


def drafted(policy: PolicySet, promised: str | None, template: Template, answers: Answers) -> dict[str, str]:
    """Return the files that a template changes of a policy, or adds to it, path → text.

    Args:
        policy: what is copied.
        promised: its `properties.yaml`, if it has one.
        template: what is made.
        answers: to every question of the template, the common ones included.

    Raises:
        PolicyErrors: the profile's name is taken, or a file cannot be taken as a model.
    """
    name, like = str(answers["profile"]), str(answers["like"])
    if name in policy.profiles:
        message = f"there is a profile `{name}` already"
        raise PolicyErrors([PolicyError(file=f"profiles/{name}.yaml", line=1, key="profile", message=message)])
    draft = template.draft(answers)
    files = {f"profiles/{name}.yaml": _profile(policy, template, answers, draft)}
    for file in policy.files:
        if file.startswith("capabilities/"):
            files[file] = _standing(file, policy.files[file], name, like)
        elif file in _SHARED and (text := _shared(file, policy.files[file], name, like)) != policy.files[file]:
            files[file] = text
    files[PROPERTIES] = _promised(policy, promised, draft, answers)
    return files


def _profile(policy: PolicySet, template: Template, answers: Answers, draft: Draft) -> str:
    name, like = str(answers["profile"]), str(answers["like"])
    sections = Sections(f"profiles/{like}.yaml", policy.files[f"profiles/{like}.yaml"])
    sections.head = (
        f"{KINDS['profile'].modeline()}\n# {template.summary}\n# From the template `{template.name}`, made like "
        f"`{like}`: {template.source}.\n"
    )
    sections.put("profile", name)
    model = policy.profiles[like]
    limits = {key: (found.maximum, found.source) for key, found in model.limits.items()} | dict(draft.limits)
    sections.put("limits", {key: {"max": limits[key][0], "source": limits[key][1]} for key in LIMIT_UNITS})
    for key, value in draft.sections.items():
        sections.put(key, _overseen(value, model) if key == "authority" else value)
    keeps = _pauses if "separation" in draft.sections else _minds
    if draft.sections.get("shared_floor") and not any(map(keeps, model.watch)):
        sections.append("watch", [_SEPARATION])
    sections.drop("rules", lambda rule: _overruled(rule, draft))
    sections.append("rules", _rules(policy, draft, name, like))
    return sections.text()


_SEPARATION: Final[Mapping[str, Any]] = {
    "id": "protective-separation",
    "signal": "separation_m",
    "below": "protective_separation_m",
    "response": {
        "enter": "pause", "clear_after_ms": 1000, "clear_beyond": 0.05, "then": "resume", "persist_ms": 5000,
        "else": "escalate",
    },
}  # fmt: skip


_MOVING: Final = frozenset({Intervention.CONTINUE, Intervention.ROLLBACK})  # what a robot goes on moving by


def _minds(row: WatchRow) -> bool:
    """Say whether a watch rule speaks up below the protective separation distance."""
    return row.named == "protective_separation_m"


def _pauses(row: WatchRow) -> bool:
    """Say whether it holds the robot there at once, whatever is executed: that is what the distance is reckoned for."""
    return _minds(row) and row.applies_to is None and not row.for_ms and row.response.enter not in _MOVING


def _overruled(rule: Mapping[str, Any], draft: Draft) -> bool:
    """Say whether a rule of the model asks for no more than the draft's own does, and would never decide beside it."""
    held = cast("Mapping[str, Any]", rule.get("set") or {}).get("clearance_m")
    if draft.clearance_m is None or not held or len(rule["set"]) > 1:
        return False
    return {*held} == {"min"} and held["min"] <= draft.clearance_m


def _rules(policy: PolicySet, draft: Draft, name: str, like: str) -> list[dict[str, Any]]:
    rules: list[dict[str, Any]] = []
    if draft.clearance_m is not None:
        rules.append({
            "id": f"{name}-clearance",
            "applies_to": _clearing(policy, like),
            "then": "modify",
            "set": {"clearance_m": {"min": draft.clearance_m}},
            "because": f"The base keeps {draft.clearance_m:g} m from everything.",
        })  # fmt: skip
    if draft.confidence is not None:
        rules.append({
            "id": f"{name}-confidence",
            "when": f"has(metadata.confidence) && metadata.confidence < {draft.confidence!r}",
            "then": "escalate",
            "because": f"The agent's own confidence is below {draft.confidence:g}.",
            "remedy": f"look again and propose with a confidence of at least {draft.confidence:g}",
        })  # fmt: skip
    return rules


def _enabled(policy: PolicySet, like: str) -> list[str]:
    return [name for name in sorted(policy.capabilities) if (name, like) in policy.gates]


def _clearing(policy: PolicySet, like: str) -> list[str]:
    return [name for name in _enabled(policy, like) if "clearance_m" in always_there(policy.capabilities[name])]


def _overseen(authority: Mapping[str, Any], model: Profile) -> dict[str, Any]:
    """Have as many people asked as the model has, and reviewed what it reviews: no template asks about either."""
    changed = dict(authority)
    if (asked := model.approval) is not None:
        wanted = authority["approval"]["approvers"]
        counts = {
            risk: max(wanted.get(risk, wanted["default"]), asked.approvers.get(Risk(risk), asked.default_approvers))
            for risk in (risk.value for risk in Risk)
        }
        default = max(wanted["default"], asked.default_approvers)
        others = {risk: count for risk, count in counts.items() if count != default}
        changed["approval"] = {**authority["approval"], "approvers": {"default": default, **others}}
    if model.review is not None and model.review.risks:
        risks = [risk.value for risk in Risk if risk in model.review.risks]
        changed["review"] = {"risk": risks, **authority["review"]}
    return changed


def _standing(file: str, text: str, name: str, like: str) -> str:
    """Name the new profile in a manifest, with the standing the model has in it."""
    for held in _at(text, "env_profile"):
        for key, value in cast("list[tuple[yaml.Node, yaml.Node]]", held.value):
            if key.value == like:
                return _behind(text, value, held, key.start_mark.column, f"{name}: {value.value}")
    message = f"does not say how it stands under `{like}`"
    raise PolicyErrors([PolicyError(file=file, line=1, key="env_profile", message=message)])


_SHARED: Final = ("organization.yaml", "authority.yaml")


def _shared(file: str, text: str, name: str, like: str) -> str:
    """Name the new profile in what all profiles share, wherever the model is named: else it asks and denies less."""
    for held in reversed([*_at(text, "rules", "*", "profiles")]):  # the last first: what is before it stays in place
        for item in cast("list[yaml.Node]", held.value):
            if item.value == like:
                text = _behind(text, item, held, held.start_mark.column, name if held.flow_style else f"- {name}")
    waits = cast("list[dict[str, Any]]", cast("dict[str, Any]", parse(file, text)[0].value).get("confirm_before") or [])
    if mine := [{**one, "profile": name} for one in waits if one["profile"] == like]:
        sections = Sections(file, text)
        sections.append("confirm_before", mine)
        text = sections.text()
    return text


def _at(text: str, *path: str) -> Iterator[yaml.CollectionNode]:
    """Yield the mappings and lists at a path of keys in a file, in their order; `*` is every item of a list."""
    nodes: list[yaml.Node | None] = [yaml.compose(text, Loader=yaml.CSafeLoader)]
    for step in path:
        nodes = [inside for node in nodes for inside in _inside(node, step)]
    yield from (node for node in nodes if isinstance(node, yaml.CollectionNode))


def _inside(node: yaml.Node | None, step: str) -> Iterator[yaml.Node]:
    if isinstance(node, yaml.SequenceNode) and step == "*":
        yield from cast("list[yaml.Node]", node.value)
    elif isinstance(node, yaml.MappingNode):
        yield from (value for key, value in cast("list[tuple[yaml.Node, yaml.Node]]", node.value) if key.value == step)


def _behind(text: str, node: yaml.Node, held: yaml.CollectionNode, column: int, more: str) -> str:
    """Write another entry behind one of a mapping or a list, in brackets or on a line of its own as that one is."""
    end = node.end_mark
    at = sum(len(line) for line in text.splitlines(keepends=True)[: end.line]) + end.column
    between = ", " if held.flow_style else "\n" + " " * column
    return f"{text[:at]}{between}{more}{text[at:]}"


# Promises ------------------------------------------------------------------------------------------------------------


def _promised(policy: PolicySet, promised: str | None, draft: Draft, answers: Answers) -> str:
    sections = Sections(PROPERTIES, promised or f"{KINDS['properties'].modeline()}\nproperties: []\n")
    name, like = str(answers["profile"]), str(answers["like"])
    if answers["strictest"]:
        order = _items(PROPERTIES, sections.parts["order"]) if "order" in sections.parts else [like]
        sections.put("order", [name, *order], comments=True)
    sections.append("properties", _promises(policy, draft, name, like))
    return sections.text()


def _promises(policy: PolicySet, draft: Draft, name: str, like: str) -> list[dict[str, Any]]:
    promises: list[dict[str, Any]] = []
    for limit, bound in draft.limits.items():
        for param, capabilities in sorted(_held(policy, like, limit).items()):
            promises.append({
                "id": f"{name}-{limit}-{param}".replace("_", "-"),
                "says": f"`{param}` is at most {bound.most:g} {LIMIT_UNITS[limit]} under {name} ({bound.source}).",
                "applies_to": capabilities,
                "profiles": [name],
                "always": f"params.{param} <= {float(bound.most)!r}",
            })  # fmt: skip
    if draft.clearance_m is not None:
        promises.append({
            "id": f"{name}-clearance",
            "says": f"The base keeps at least {draft.clearance_m:g} m from everything under {name}.",
            "applies_to": _clearing(policy, like),
            "profiles": [name],
            "always": f"params.clearance_m >= {float(draft.clearance_m)!r}",
        })  # fmt: skip
    if draft.confidence is not None:
        promises.append({
            "id": f"{name}-confidence",
            "says": f"Below a confidence of {draft.confidence:g} nothing is launched without a human under {name}.",
            "profiles": [name],
            "when": f"has(metadata.confidence) && metadata.confidence < {float(draft.confidence)!r}",
            "never": ["allowed"],
        })  # fmt: skip
    if draft.asked:
        promises.append({
            "id": f"{name}-approval",
            "says": f"Nothing of {' or '.join(draft.asked)} risk is launched without a human under {name}.",
            "profiles": [name],
            "when": f"capability.risk in {orjson.dumps(draft.asked).decode()}",
            "never": ["allowed"],
        })  # fmt: skip
    return promises


def _held(policy: PolicySet, like: str, limit: str) -> dict[str, list[str]]:
    """Return the capabilities whose parameter is held by a limit, by parameter; only those that name it."""
    held: dict[str, list[str]] = {}
    for name in _enabled(policy, like):
        for param, spec in properties(policy.capabilities[name]).items():
            if spec.get("x-limit") == limit:
                held.setdefault(param, []).append(name)
    return held
