"""The command line: arguments and help, nothing else. What a command does stands in `stagectl.commands`."""

import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from stagectl import commands
from stagectl.commands.arguments import Json
from stagectl.commands.arguments import deliver as _deliver
from stagectl.commands.arguments import epilog as _epilog
from stagectl.commands.arguments import option as _option
from stagectl.commands.service_arguments import InPlace, LeaseToken, Socket, service_app

if TYPE_CHECKING:
    from stagectl.commands.answer import Answer, Voice

# Our matrices are small: more threads for them take turns at waiting (a bound of `budget`: 2.3 x the processor's time).
# Said before numpy is loaded; for the processes that a command starts as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Arrow's own allocator works in huge pages: by chance a service's memory was 2 MiB more from one minute to the next.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")

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


class _GapGroup(typer.core.TyperGroup):
    """Commands of the gap workflow; whatever is no command's name begins the search: `gap PROFILE RUN...`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the name of the search before arguments that begin with none."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [_SEARCH, *args]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Show the commands, then the search with its options: it is what `gap` alone does."""
        super().format_help(ctx, formatter)
        search = self.commands[_SEARCH]
        search.format_help(search.make_context(_SEARCH, [], parent=ctx, resilient_parsing=True), formatter)


_SEARCH = "search"
gap_app = typer.Typer(
    cls=_GapGroup,
    help="Find which effect a profile lacks, and add it. `gap PROFILE RUN...` is `gap search` in short.",
    epilog=_epilog("stagectl gap my-stage.toml run-1 run-2", "stagectl gap apply my-stage.toml gap -o better.toml"),
    no_args_is_help=True,
)
app.add_typer(profile_app, name="profile")
app.add_typer(runs_app, name="runs")
app.add_typer(gap_app, name="gap")
app.add_typer(service_app)


# ---- what can be asked: each option once --------------------------------------------------------------------------


_PROFILE = "oled-printer"
_AUTO = "auto takes the rig only where neither the profile's CAN interface nor its serial port exists, and says so"

Profile = Annotated[
    str, _option("Profile: a name or a TOML file.", "--profile", "-p", metavar="NAME", envvar="STAGECTL_PROFILE")
]
OwnProfile = Annotated[
    str | None,
    _option(
        f"Profile: a name or a TOML file (default: the service's; {_PROFILE} where none answers).",
        "--profile",
        "-p",
        metavar="NAME",
        envvar="STAGECTL_PROFILE",
    ),
]
Wire = Annotated[str, _option(f"auto | hardware | rig. {_AUTO}.", "--backend", metavar="WORLD")]
DemoWorld = Annotated[
    str | None,
    _option(
        "auto | hardware | rig | batch. Without it: the rig, in virtual time (batch) where this host can't keep 1 kHz.",
        "--backend",
        metavar="WORLD",
    ),
]
WireOrPlant = Annotated[
    str,
    _option(
        f"auto | hardware | rig | plant. {_AUTO}; plant is the machine straight behind the law, without bytes.",
        "--backend",
        metavar="WORLD",
    ),
]
Runs = Annotated[Path, _option("Folder of the runs.", "--runs", metavar="FOLDER", envvar="STAGECTL_RUNS")]
Seed = Annotated[int, _option("Seed of the rig's noise.", "--seed", min=0)]
Law = Annotated[str | None, _option("Control law: dsmc | pid (default: the profile's).", "--law", metavar="LAW")]
Kind = Annotated[
    str, _option("trapezoid | sine | move | FILE.csv (header t_s,position_m).", "--trajectory", "-t", metavar="WHAT")
]
Stroke = Annotated[float | None, _option("trapezoid: distance there and back, signed.")]
Speed = Annotated[float | None, _option("trapezoid: speed between the corners.")]
Dwell = Annotated[float | None, _option("trapezoid: rest at each end.")]
Start = Annotated[float | None, _option("trapezoid, sine: where it begins.")]
Amplitude = Annotated[float | None, _option("sine: half of its swing.")]
Frequency = Annotated[float | None, _option("sine: frequency.")]
Duration = Annotated[float | None, _option("sine: whole time, ramps included.")]
Target = Annotated[float | None, _option("move: where to, from the homed zero.")]
SweepFrequency = Annotated[
    float | None,
    _option(
        "Frequency of the sweep over both edges (default: 1 Hz, less where the joint asks for it).", min=0.05, max=5.0
    ),
]
SweepDuration = Annotated[float, _option("How long to sweep.", min=2.0, max=240.0)]
Distance = Annotated[float | None, _option("How far, signed.", "--distance-m")]
Keys = Annotated[bool, _option("Hold an arrow key to move; through a service only.", "--keys")]
JogSpeed = Annotated[float, _option("Speed of --keys.", "--velocity-m-per-s", min=1e-6, max=20.0)]
MoveTarget = Annotated[float, _option("Where to, from the homed zero.", "--target-m")]
ExportFormat = Annotated[str, _option("csv | parquet | mat.", "--format", "-f", metavar="FORMAT")]
Columns = Annotated[str | None, _option("Fields to take, with commas between (default: all).", metavar="A,B,...")]
ExportFile = Annotated[
    Path | None, _option("File to write (default: samples.FORMAT in the run).", "--out", metavar="FILE")
]
ColumnMap = Annotated[list[str] | None, _option("NAME=COLUMN:UNIT, once for each.", "--column", metavar="MAP")]
ColumnMapFile = Annotated[Path | None, _option("TOML file with the same.", "--map", metavar="FILE")]
PlotPlace = Annotated[
    Path | None,
    _option("A page (.html), or a folder for PNG files (default: report.html in the run).", "--out", metavar="PLACE"),
]

