"""A campaign: a protocol's jobs run in worker processes, kept one by one, and summed up when all are there.

1. The configuration (what was asked for, the policy, the plugins, the code, the libraries) has a digest. A folder
   belongs to one configuration; another one is refused, because a table of mixed rows means nothing.
2. Each finished job is a part on disk before it counts. What is there is not run again, so an interruption costs at
   most the jobs that were under way.
3. Tables and results are made from the parts in the order of the jobs, which knows neither processes nor time:
   `trials.csv` is the same byte for byte however many processes there were and however often it was interrupted.
   What a clock said is kept apart, in `timings.csv`.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import platform
import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final, cast

import orjson

import app
from app.evaluation.extensions import find_method, load_plugins, plugin_digests
from app.evaluation.parts import Parts, Rows, write_tables
from app.evaluation.protocols import EvaluationProtocol, HasStudies, find_protocol, find_study, find_tasks
from app.evaluation.rows import COLUMNS
from app.evaluation.workers import run_jobs
from app.governance.bundle import load

if TYPE_CHECKING:
    from app.evaluation.jobs import Job
    from app.governance.model import Json

PARTS: Final = "parts"
CONFIGURATION: Final = "campaign.json"
RESULTS: Final = "results.json"
_LOCK: Final = ".lock"
_ROOM: Final = Path(app.__file__).parent
_NO_ROWS_FROM: Final = frozenset({"agent", "api", "audit", "authoring", "console", "proofs", "runtime"})
"""Rooms that nothing an episode runs imports: the server, its record, and what reads or proves policy."""

_AFTER_ROWS: Final = (
    # The command line, the processes of a server, and what they are made of.
    "assay.py",
    "assayer.py",
    "children.py",
    "cli*.py",
    "config.py",
    "demo.py",
    "main.py",
    "terminal.py",
    "workcell.py",
    "cell/display.py",
    "cell/governed.py",
    "cell/link.py",
    "cell/loop.py",
    "cell/pin.py",
    "cell/sighting.py",
    "governance/bundle_promises.py",
    "governance/bundle_schema.py",
    "governance/changes.py",
    "governance/comparison.py",
    "governance/evolution.py",
    "governance/parcel.py",
    "governance/recorded.py",
    "sim/soak.py",
    # What counts and shows rows.
    "evaluation/counted.py",
    "evaluation/metrics.py",
    "evaluation/goals.py",
    "evaluation/statistics.py",
    "evaluation/published.py",
    "evaluation/paper_tables.py",
    "evaluation/paper_unpublished.py",
    "evaluation/physical_choices.py",
    "evaluation/physical_counts.py",
    "evaluation/physical_sums.py",
    "evaluation/safe_state.py",
    "evaluation/report*.py",
    "evaluation/plots.py",
    "evaluation/readme.py",
)
_LIBRARIES: Final = ("daqp", "mink", "mujoco", "numpy", "ruckig")
"""Libraries whose numbers rows follow from: physics, inverse kinematics and its solver, ways, generators."""

_MINE: Final = (PARTS, RESULTS, "trials.csv", "timings.csv", "report.html", CONFIGURATION)
"""What a campaign writes; last what tells that the rest is a campaign's."""


class CampaignError(Exception):
    """A campaign that cannot go on as asked."""


class OtherConfiguration(CampaignError):
    """The folder holds a campaign of another configuration."""

    def __init__(self, folder: Path, differing: Sequence[str]) -> None:
        """Name the folder and what differs."""
        self.differing = tuple(differing)
        super().__init__(
            f"`{folder}` holds a campaign of another configuration: {', '.join(differing)} differ; "
            "valid are the same configuration, another folder, or --fresh, which removes what is there"
        )


