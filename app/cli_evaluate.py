"""`reins evaluate`: governance methods measured against each other, next to the paper's numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich import box
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from app.cli_policies import Policies, load_policy
from app.config import find_policies
from app.terminal import FINDING, INTERRUPTED, MISUSE, err, out, say, say_error

if TYPE_CHECKING:
    from app.evaluation.campaign import Request
    from app.governance.model import Json

DASH: Final = "–"
_LONG_TRIALS: Final = 1000
_TRIALS: Final = 200
_MOST: Final = 1_000_000_000  # of trials or processes
_LARGEST_SEED: Final = 2**64 - 1  # what `results.json` can hold
_SHOWN: Final = ("UAIR", "FRR", "RVDR", "UCR", "CEF", "FAS", "RSR", "RBSR", "MRT", "RPC")


# The options of `reins evaluate`, in the order of its help.
_Protocol = Annotated[
    str, typer.Option(help="paper: the paper's generator and its watcher of chance. physical: in the workcell.")
]
_Methods = Annotated[str, typer.Option(help="Names with commas between them, or all.")]
_Ablations = Annotated[
    bool | None, typer.Option(help="Reins with one part left out, five times; default: with --methods all.")
]
_Seeds = Annotated[str | None, typer.Option(help="With commas between them; the default are the paper's.")]
_Trials = Annotated[
    int | None, typer.Option(help="For each method, task and seed; default: the protocol's. 0: studies alone.")
]
_Jobs = Annotated[int, typer.Option(help="Processes; 0: one for each core.")]
_Folder = Annotated[Path | None, typer.Option("--out", help="The campaign's folder; default: evaluation/<protocol>.")]
_Tasks = Annotated[
    str, typer.Option(help="Task types, or fault-NAME, with commas between them, or all; default: the protocol's.")
]
_Plugins = Annotated[
    list[Path] | None, typer.Option(help="A Python file that registers more; may be given several times.")
]
_Long = Annotated[bool, typer.Option("--long", help="Reins alone, 5,000 trials, spread over the seeds.")]
_Studies = Annotated[
    str, typer.Option(help="Also run studies beyond the paper: names with commas between them, or all.")
]
_Noise = Annotated[
    float,
    typer.Option(
        help="Multiplies every error of every sensor; 1 is as measured. The boundary band, and the sizes of faults "
        "near their limit, stay those of 1. Protocol physical."
    ),
]
_Dropout = Annotated[
    float | None, typer.Option(help="How often the tracker misses a person in a frame, 0 to 1. Protocol physical.")
]
_FaultSize = Annotated[
    float,
    typer.Option(help="Multiplies how far faults go beyond their limit; 1 is as reported. Protocol physical."),
]
_Walks = Annotated[
    str, typer.Option(help="How people come, usual or other (across, in a curve, halting). Protocol physical.")
]
_Fresh = Annotated[bool, typer.Option("--fresh", help="Remove the former campaign from the folder first.")]
_Readme = Annotated[
    Path | None, typer.Option(help="Also write the measured figures into this file, between its comments.")
]


def evaluate(  # noqa: PLR0913  # its options
    *,
    protocol: _Protocol = "paper",
    methods: _Methods = "all",
    ablations: _Ablations = None,
    seeds: _Seeds = None,
    trials: _Trials = None,
    jobs: _Jobs = 0,
    folder: _Folder = None,
    tasks: _Tasks = "",
    plugin: _Plugins = None,
    policies: Policies = None,
    long: _Long = False,
    studies: _Studies = "",
    sensor_noise: _Noise = 1.0,
    tracker_dropout: _Dropout = None,
    fault_size: _FaultSize = 1.0,
    walks: _Walks = "usual",
    fresh: _Fresh = False,
    readme: _Readme = None,
) -> None:
    """Measure governance methods against each other; every table of the paper next to ours.

    [bold]reins evaluate[/]                                              the paper's protocol, all methods and ablations

    [bold]reins evaluate --protocol physical --methods direct,reins[/]   two methods in the simulated workcell

    [bold]reins evaluate --protocol physical --long[/]                   Reins alone, 5,000 trials

    [bold]reins evaluate --protocol physical --tasks all[/]              whole tasks instead, step by step in one world

    [bold]reins evaluate --protocol physical --studies all --trials 0[/]  what goes beyond the paper, and nothing else

    [bold]reins evaluate --seeds 1,2 --trials 50 --out try[/]            a quick look, with seeds of your own

    [bold]reins evaluate --methods all --plugin mine.py[/]               with a method, task or fault of your own

    [bold]reins evaluate --protocol physical --seeds 1,2 --trials 60 --sensor-noise 1.5 --fault-size 0.5[/]

    Writes results.json, trials.csv (one row per trial), timings.csv and report.html, which needs no network. Ctrl-C
    keeps what is finished and the same command goes on from there; trials.csv is the same, byte for byte, whatever
    --jobs is and however often it was interrupted. docs/evaluation.md explains protocols, metrics and plugins.
    """
    from app.evaluation.extensions import PluginError, UnknownName

    try:
        _check_count("trials", trials)
        _check_count("jobs", jobs)
        request = _request(
            protocol=protocol,
            methods="reins" if long and methods == "all" else methods,
            ablations=(methods == "all" and not long) if ablations is None else ablations,
            seeds=seeds,
            trials=trials,
            tasks=tasks,
            plugins=tuple(plugin or ()),
            policies=find_policies(policies),
            long=long,
            studies=studies,
            under=_under(protocol, sensor_noise, tracker_dropout, fault_size, walks),
            readme=readme,
        )
        if readme is not None:
            _check_reported(request)
    except (UnknownName, PluginError, ValueError) as error:
        say_error(str(error))
        raise typer.Exit(MISUSE) from error
    load_policy(request.policies)  # what is wrong with it is said before anything is made
    target = folder or Path("evaluation") / protocol
    raise typer.Exit(_run(request, target, workers=jobs or len(os.sched_getaffinity(0)), fresh=fresh, readme=readme))


def _request(  # noqa: PLR0913  # the command's options
    *,
    protocol: str,
    methods: str,
    ablations: bool,
    seeds: str | None,
    trials: int | None,
    tasks: str,
    plugins: tuple[Path, ...],
    policies: Path,
    long: bool,
    studies: str,
    under: str,
    readme: Path | None,
) -> Request:
    """Read the options.

    Raises:
        UnknownName: a method, a task, a study or a protocol that nobody registered.
        PluginError: a plugin that does not load.
        ValueError: a seed that is no integer, or options that exclude each other.
    """
    from app.evaluation.campaign import Request
    from app.evaluation.extensions import REGISTRY, find_method, load_plugins
    from app.evaluation.methods import ABLATIONS, METHODS, REINS
    from app.evaluation.model import SEEDS
    from app.evaluation.protocols import find_protocol, find_study, find_tasks, study_names

    load_plugins(plugins)
    if long and tasks:
        raise ValueError(f"--long with --tasks `{tasks}`: valid is one of them, the long run has its own trials")
    if long and not getattr(find_protocol(protocol), "LONG", None):
        raise ValueError(
            f"--long with protocol `{protocol}`: it has no long run; valid is one that has, like `physical`"
        )
    reported = SEEDS if seeds is None else _seeds(seeds)
    standard = getattr(find_protocol(protocol), "TRIALS", _TRIALS)
    if long:
        standard = _long_trials(protocol, reported, trials)
    if tasks:
        standard = getattr(find_protocol(protocol), "TASK_TRIALS", standard)
    if studies and not study_names(protocol):
        raise ValueError(f"--studies `{studies}`: protocol `{protocol}` has none; valid is a protocol that has")
    if under and (studies or readme is not None):
        raise ValueError(
            f"circumstances `{under}` with {'--studies' if studies else '--readme'}: studies have circumstances of "
            "their own, and the README quotes the reported ones; valid is one without the other"
        )
    named = (*METHODS, *REGISTRY.methods) if methods == "all" else _given("methods", methods)
    wanted = tuple(dict.fromkeys(find_method(name).name for name in (*named, *(ABLATIONS if ablations else ()))))
    if long and wanted != (REINS.name,):
        raise ValueError(
            f"--long with methods `{','.join(wanted)}`: the long run is of one method alone; valid is `{REINS.name}`"
        )
    return Request(
        protocol=protocol,
        methods=wanted,
        seeds=reported,
        trials=standard if trials is None else trials,
        policies=policies,
        tasks=find_tasks(protocol, _given("tasks", tasks) if tasks else ()),
        plugins=plugins,
        long=long,
        studies=tuple(
            find_study(protocol, name)
            for name in (study_names(protocol) if studies == "all" else _given("studies", studies))
        )
        if studies
        else (),
        under=under,
    )


def _check_reported(request: Request) -> None:
    """Refuse to write into the README what it would quote as the reported figures, and is not.

    Raises:
        ValueError: the rows of Reins would be others than those that are reported, or there would be none.
    """
    from app.evaluation.methods import REINS
    from app.evaluation.model import SEEDS
    from app.evaluation.protocols import find_protocol

    trials = getattr(find_protocol(request.protocol), "TRIALS", _TRIALS)
    seeds, reported = (",".join(map(str, one)) for one in (request.seeds, SEEDS))
    others = {
        "--long": request.long,
        f"--tasks `{','.join(request.tasks)}`": bool(request.tasks),
        f"--seeds `{seeds}`": seeds != reported,
        f"--trials `{request.trials}`": request.trials != trials,
        f"--methods `{','.join(request.methods)}`": REINS.name not in request.methods,
        f"--policies `{request.policies}`": request.policies != find_policies(None),
    }
    if any(others.values()):
        raise ValueError(
            f"--readme with {', '.join(name for name, other in others.items() if other)}: the README quotes the "
            f"reported configuration; valid is method `{REINS.name}`, alone or with others, seeds {reported}, {trials} "
            "trials and the policy that is in place, without --long and --tasks"
        )


def _long_trials(protocol: str, seeds: tuple[int, ...], trials: int | None) -> int:
    """Return how many trials a long run has for each seed; it may have numbers of its own.

    Raises:
        ValueError: other ones were asked for.
    """
    from app.evaluation.protocols import find_protocol

    asked = trials or _LONG_TRIALS
    made = find_protocol(protocol).jobs(methods=("reins",), tasks=(), seeds=seeds, trials=asked, long=True)
    own = sum(job.count for job in made) // len(seeds)
    if trials and own != trials:
        raise ValueError(
            f"--long with --trials `{trials}`: this long run has {own:,} for each seed, spread over {len(seeds)}; "
            "valid is one of them without the other"
        )
    return own


def _under(protocol: str, noise: float, dropout: float | None, fault_size: float, walks: str) -> str:
    """Read in what circumstances trials are run; empty where they are those that are reported.

    Raises:
        UnknownName: there is no such protocol.
        ValueError: nothing can be run in them, or the protocol runs in its own alone.
    """
    from app.evaluation.protocols import find_protocol

    if (noise, dropout, fault_size, walks) == (1.0, None, 1.0, "usual"):
        return ""
    if not getattr(find_protocol(protocol), "CIRCUMSTANCES", False):
        raise ValueError(
            f"--sensor-noise, --tracker-dropout, --fault-size or --walks with protocol `{protocol}`: it has neither "
            "sensors nor faults of a size; valid is one that has, like `physical`"
        )
    from app.evaluation.circumstances import Circumstances

    tracker = {} if dropout is None else {"dropout": dropout}
    return Circumstances(noise=noise, fault_size=fault_size, walks=walks, **tracker).text


def _run(request: Request, folder: Path, *, workers: int, fresh: bool, readme: Path | None) -> int:
    from app.evaluation.campaign import CampaignError
    from app.evaluation.readme import ReadmeError, check_place, refresh
    from app.evaluation.report import write_report
    from app.evaluation.workers import JobFailed

    try:
        if readme is not None:  # before half an hour of trials, not after it
            check_place(readme, request.protocol)
        if unwritable := _unwritable(folder):
            say_error(f"--out `{folder}` cannot be written to: {unwritable}", hint="valid is a folder, there or not")
            return MISUSE
        results = _measured(request, folder, workers=workers, fresh=fresh)
        write_report(results, folder / "report.html")
        if readme is not None:
            refresh(readme, results)
    except KeyboardInterrupt:
        say_error(f"interrupted; what is finished is kept in `{folder}`", hint="the same command goes on from there")
        return INTERRUPTED
    except (CampaignError, ReadmeError) as error:
        say_error(str(error))
        return MISUSE
    except JobFailed as error:
        err.print(error.trace, end="", markup=False)
        say_error(str(error), hint=f"what is finished is kept in `{folder}`; the same command tries the rest again")
        return FINDING
    except OSError as error:
        say_error(f"a file cannot be used: {error}")
        return MISUSE
    _say_done(results, folder)
    return 0


def _say_done(results: Mapping[str, Json], folder: Path) -> None:
    if results.get("methods") or results.get("ablations"):  # studies alone have none
        out.print(summary(results))
    say(f"{folder}: report.html, results.json, trials.csv, timings.csv")


def _unwritable(folder: Path) -> str:
    """Say why no file can be kept in a folder, which is made if it is not there; empty where one can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return (error.strerror or str(error)).lower()


