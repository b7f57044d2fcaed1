"""The command line: arguments and help, nothing else. What a command does stands in `stagectl.commands`."""

import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

_EXIT_CODES = (
    "Exit codes: 0 done; 1 ended early (guard, drive, or a replay that differs); 2 wrong usage, profile or request; "
    "3 link or drive; 4 timing; 5 run folder; 130 Ctrl-C (stage at rest, run closed)."
)


def _epilog(*examples: str) -> str:
    """Examples first, each on a line of its own, then the exit codes."""
    return "\n\n".join([*(f"Example: [cyan]{example}[/]" for example in examples), f"[dim]{_EXIT_CODES}[/]"])


app = typer.Typer(
    name="stagectl",
    help="Servo controller for macro-micro stages: drive, identify, record, replay. Without hardware the software rig "
    "plays the stage, over the same bytes.",
    epilog=_epilog("stagectl demo", "stagectl run --trajectory sine --law dsmc", "stagectl runs plot latest"),
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
profile_app = typer.Typer(
    help="Check, show and list profiles: what is believed of a machine.",
    epilog=_epilog("stagectl profile check my-stage.toml"),
    no_args_is_help=True,
)
runs_app = typer.Typer(
    help="List, show, export, import and plot runs: what was recorded.",
    epilog=_epilog("stagectl runs list", "stagectl runs plot latest"),
    no_args_is_help=True,
)
app.add_typer(profile_app, name="profile")
app.add_typer(runs_app, name="runs")

Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout and nothing else; progress on stderr.")]
ProfileOption = Annotated[
    str,
    typer.Option("--profile", "-p", help="Profile: a name or a TOML file.", envvar="STAGECTL_PROFILE", metavar="NAME"),
]
Backend = Annotated[
    str,
    typer.Option(
        "--backend",
        help="auto | hardware | rig | plant. auto takes the rig only where neither the profile's CAN interface nor its "
        "serial port exists, and says so; plant is the machine straight behind the law, without bytes.",
        metavar="WORLD",
    ),
]
Wire = Annotated[
    str,
    typer.Option(
        "--backend",
        help="auto | hardware | rig. auto takes the rig only where neither the profile's CAN interface nor its serial "
        "port exists, and says so.",
        metavar="WORLD",
    ),
]
RunsRoot = Annotated[Path, typer.Option("--runs", help="Folder of the runs.", envvar="STAGECTL_RUNS", metavar="FOLDER")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the rig's noise.", min=0)]
Law = Annotated[
    str | None, typer.Option("--law", help="Control law: dsmc | pid (default: the profile's).", metavar="LAW")
]
RunArgument = Annotated[str, typer.Argument(help="A run: its folder, its name, or 'latest'.", metavar="RUN")]
ProfileArgument = Annotated[str, typer.Argument(help="A name or a TOML file.", metavar="PROFILE")]

_PROFILE, _RUNS = "oled-printer", Path("runs")


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"stagectl {metadata.version('stagectl')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Servo controller for macro-micro stages."""


def _deliver(command: str, as_json: bool, work: Any) -> NoReturn:
    from stagectl.commands.answer import deliver

    deliver(command, as_json, work)


@app.command(epilog=_epilog("stagectl demo", "stagectl demo --json --runs /tmp/runs"))
def demo(
    profile: ProfileOption = _PROFILE,
    backend: Wire = "rig",
    seed: Seed = 1,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Home, identify the backlash, follow the same trajectory under PID and under DSMC; table, figures, report."""

    def work(voice):
        from stagectl.commands import demo as command

        return command.show(voice, profile, backend, runs, seed)

    _deliver("demo", json, work)


@app.command(
    epilog=_epilog(
        "stagectl run --trajectory trapezoid --stroke-m 0.2 --law pid",
        "stagectl run --trajectory my-motion.csv",
        "stagectl run --trajectory sine --frequency-hz 0.1 --backend plant",
    )
)
def run(
    trajectory: Annotated[
        str,
        typer.Option(
            "--trajectory", "-t", help="trapezoid | sine | move | FILE.csv (header t_s,position_m).", metavar="WHAT"
        ),
    ] = "trapezoid",
    stroke_m: Annotated[float | None, typer.Option(help="trapezoid: distance there and back, signed.")] = None,
    velocity_m_per_s: Annotated[float | None, typer.Option(help="trapezoid: speed between the corners.")] = None,
    dwell_s: Annotated[float | None, typer.Option(help="trapezoid: rest at each end.")] = None,
    start_m: Annotated[float | None, typer.Option(help="trapezoid, sine: where it begins.")] = None,
    amplitude_m: Annotated[float | None, typer.Option(help="sine: half of its swing.")] = None,
    frequency_hz: Annotated[float | None, typer.Option(help="sine: frequency.")] = None,
    duration_s: Annotated[float | None, typer.Option(help="sine: whole time, ramps included.")] = None,
    target_m: Annotated[float | None, typer.Option(help="move: where to, from the homed zero.")] = None,
    law: Law = None,
    profile: ProfileOption = _PROFILE,
    backend: Backend = "auto",
    seed: Seed = 1,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Arm, home, follow one trajectory, come to rest; the run is recorded and scored."""

    def work(voice):
        from stagectl.commands import motion
        from stagectl.commands.planning import Shape

        shape = Shape(stroke_m, velocity_m_per_s, dwell_s, start_m, amplitude_m, frequency_hz, duration_s, target_m)
        return motion.run(voice, profile, backend, runs, seed, trajectory, shape, law)

    _deliver("run", json, work)


@app.command(epilog=_epilog("stagectl identify", "stagectl identify --frequency-hz 0.7 --duration-s 30"))
def identify(
    frequency_hz: Annotated[
        float, typer.Option(help="Frequency of the sweep over both edges.", min=0.05, max=5.0)
    ] = 1.0,
    duration_s: Annotated[float, typer.Option(help="How long to sweep.", min=2.0, max=240.0)] = 20.0,
    profile: ProfileOption = _PROFILE,
    backend: Backend = "auto",
    seed: Seed = 1,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Identify the backlash: the micro sweeps over both edges of the joint, pressing with a few newtons."""

    def work(voice):
        from stagectl.commands import motion

        return motion.identify(voice, profile, backend, runs, seed, frequency_hz, duration_s)

    _deliver("identify", json, work)


@app.command(epilog=_epilog("stagectl jog --distance-m 0.01", "stagectl jog --distance-m -0.01 --law pid"))
def jog(
    distance_m: Annotated[float, typer.Option("--distance-m", help="How far, signed.")],
    law: Law = None,
    profile: ProfileOption = _PROFILE,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Arm, home, move by a distance, come to rest."""

    def work(voice):
        from stagectl.commands import motion

        return motion.jog(voice, profile, backend, runs, seed, distance_m, law)

    _deliver("jog", json, work)


@app.command(epilog=_epilog("stagectl home"))
def home(
    profile: ProfileOption = _PROFILE,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Home: the macro on its drive's index, then the micro on both edges of the joint."""

    def work(voice):
        from stagectl.commands import motion

        return motion.home(voice, profile, backend, runs, seed)

    _deliver("home", json, work)


@app.command(epilog=_epilog("stagectl replay latest"))
def replay(run: RunArgument, runs: RunsRoot = _RUNS, json: Json = False) -> None:
    """Send a run's raw bytes through the same code again and compare every value, bit for bit."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.replay(voice, run, runs)

    _deliver("replay", json, work)


@profile_app.command("check", epilog=_epilog("stagectl profile check my-stage.toml"))
def profile_check(profile: ProfileArgument, json: Json = False) -> None:
    """Check a profile: every key, number, unit and relation; says all that is wrong at once."""

    def work(voice):
        from stagectl.commands import profiles

        return profiles.check(voice, profile)

    _deliver("profile check", json, work)


@profile_app.command("show", epilog=_epilog("stagectl profile show oled-printer"))
def profile_show(profile: ProfileArgument = _PROFILE, json: Json = False) -> None:
    """Show a profile with every default filled in."""

    def work(voice):
        from stagectl.commands import profiles

        return profiles.show(voice, profile)

    _deliver("profile show", json, work)


@profile_app.command("list", epilog=_epilog("stagectl profile list"))
def profile_list(json: Json = False) -> None:
    """List the profiles that a bare name can mean."""

    def work(voice):
        from stagectl.commands import profiles

        return profiles.names(voice)

    _deliver("profile list", json, work)


@runs_app.command("list", epilog=_epilog("stagectl runs list"))
def runs_list(runs: RunsRoot = _RUNS, json: Json = False) -> None:
    """List all runs; first recovers rows that a dead servo left in memory."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.names(voice, runs)

    _deliver("runs list", json, work)


@runs_app.command("show", epilog=_epilog("stagectl runs show latest"))
def runs_show(run: RunArgument, runs: RunsRoot = _RUNS, json: Json = False) -> None:
    """Show what a run is, how it ended, and its scores."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.show(voice, run, runs)

    _deliver("runs show", json, work)


@runs_app.command("export", epilog=_epilog("stagectl runs export latest --columns t_ns,end_position_m"))
def runs_export(
    run: RunArgument,
    file_format: Annotated[str, typer.Option("--format", "-f", help="csv | parquet | mat.", metavar="FORMAT")] = "csv",
    columns: Annotated[
        str | None, typer.Option(help="Fields to take, with commas between (default: all).", metavar="A,B,...")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to write (default: samples.FORMAT in the run).", metavar="FILE")
    ] = None,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Write a run's rows as CSV, Parquet or MAT; nothing is rounded."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.export(voice, run, runs, file_format, columns, out)

    _deliver("runs export", json, work)


@runs_app.command(
    "import",
    epilog=_epilog(
        "stagectl runs import bench.csv --column t_ns=time:s --column end_position_m=laser:mm",
        "stagectl runs import bench.mat --map columns.toml",
    ),
)
def runs_import(
    table: Annotated[Path, typer.Argument(help="A .csv or .mat file.", metavar="TABLE")],
    column: Annotated[
        list[str] | None, typer.Option("--column", help="NAME=COLUMN:UNIT, once for each.", metavar="MAP")
    ] = None,
    column_map: Annotated[Path | None, typer.Option("--map", help="TOML file with the same.", metavar="FILE")] = None,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Make a run of a table that was measured elsewhere; says how every column was converted."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.bring_in(voice, table, runs, column or [], column_map)

    _deliver("runs import", json, work)


@runs_app.command("plot", epilog=_epilog("stagectl runs plot latest", "stagectl runs plot latest --out figures"))
def runs_plot(
    run: RunArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A page (.html), or a folder for PNG files (default: report.html in the run).", metavar="PLACE"
        ),
    ] = None,
    runs: RunsRoot = _RUNS,
    json: Json = False,
) -> None:
    """Draw a run: tracking, hold, backlash, identification, timing."""

    def work(voice):
        from stagectl.commands import runs as command

        return command.plot(voice, run, runs, out)

    _deliver("runs plot", json, work)


_USAGE_ERROR: Any = typer.BadParameter.__base__
"""What typer raises for wrong usage; newer versions carry a copy of click inside, older ones import it."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    command = typer.main.get_command(app)
    try:
        code = command.main(argv, prog_name="stagectl", standalone_mode=False)
    except _USAGE_ERROR as error:
        error.show()
        if "--json" in argv:
            import json as json_text

            failure = {"kind": "UsageError", "message": error.format_message()}
            typer.echo(json_text.dumps({"exit_code": error.exit_code, "error": failure}, indent=2))
        return int(error.exit_code)
    except typer.Abort:
        return 130
    return int(code or 0)


if __name__ == "__main__":
    sys.exit(main())