class FolderBusy(CampaignError):
    """Another process runs a campaign in the folder."""

    def __init__(self, folder: Path) -> None:
        """Name the folder."""
        super().__init__(f"a campaign runs in `{folder}` already: valid is one process for each folder")


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What is asked for.

    Attributes:
        protocol: Name of the protocol.
        methods: Names of methods and ablations, in the order of the tables.
        seeds: Seeds of the runs.
        trials: Trials for each method, task and seed.
        policies: Policy directory.
        tasks: Task types, and `fault-NAME` for a plugin's fault; empty: the protocol's own choice.
        plugins: Python files that register more.
        long: Whether the protocol's long run is meant.
        studies: Studies of the protocol to run besides; with `trials` 0 they are all that runs.
        under: Circumstances other than the protocol's own (`circumstances.Circumstances.text`); studies keep theirs.
    """

    protocol: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    trials: int
    policies: Path
    tasks: tuple[str, ...] = ()
    plugins: tuple[Path, ...] = ()
    long: bool = False
    studies: tuple[str, ...] = ()
    under: str = ""

    def describe(self) -> dict[str, Json]:
        """Return everything that the rows follow from, as plain data."""
        return {
            "protocol": self.protocol,
            "methods": list(self.methods),
            "seeds": list(self.seeds),
            "trials": self.trials,
            "tasks": list(self.tasks),
            "long": self.long,
            "studies": list(self.studies),
            "circumstances": self.under,
            "policy": load(self.policies).digest,
            "plugins": {**plugin_digests(self.plugins)},
            "version": app.__version__,
            "code": code_digest(),
            "libraries": _libraries(),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class _Work:
    """What a worker needs to know to run any job of a campaign."""

    protocol: str
    policies: Path
    plugins: tuple[Path, ...]
    folder: Path
    configuration: str

    def open(self) -> Callable[[Job], None]:
        """Load plugins, protocol and policy once."""
        load_plugins(self.plugins)
        protocol, policy = find_protocol(self.protocol), load(self.policies)
        parts = Parts(self.folder, self.configuration, _columns(protocol, studies=True))
        return lambda job: parts.write(job, protocol.run(job, policy))


def run_campaign(
    request: Request, out: Path, *, workers: int, progress: Callable[[int, int], None], fresh: bool = False
) -> dict[str, Json]:
    """Run what is not done yet, write the tables and `results.json`, and return the results.

    Args:
        request: What is asked for.
        out: The campaign's folder; made if it is not there.
        workers: How many processes.
        progress: Called with (trials done, trials in all), first with what is there already.
        fresh: Remove a former campaign from the folder first.

    Raises:
        OtherConfiguration: the folder belongs to another one.
        FolderBusy: another process is at it.
        UnknownName, PluginError: a name that nobody registered, a plugin that does not load.
        JobFailed: a job raised, or its worker died again and again; finished jobs are kept.
        OSError: the folder cannot be written.
    """
    load_plugins(request.plugins)
    protocol = find_protocol(request.protocol)
    _check_names(request)
    configuration = request.describe()
    with _claimed(out, configuration, fresh=fresh):
        digest = _digest(configuration)
        parts = Parts(out / PARTS, digest, _columns(protocol, studies=bool(request.studies)))
        jobs = _jobs(request, protocol)
        _check_jobs(jobs)
        _run(request, parts, jobs, workers=workers, progress=progress)
        rows = Rows(parts, jobs)
        write_tables(rows, parts.columns, out)
        head: dict[str, Json] = {
            "protocol": request.protocol,
            "seeds": list(request.seeds),
            "trials": request.trials,
            "configuration": {"digest": digest, **configuration},
        }
        results = {**head, **protocol.results(rows, load(request.policies))}
        write_json(out / RESULTS, results)
    return results


def write_json(path: Path, document: Mapping[str, Json]) -> None:
    """Write a document in the order of its keys; it appears when it is whole."""
    partial = path.with_suffix(".partial")
    partial.write_bytes(orjson.dumps(document, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))
    partial.replace(path)


def code_digest() -> str:
    """Return the SHA-256 over the Python files that rows may follow from: rows made by other code are other rows.

    What only counts or shows rows is left out, so that a report can be mended without running everything again; so is
    what no episode ever imports, so that a finished campaign outlives a change of the server.
    """
    state = hashlib.sha256()
    for path in sorted(path for path in _ROOM.rglob("*.py") if makes_rows(path.relative_to(_ROOM))):
        state.update(f"{path.relative_to(_ROOM).as_posix()}\0".encode())
        state.update(hashlib.sha256(path.read_bytes()).digest())
    return f"sha256:{state.hexdigest()}"


def _libraries() -> dict[str, Json]:
    """Return the versions of what computes: after an upgrade of one of them rows are other rows."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **{name: version(name) for name in _LIBRARIES}}