def _measured(request: Request, folder: Path, *, workers: int, fresh: bool) -> dict[str, Json]:
    """Run the campaign under a progress bar."""
    from app.evaluation.campaign import run_campaign

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("trials"))
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=err, transient=True) as bars:
        bar = bars.add_task(request.protocol, total=None)

        def progress(done: int, total: int) -> None:
            doing = request.protocol if done < total else f"{request.protocol}, summing up"
            bars.update(bar, completed=done, total=total, description=doing)

        return run_campaign(request, folder, workers=workers, progress=progress, fresh=fresh)


def summary(results: Mapping[str, Json]) -> Table:
    """Return the main metrics of every method as a table; a metric that no method has is left out."""
    methods, ablations = _mapping(results.get("methods")), _mapping(results.get("ablations"))
    lines = {name: _mapping(metrics) for name, metrics in {**methods, **ablations}.items()}
    shown = [metric for metric in _SHOWN if any(_mean(_mapping(line.get(metric))) != DASH for line in lines.values())]
    title = f"protocol {results.get('protocol')}, mean over seeds"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("method", no_wrap=True)
    for metric in shown:
        heading = metric.replace("_", "\n").lower() if "_" in metric else metric
        table.add_column(heading, justify="right", no_wrap=True, min_width=5)
    for name, line in lines.items():
        table.add_row(name, *(_mean(_mapping(line.get(metric))) for metric in shown))
    return table


