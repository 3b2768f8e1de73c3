"""Methods, tasks, faults and protocols from outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.evaluation.extensions import (
    REGISTRY,
    ExtraFault,
    PluginError,
    Registry,
    find_method,
    find_task,
    load_plugins,
    plugin_digests,
)
from app.evaluation.methods import METHODS
from app.evaluation.model import CAPABILITIES, TASKS, Violation
from app.sim.faults import Fault
from tests.evaluation import toy

TOY = Path(toy.__file__)


def plugin(folder: Path, text: str) -> Path:
    file = folder / "plugin.py"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_registry_takes_all_four_kinds() -> None:
    registry = Registry()
    toy.register(registry)
    assert registry.methods["toy-method"].tier == 3
    assert registry.tasks["toy_task"].capabilities == ("navigate_to",)
    assert registry.faults["toy_fault"].violation is Violation.SPEED
    assert "toy" in registry.protocols


def test_a_file_is_loaded_once() -> None:
    load_plugins([TOY])
    load_plugins([TOY])
    assert find_method("toy-method").title == "Toy"
    assert find_task("toy_task").category == "navigation"


def test_nothing_shadows_what_the_paper_has() -> None:
    with pytest.raises(PluginError, match="method `reins`"):
        Registry().add_method(METHODS["reins"])
    with pytest.raises(PluginError, match="task `sorting`"):
        Registry().add_task(TASKS["sorting"])
    with pytest.raises(PluginError, match="task `all`: valid are names other than"):
        Registry().add_task(TASKS["sorting"]._replace(name="all"))
    with pytest.raises(PluginError, match="task `waltz` names as capabilities `dance`: valid are navigate_to"):
        Registry().add_task(TASKS["sorting"]._replace(name="waltz", capabilities=("dance",)))
    with pytest.raises(PluginError, match="fault `gremlin` names as capabilities `nothing`"):
        Registry().add_fault(ExtraFault("gremlin", Violation.SPEED, lambda _rng, _size: {}, ()))
    with pytest.raises(PluginError, match="protocol `paper`"):
        Registry().add_protocol("paper", toy)
    with pytest.raises(PluginError, match="lacks `jobs, run, results`"):
        Registry().add_protocol("empty", object())


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x = 1\n", "has no function `register"),
        ("1 / 0\n", "ZeroDivisionError"),
        ("def register(registry): registry.add_wheel()\n", "AttributeError"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_named(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(PluginError, match=why):
        load_plugins([plugin(tmp_path, text)])


def test_a_plugin_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match=r"none\.py` cannot be read"):
        load_plugins([tmp_path / "none.py"])


def test_the_example_of_the_documentation_registers_what_it_says() -> None:
    example = Path("docs/examples/evaluation_plugin.py")
    load_plugins([example])
    assert find_method("watch-only").watch.value == "governed"
    task = find_task("tool_and_back")
    assert set(task.capabilities) <= set(CAPABILITIES)
    fault = REGISTRY.faults["worn_drives"]
    drawn = Fault.read(dict(fault.draw(np.random.default_rng(1), 1.3)))
    assert (drawn.kind, drawn.sizes["gain"]) == ("speed_scaling", 1.3)
    assert str(example) in Path("docs/evaluation.md").read_text(encoding="utf-8")


def test_each_of_two_plugins_with_one_name_has_a_digest_of_its_own(tmp_path: Path) -> None:
    files = [tmp_path / folder / "plugin.py" for folder in ("one", "other")]
    for file in files:
        file.parent.mkdir()
        file.write_text("def register(registry): pass\n", encoding="utf-8")
    before = plugin_digests(files)
    for file in files:
        file.write_text("def register(registry): return\n", encoding="utf-8")
        after = plugin_digests(files)
        assert after != before
        before = after


def test_an_installed_package_is_found_by_its_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "far_away.py").write_text(
        "from app.evaluation.methods import Method\n"
        "def register(registry): registry.add_method(Method(name='far-away', title='Far away', tier=1))\n",
        encoding="utf-8",
    )
    info = tmp_path / "far_away-2.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: far-away\nVersion: 2.5\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("[reins.evaluation]\nfar = far_away:register\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    load_plugins([])
    assert find_method("far-away").title == "Far away"
    assert plugin_digests([])["far"] == "far_away:register 2.5"