RunArgument = Annotated[str, typer.Argument(help="A run: its folder, its name, or 'latest'.", metavar="RUN")]
ProfileArgument = Annotated[str, typer.Argument(help="A name or a TOML file.", metavar="PROFILE")]
TableArgument = Annotated[Path, typer.Argument(help="A .csv or .mat file.", metavar="TABLE")]

GapRuns = Annotated[
    list[str], typer.Argument(help="Runs to learn from: folders or names, several better than one.", metavar="RUN...")
]
Holdout = Annotated[
    list[str] | None, _option("A run that no fit sees, once for each; without, each is held out once.", metavar="RUN")
]
FindingsArgument = Annotated[Path, typer.Argument(help="findings.json of a search, or its folder.", metavar="FINDINGS")]
NewProfile = Annotated[Path, _option("Profile to write.", "--out", "-o", metavar="NEW_PROFILE")]
Candidates = Annotated[bool, _option("Write what is not confirmed yet too, marked so.", "--candidates")]
Force = Annotated[bool, _option("Replace NEW_PROFILE where it is there already; never PROFILE.", "--force")]
DoIt = Annotated[bool, _option("Do the move on the stage or the rig, and judge the prediction.", "--run")]
FindingsProfile = Annotated[
    str | None, _option("Profile, where that of the findings is not found.", "--profile", "-p", metavar="NAME")
]
GapFolder = Annotated[Path, _option("Folder of the findings.", "--out", metavar="FOLDER")]
Workers = Annotated[
    int | None,
    _option("Processors of this machine to use (default: all); the answer is the same.", metavar="N", min=1),
]
DaskAddress = Annotated[
    str | None,
    _option("Scheduler of a dask.distributed cluster that does the work instead.", "--dask", metavar="ADDRESS"),
]

SectionArgument = Annotated[
    str | None,
    typer.Argument(
        help="model | quasi-linear | observer | identification | decoupling | sliding-mode | control | rig | "
        "comparison, or a section's number such as 5.3 (default: all).",
        metavar="[SECTION]",
    ),
]
PaperFolder = Annotated[Path, _option("Folder of the page.", "--out", metavar="FOLDER")]

BudgetRun = Annotated[
    str | None,
    typer.Argument(
        help="A run to hold the prediction against: its folder, its name, or 'latest' (default: the profile's machine, "
        "simulated).",
        metavar="[RUN]",
    ),
]