def makes_rows(path: PurePath) -> bool:
    """Say whether rows may follow from a Python file, by its path within `app/`; a new file's may."""
    return path.parts[0] not in _NO_ROWS_FROM and not any(
        fnmatchcase(path.as_posix(), pattern) for pattern in _AFTER_ROWS
    )


def _run(
    request: Request, parts: Parts, jobs: Sequence[Job], *, workers: int, progress: Callable[[int, int], None]
) -> None:
    total = sum(job.count for job in jobs)
    missing = [job for job in jobs if not parts.has(job)]
    done = total - sum(job.count for job in missing)
    progress(done, total)

    def count(job: Job) -> None:
        nonlocal done
        done += job.count
        progress(done, total)

    work = _Work(
        protocol=request.protocol,
        policies=request.policies,
        plugins=request.plugins,
        folder=parts.folder,
        configuration=parts.configuration,
    )
    run_jobs(missing, work, workers=workers, done=count)


@contextlib.contextmanager
def _claimed(out: Path, configuration: Mapping[str, Json], *, fresh: bool) -> Generator[None]:
    """Be the one process of a folder that belongs to this configuration."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / _LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderBusy(out) from None
        if fresh:
            _remove(out)
        _check_folder(out, configuration)
        (out / PARTS).mkdir(exist_ok=True)
        for partial in (out / PARTS).glob("*.partial"):
            partial.unlink()
        write_json(out / CONFIGURATION, configuration)
        yield


def _check_folder(out: Path, configuration: Mapping[str, Json]) -> None:
    """Refuse a folder that holds something else; a campaign without a finished job is nothing to lose."""
    try:
        there: Json = orjson.loads((out / CONFIGURATION).read_bytes())
    except FileNotFoundError:
        if strangers := [path.name for path in out.iterdir() if path.name != _LOCK]:
            names = ", ".join(sorted(strangers)[:5])
            raise CampaignError(
                f"`{out}` holds no campaign, but {names}: valid is a new or an empty folder, and --fresh removes only "
                f"what has a `{CONFIGURATION}` beside it"
            ) from None
        return
    except orjson.JSONDecodeError as error:
        raise CampaignError(f"`{out / CONFIGURATION}` is no JSON: {error}; --fresh starts anew") from error
    if there != configuration and any((out / PARTS).glob("*.jsonl")):
        keys = [key for key in configuration if not isinstance(there, dict) or there.get(key) != configuration[key]]
        raise OtherConfiguration(out, keys)


def _remove(out: Path) -> None:
    """Remove what a campaign has written, and nothing else."""
    if not (out / CONFIGURATION).is_file():
        return
    for name in _MINE:
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _check_names(request: Request) -> None:
    for method in request.methods:
        find_method(method)
    find_tasks(request.protocol, request.tasks)
    for study in request.studies:
        find_study(request.protocol, study)
    if not (request.trials or request.studies):
        raise CampaignError("`0` trials and no studies: valid are at least one trial, or a study")


def _jobs(request: Request, protocol: EvaluationProtocol) -> list[Job]:
    """Return the jobs of the comparison, then those of the studies."""
    jobs: list[Job] = []
    if request.trials:
        compared = protocol.jobs(
            methods=request.methods, tasks=request.tasks, seeds=request.seeds, trials=request.trials, long=request.long
        )
        jobs += [job._replace(under=request.under) for job in compared]
    if request.studies:
        jobs += cast("HasStudies", protocol).study_jobs(request.studies, request.seeds)
    return jobs


def _check_jobs(jobs: Sequence[Job]) -> None:
    names = {job.name for job in jobs}
    if len(names) != len(jobs):
        raise CampaignError("two jobs of the protocol have one name: valid are names that tell them apart")


def _columns(protocol: EvaluationProtocol, *, studies: bool) -> Mapping[str, str]:
    own: Mapping[str, str] = getattr(protocol, "COLUMNS", COLUMNS)
    return {**own, **getattr(protocol, "STUDY_COLUMNS", {})} if studies else own


def _digest(configuration: Mapping[str, Json]) -> str:
    text = orjson.dumps(configuration, option=orjson.OPT_SORT_KEYS)
    return f"sha256:{hashlib.sha256(text).hexdigest()}"