def _mean(figure: Mapping[str, Json]) -> str:
    mean = figure.get("mean")
    return f"{mean:.3f}" if isinstance(mean, (int, float)) else DASH


def _mapping(value: Json) -> Mapping[str, Json]:
    return value if isinstance(value, dict) else {}


def _words(text: str) -> tuple[str, ...]:
    return tuple(word for word in (part.strip() for part in text.split(",")) if word)


def _given(option: str, text: str) -> tuple[str, ...]:
    """Return the names in an option; nothing but commas is no choice, and one that is named twice is a slip."""
    words = _words(text)
    if not words:
        raise ValueError(f"--{option} `{text}` names nothing: valid are names with commas between them")
    if twice := [word for place, word in enumerate(words) if word in words[:place]]:
        raise ValueError(f"--{option} `{text}` names `{twice[0]}` twice: valid are {option} that differ")
    return words


def _seeds(text: str) -> tuple[int, ...]:
    """Return the seeds in an option; the same one twice would be the same trials twice, counted as more evidence."""
    found = [_seed(word) for word in _given("seeds", text)]
    twice = [seed for place, seed in enumerate(found) if seed in found[:place]]
    if twice:
        raise ValueError(f"--seeds `{text}` names `{twice[0]}` twice: valid are seeds that differ")
    return tuple(found)


def _seed(word: str) -> int:
    try:
        seed = int(word)
    except ValueError:
        seed = -1
    if not 0 <= seed <= _LARGEST_SEED:
        raise ValueError(f"seed `{word}`: valid are integers from 0 on, below 2⁶⁴, with commas between them")
    return seed


def _check_count(option: str, count: int | None) -> None:
    """Refuse a negative number, and one that no campaign comes to the end of.

    Raises:
        ValueError: it is either.
    """
    if count is not None and not 0 <= count <= _MOST:
        raise ValueError(f"--{option} `{count}`: valid is 0 or more, up to {_MOST:,}")