TuneProfile = Annotated[Path | None, _option("Profile to write.", "--out", "-o", metavar="NEW_PROFILE")]
TunePage = Annotated[Path, _option("Folder of the page.", "--page", metavar="FOLDER")]
TuneBandwidth = Annotated[
    float | None,
    _option("Crossover of the loop (default: as much as the margins allow).", "--bandwidth-hz", min=0.1, max=5000.0),
]
TuneSensitivity = Annotated[float, _option("Greatest sensitivity Ms allowed.", "--max-sensitivity", min=1.05, max=10.0)]
TuneDelay = Annotated[float, _option("Least delay margin, s.", "--delay-margin-s", min=0.0, max=0.01)]
TuneMode = Annotated[
    float | None,
    _option("A flexible mode that a notch is for, known to +-3 % (default: none).", "--mode-hz", min=1.0, max=5000.0),
]
TuneResidue = Annotated[
    float,
    _option("Its residue against the rigid body's, at most.", "--mode-residue-ratio", min=0.001, max=0.4),
]
TuneDamping = Annotated[float, _option("Its damping ratio, at least.", "--mode-damping-ratio", min=1e-3, max=0.5)]

_RUNS, _GAP, _PAPER = Path("runs"), Path("gap"), Path("paper")
_BUDGET, _TUNE = Path("budget"), Path("tune")


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"stagectl {metadata.version('stagectl')}")
        raise typer.Exit


Version = Annotated[bool, _option("Print the version.", "--version", callback=_version, is_eager=True)]


def _own(profile: str | None) -> str:
    """Return the profile of a stage of the command's own; without one asked for, not the service's either."""
    return _PROFILE if profile is None else profile


# ---- the commands -------------------------------------------------------------------------------------------------


@app.callback()
def _root(version: Version = False) -> None:
    """Servo controller for macro-micro stages."""


@app.command(epilog=_epilog("stagectl demo", "stagectl demo --json --runs /tmp/runs"))
def demo(
    profile: Profile = _PROFILE,
    backend: DemoWorld = None,
    seed: Seed = 1,
    runs: Runs = _RUNS,
    json: Json = False,
) -> None:
    """Home, identify the backlash, follow the same trajectory under PID and under DSMC; table, figures, report."""
    _deliver("demo", json, lambda voice: commands.demo.show(voice, profile, backend, runs, seed))


@app.command(
    epilog=_epilog(
        "stagectl run --trajectory trapezoid --stroke-m 0.2 --law pid",
        "stagectl run --trajectory my-motion.csv",
        "stagectl run --trajectory sine --frequency-hz 0.1 --backend plant",
    )
)
def run(
    trajectory: Kind = "trapezoid",
    stroke_m: Stroke = None,
    velocity_m_per_s: Speed = None,
    dwell_s: Dwell = None,
    start_m: Start = None,
    amplitude_m: Amplitude = None,
    frequency_hz: Frequency = None,
    duration_s: Duration = None,
    target_m: Target = None,
    law: Law = None,
    profile: Profile = _PROFILE,
    backend: WireOrPlant = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    json: Json = False,
) -> None:
    """Arm, home, follow one trajectory, come to rest; the run is recorded and scored."""

    def work(voice: "Voice") -> "Answer":
        shape = commands.planning.Shape(
            stroke_m, velocity_m_per_s, dwell_s, start_m, amplitude_m, frequency_hz, duration_s, target_m
        )
        return commands.motion.run(voice, profile, backend, runs, seed, trajectory, shape, law)

    _deliver("run", json, work)


@app.command(epilog=_epilog("stagectl identify", "stagectl identify --frequency-hz 0.7 --duration-s 30"))
def identify(
    frequency_hz: SweepFrequency = None,
    duration_s: SweepDuration = 20.0,
    profile: OwnProfile = None,
    backend: WireOrPlant = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    lease: LeaseToken = None,
    socket: Socket = None,
    in_place: InPlace = False,
    json: Json = False,
) -> None:
    """Identify the backlash: the micro sweeps over both edges of the joint, pressing with a few newtons."""

    def work(voice: "Voice") -> "Answer":
        if backend != "plant" and commands.remote.served(socket, lease, in_place):
            body = commands.remote.checked(
                commands.remote.messages.Identify, frequency_hz=frequency_hz, duration_s=duration_s
            )
            return commands.remote.motion(voice, socket, lease, profile, backend, "identify", body)
        return commands.motion.identify(voice, _own(profile), backend, runs, seed, frequency_hz, duration_s)

    _deliver("identify", json, work)


@app.command(
    epilog=_epilog("stagectl jog --distance-m 0.01", "stagectl jog --distance-m -0.01 --law pid", "stagectl jog --keys")
)
def jog(
    context: typer.Context,
    distance_m: Distance = None,
    keys: Keys = False,
    velocity_m_per_s: JogSpeed = 0.01,
    law: Law = None,
    profile: OwnProfile = None,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    lease: LeaseToken = None,
    socket: Socket = None,
    in_place: InPlace = False,
    json: Json = False,
) -> None:
    """Arm, home where needed, move by a distance or while a key is held, come to rest."""
    if (distance_m is None) is not keys:
        raise typer.BadParameter("give --distance-m, or --keys", ctx=context)
    if keys and (in_place or law is not None):
        raise typer.BadParameter(
            "--keys jogs the service's stage under its own law, not --in-place or --law", ctx=context
        )

    def work(voice: "Voice") -> "Answer":
        if distance_m is None:
            return commands.jog_keys.jog(voice, socket, lease, profile, backend, velocity_m_per_s)
        if commands.remote.served(socket, lease, in_place):
            body = commands.remote.checked(commands.remote.messages.JogBy, distance_m=distance_m, law=law)
            return commands.remote.motion(voice, socket, lease, profile, backend, "jog", body)
        return commands.motion.jog(voice, _own(profile), backend, runs, seed, distance_m, law)

    _deliver("jog", json, work)


@app.command(epilog=_epilog("stagectl move --target-m 0.05"))
def move(
    target_m: MoveTarget,
    law: Law = None,
    profile: OwnProfile = None,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    lease: LeaseToken = None,
    socket: Socket = None,
    in_place: InPlace = False,
    json: Json = False,
) -> None:
    """Arm, home where needed, move to a position, come to rest."""

    def work(voice: "Voice") -> "Answer":
        if commands.remote.served(socket, lease, in_place):
            body = commands.remote.checked(commands.remote.messages.Move, target_m=target_m, law=law)
            return commands.remote.motion(voice, socket, lease, profile, backend, "move", body)
        shape = commands.planning.Shape(None, None, None, None, None, None, None, target_m)
        return commands.motion.run(voice, _own(profile), backend, runs, seed, "move", shape, law)

    _deliver("move", json, work)


@app.command(epilog=_epilog("stagectl home"))
def home(
    profile: OwnProfile = None,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    lease: LeaseToken = None,
    socket: Socket = None,
    in_place: InPlace = False,
    json: Json = False,
) -> None:
    """Home: the macro on its drive's index, then the micro on both edges of the joint."""

    def work(voice: "Voice") -> "Answer":
        if commands.remote.served(socket, lease, in_place):
            body = commands.remote.checked(commands.remote.messages.Home)
            return commands.remote.motion(voice, socket, lease, profile, backend, "home", body)
        return commands.motion.home(voice, _own(profile), backend, runs, seed)

    _deliver("home", json, work)


@app.command(epilog=_epilog("stagectl replay latest"))
def replay(run: RunArgument, runs: Runs = _RUNS, json: Json = False) -> None:
    """Send a run's raw bytes through the same code again and compare every value, bit for bit."""
    _deliver("replay", json, lambda voice: commands.runs.replay(voice, run, runs))


@app.command(epilog=_epilog("stagectl reproduce", "stagectl reproduce 5.3", "stagectl reproduce observer --json"))
def reproduce(section: SectionArgument = None, out: PaperFolder = _PAPER, json: Json = False) -> None:
    """Run the paper that the control law comes from, as printed and as corrected, beside its own numbers."""
    _deliver("reproduce", json, lambda voice: commands.reproduce.show(voice, section, out))


@app.command(epilog=_epilog("stagectl budget oled-printer", "stagectl budget my-stage.toml latest --json"))
def budget(
    profile: ProfileArgument = _PROFILE,
    run: BudgetRun = None,
    law: Law = None,
    seed: Seed = 1,
    runs: Runs = _RUNS,
    out: PaperFolder = _BUDGET,
    json: Json = False,
) -> None:
    """Say what the end's error is made of, predicted beside measured, how little is possible, what to improve next."""
    _deliver("budget", json, lambda voice: commands.budget.show(voice, profile, run, law, seed, runs, out))


@app.command(
    epilog=_epilog("stagectl tune oled-printer", "stagectl tune my-stage.toml --bandwidth-hz 40 -o my-stage-2.toml")
)
def tune(
    profile: ProfileArgument = _PROFILE,
    law: Law = None,
    bandwidth_hz: TuneBandwidth = None,
    max_sensitivity: TuneSensitivity = 2.0,
    delay_margin_s: TuneDelay = 0.8e-3,
    mode_hz: TuneMode = None,
    mode_residue_ratio: TuneResidue = 0.1,
    mode_damping_ratio: TuneDamping = 0.01,
    out: TuneProfile = None,
    force: Force = False,
    page: TunePage = _TUNE,
    json: Json = False,
) -> None:
    """Find gains with a stated bandwidth and margin from the identified model; -o writes a new profile with them."""

    def work(voice: "Voice") -> "Answer":
        from stagectl.tuning.mode import Mode
        from stagectl.tuning.rules import Asked

        mode = None
        if mode_hz is not None:
            mode = Mode(mode_hz, residue_ratio=mode_residue_ratio, damping_ratio=mode_damping_ratio)
        asked = Asked(max_sensitivity, delay_margin_s, bandwidth_hz, mode)
        return commands.tune.show(voice, profile, law, asked, out, force, page)

    _deliver("tune", json, work)


@profile_app.command("check", epilog=_epilog("stagectl profile check my-stage.toml"))
def profile_check(profile: ProfileArgument, json: Json = False) -> None:
    """Check a profile: every key, number, unit and relation; says all that is wrong at once."""
    _deliver("profile check", json, lambda voice: commands.profiles.check(voice, profile))


@profile_app.command("show", epilog=_epilog("stagectl profile show oled-printer"))
def profile_show(profile: ProfileArgument = _PROFILE, json: Json = False) -> None:
    """Show a profile with every default filled in."""
    _deliver("profile show", json, lambda voice: commands.profiles.show(voice, profile))


@profile_app.command("list", epilog=_epilog("stagectl profile list"))
def profile_list(json: Json = False) -> None:
    """List the profiles that a bare name can mean."""
    _deliver("profile list", json, lambda voice: commands.profiles.names(voice))


@runs_app.command("list", epilog=_epilog("stagectl runs list"))
def runs_list(runs: Runs = _RUNS, json: Json = False) -> None:
    """List all runs; first recovers rows that a dead servo left in memory."""
    _deliver("runs list", json, lambda voice: commands.runs.names(voice, runs))


@runs_app.command("show", epilog=_epilog("stagectl runs show latest"))
def runs_show(run: RunArgument, runs: Runs = _RUNS, json: Json = False) -> None:
    """Show what a run is, how it ended, and its scores."""
    _deliver("runs show", json, lambda voice: commands.runs.show(voice, run, runs))


@runs_app.command("export", epilog=_epilog("stagectl runs export latest --columns t_ns,end_position_m"))
def runs_export(
    run: RunArgument,
    file_format: ExportFormat = "csv",
    columns: Columns = None,
    out: ExportFile = None,
    runs: Runs = _RUNS,
    json: Json = False,
) -> None:
    """Write a run's rows as CSV, Parquet or MAT; nothing is rounded."""
    _deliver("runs export", json, lambda voice: commands.runs.export(voice, run, runs, file_format, columns, out))


@runs_app.command(
    "import",
    epilog=_epilog(
        "stagectl runs import bench.csv --column t_ns=time:s --column end_position_m=laser:mm",
        "stagectl runs import bench.mat --map columns.toml",
    ),
)
def runs_import(
    table: TableArgument,
    column: ColumnMap = None,
    column_map: ColumnMapFile = None,
    runs: Runs = _RUNS,
    json: Json = False,
) -> None:
    """Make a run of a table that was measured elsewhere; says how every column was converted."""
    _deliver("runs import", json, lambda voice: commands.runs.bring_in(voice, table, runs, column or [], column_map))


@runs_app.command("plot", epilog=_epilog("stagectl runs plot latest", "stagectl runs plot latest --out figures"))
def runs_plot(run: RunArgument, out: PlotPlace = None, runs: Runs = _RUNS, json: Json = False) -> None:
    """Draw a run: tracking, hold, backlash, identification, timing."""
    _deliver("runs plot", json, lambda voice: commands.runs.plot(voice, run, runs, out))


@gap_app.command(
    _SEARCH,
    epilog=_epilog(
        "stagectl gap my-stage.toml 2026-11-20T09-14-03 2026-11-20T09-31-10",
        "stagectl gap profiles/observed/emps.toml lap --holdout pulses --out gap-emps",
        "stagectl gap my-stage.toml run-1 run-2 run-3 --dask tcp://192.168.1.7:8786",
    ),
)
def gap_search(
    profile: ProfileArgument,
    run: GapRuns,
    holdout: Holdout = None,
    out: GapFolder = _GAP,
    runs: Runs = _RUNS,
    seed: Seed = 0,
    workers: Workers = None,
    dask: DaskAddress = None,
    json: Json = False,
) -> None:
    """Find which effect the profile lacks. Names are candidates until a move foretold by `gap next` confirms them."""
    work = commands.gap.search
    _deliver("gap", json, lambda voice: work(voice, profile, run, holdout or [], runs, out, seed, workers, dask))


@gap_app.command("apply", epilog=_epilog("stagectl gap apply my-stage.toml gap -o my-stage-2.toml --candidates"))
def gap_apply(
    profile: ProfileArgument,
    findings: FindingsArgument,
    out: NewProfile,
    candidates: Candidates = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a new profile with what was confirmed: values, 95 % intervals, runs, date; the old comments stay."""
    _deliver("gap apply", json, lambda voice: commands.gap.apply(voice, profile, findings, out, candidates, force))


@gap_app.command("next", epilog=_epilog("stagectl gap next gap", "stagectl gap next gap --run --backend rig"))
def gap_next(
    findings: FindingsArgument,
    run: DoIt = False,
    profile: FindingsProfile = None,
    backend: Wire = "auto",
    seed: Seed = 1,
    runs: Runs = _RUNS,
    json: Json = False,
) -> None:
    """Propose the move that settles what is open, and write down what it will show; `--run` does it and judges."""
    work = commands.gap_next.show
    _deliver("gap next", json, lambda voice: work(voice, findings, profile, runs, run, backend, seed))


@gap_app.command("demo", epilog=_epilog("stagectl gap demo", "stagectl gap demo --seed 7"))
def gap_demo(profile: Profile = _PROFILE, seed: Seed = 1, runs: Runs = _RUNS, json: Json = False) -> None:
    """Hide an effect in the rig, find it, confirm it, add it, and follow the same move better; virtual time."""
    _deliver("gap demo", json, lambda voice: commands.gap_demo.show(voice, profile, runs, seed))


_USAGE_ERROR: Any = typer.BadParameter.__base__
"""What typer raises for wrong usage; newer versions carry a copy of click inside, older ones import it."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without UTF-8 gets \xb5 for what it can't show
    try:
        code = typer.main.get_command(app).main(argv, prog_name="stagectl", standalone_mode=False)
    except _USAGE_ERROR as error:
        error.show()
        if "--json" in argv:
            import json as json_text

            failure = {"kind": "UsageError", "message": error.format_message()}
            known = error.ctx.command_path.split()[1:] if error.ctx is not None else []
            answer = {"command": " ".join(known), "exit_code": error.exit_code, "error": failure, "run": None}
            typer.echo(json_text.dumps(answer, indent=2))
        return int(error.exit_code)
    except (typer.Abort, KeyboardInterrupt):  # before a command began, or behind its end
        return 130
    return int(code or 0)


if __name__ == "__main__":
    sys.exit(main())
