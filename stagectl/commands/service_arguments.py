"""The command line of the service: `serve`, and what goes through it. What they do stands beside this file."""

from pathlib import Path
from typing import Annotated

import typer

from stagectl import commands
from stagectl.commands.arguments import Json, deliver, epilog, option

service_app = typer.Typer()

ServedProfile = Annotated[
    str | None, typer.Argument(help="A name or a TOML file (default: the one served last).", metavar="[PROFILE]")
]
ServedBackend = Annotated[
    str,
    option(
        "hardware | rig | rig-drives | rig-sensor | auto. hardware is waited for; auto takes the rig where neither the "
        "profile's CAN interface nor its serial port exists, once, and says so.",
        "--backend",
        metavar="WORLD",
    ),
]
ServedRuns = Annotated[Path, option("Folder of the runs.", "--runs", metavar="FOLDER", envvar="STAGECTL_RUNS")]
Seed = Annotated[int, option("Seed of the rig's noise.", "--seed", min=0)]
Socket = Annotated[Path | None, option("Socket of the service.", "--socket", metavar="PATH", envvar="STAGECTL_SOCKET")]
TcpPort = Annotated[
    int | None, option("Listen on this port of 127.0.0.1 too, for clients with a token.", "--tcp", metavar="PORT")
]
PagePort = Annotated[int, option("Port of 127.0.0.1 to show the page on; 0 takes any.", "--port", metavar="PORT")]
StateFolder = Annotated[
    Path | None, option("Folder of what survives a restart, and of the tokens.", "--state", metavar="FOLDER")
]
LeaseToken = Annotated[
    str | None,
    option("Lease of `stagectl lease --hold` to work under.", "--lease", metavar="TOKEN", envvar="STAGECTL_LEASE"),
]
InPlace = Annotated[bool, option("Start a stage of its own even where a service answers.", "--in-place")]
LinesCount = Annotated[int, option("How many lines.", "--lines", min=1, max=1000)]
LooksCount = Annotated[int | None, option("End after so many looks (default: Ctrl-C).", "--count", min=1)]
DoAcknowledge = Annotated[bool, option("Take note of it; enables nothing.", "--acknowledge")]
Hold = Annotated[bool, option("Take the lease and hold it until Ctrl-C.", "--hold")]
RecordName = Annotated[str | None, option("Begin a run of this name.", "--name", metavar="NAME")]
TriggerError = Annotated[float | None, option("An error above this.", "--error-m")]
TriggerContact = Annotated[float | None, option("A contact with more than this.", "--contact-force-n")]
TriggerReversal = Annotated[bool, option("A reversal.", "--reversal")]
TriggerBefore = Annotated[float | None, option("How much before it (default 1).", "--before-s")]
TriggerAfter = Annotated[float | None, option("How much after it (default 1).", "--after-s")]
TriggerCount = Annotated[int | None, option("How often (default 1).", "--count", min=1, max=1000)]
EndTrigger = Annotated[bool, option("Wait for no event any more.", "--end")]
EndRecord = Annotated[bool, option("End the run that was asked for.", "--end")]
World = Annotated[
    str | None, typer.Argument(help="auto | hardware | rig | rig-drives | rig-sensor.", metavar="[WORLD]")
]
ScanFile = Annotated[Path, typer.Argument(help="TOML: repeat_count, start_m, [[segments]].", metavar="PROGRAM.toml")]
TableFile = Annotated[Path, typer.Argument(help="CSV with the header t_s,position_m.", metavar="FILE.csv")]
Period = Annotated[float, option("Time from one position to the next, s.", "--period-s", min=1e-4, max=1.0)]
Law = Annotated[str | None, option("Control law: dsmc | pid (default: the profile's).", "--law", metavar="LAW")]


@service_app.command(
    epilog=epilog("stagectl serve my-stage.toml", "stagectl serve oled-printer --backend rig --tcp 8700")
)
def serve(
    profile: ServedProfile = None,
    backend: ServedBackend = "hardware",
    seed: Seed = 1,
    runs: ServedRuns = Path("runs"),
    socket: Socket = None,
    tcp: TcpPort = None,
    state: StateFolder = None,
    json: Json = False,
) -> None:
    """Serve a stage to clients, in the foreground, until SIGTERM or Ctrl-C; waits for hardware that is not there."""
    work = commands.serve.serve
    deliver("serve", json, lambda voice: work(voice, profile, backend, runs, seed, socket, tcp, state))


@service_app.command(epilog=epilog("stagectl status", "stagectl status --json"))
def status(socket: Socket = None, json: Json = False) -> None:
    """Show where the service's stage stands: state, fault, positions, lease, cycles."""
    deliver("status", json, lambda voice: commands.watching.status(voice, socket), compiles=False)


@service_app.command(epilog=epilog("stagectl watch", "stagectl watch --json --count 10"))
def watch(count: LooksCount = None, socket: Socket = None, json: Json = False) -> None:
    """Show the status again and again; with --json one object a line before the last."""
    deliver("watch", json, lambda voice: commands.watching.watch(voice, socket, json, count), compiles=False)


@service_app.command(epilog=epilog("stagectl page", "stagectl page --port 8702 --runs /var/lib/stagectl/runs"))
def page(port: PagePort = 8701, runs: ServedRuns = Path("runs"), socket: Socket = None, json: Json = False) -> None:
    """Show the live page to browsers on this machine, until Ctrl-C: scope, states, jog and moves, runs, and STOP.

    The links stand on stdout, one a line; with --json an object a line.
    """
    deliver("page", json, lambda voice: commands.page.page(voice, socket, port, runs, json), compiles=False)


@service_app.command(epilog=epilog("stagectl stop"))
def stop(socket: Socket = None, json: Json = False) -> None:
    """Bring the service's stage to rest and take the power away; needs no lease."""
    deliver("stop", json, lambda voice: commands.remote.stop(voice, socket), compiles=False)


@service_app.command(epilog=epilog("stagectl fault", "stagectl fault --acknowledge"))
def fault(
    acknowledge: DoAcknowledge = False, lease: LeaseToken = None, socket: Socket = None, json: Json = False
) -> None:
    """Show why the stage stopped by itself (exit code 1), or take note of it; nothing is enabled by that."""
    deliver("fault", json, lambda voice: commands.remote.fault(voice, socket, lease, acknowledge), compiles=False)


@service_app.command(epilog=epilog("stagectl lease", "stagectl lease --hold"))
def lease(hold: Hold = False, socket: Socket = None, json: Json = False) -> None:
    """Show who may move the stage, or hold the lease for other commands ($STAGECTL_LEASE).

    What is held is one line on stdout: for a shell, or with --json an object before the last.
    """
    deliver("lease", json, lambda voice: commands.remote.lease(voice, socket, hold, json), compiles=False)


@service_app.command(epilog=epilog("stagectl backend", "stagectl backend rig"))
def backend(world: World = None, lease: LeaseToken = None, socket: Socket = None, json: Json = False) -> None:
    """Show which world the service works in, or change it; without power only."""
    deliver("backend", json, lambda voice: commands.remote.backend(voice, socket, lease, world), compiles=False)


@service_app.command(epilog=epilog("stagectl record", "stagectl record --name warm-up", "stagectl record --end"))
def record(name: RecordName = None, end: EndRecord = False, socket: Socket = None, json: Json = False) -> None:
    """Show what the service records, begin a run, or end it; powered motions are recorded without asking."""
    deliver("record", json, lambda voice: commands.recording.record(voice, socket, name, end), compiles=False)


@service_app.command(
    epilog=epilog("stagectl trigger --error-m 1e-6 --count 10", "stagectl trigger --reversal", "stagectl trigger --end")
)
def trigger(
    error_m: TriggerError = None,
    contact_force_n: TriggerContact = None,
    reversal: TriggerReversal = False,
    before_s: TriggerBefore = None,
    after_s: TriggerAfter = None,
    count: TriggerCount = None,
    end: EndTrigger = False,
    socket: Socket = None,
    json: Json = False,
) -> None:
    """Record what is around an event: an error above a level, a contact, a reversal; or show and end that."""
    given = {"error_m": error_m, "contact_force_n": contact_force_n}
    given |= {"before_s": before_s, "after_s": after_s, "count": count}
    asked = {name: value for name, value in given.items() if value is not None}
    deliver(
        "trigger", json, lambda voice: commands.recording.trigger(voice, socket, asked, reversal, end), compiles=False
    )


@service_app.command(epilog=epilog("stagectl log --lines 50"))
def log(lines: LinesCount = 30, socket: Socket = None, json: Json = False) -> None:
    """Show what the service did last."""
    deliver("log", json, lambda voice: commands.watching.log(voice, socket, lines), compiles=False)


@service_app.command(epilog=epilog("stagectl scan raster.toml"))
def scan(program: ScanFile, lease: LeaseToken = None, socket: Socket = None, json: Json = False) -> None:
    """Follow a scan program: segments, dwells, repetitions; checked whole before the first cycle."""
    work = commands.planned_motion.scan
    deliver("scan", json, lambda voice: work(voice, socket, lease, program), compiles=False)


@service_app.command(epilog=epilog("stagectl follow motion.csv"))
def follow(
    table: TableFile, law: Law = None, lease: LeaseToken = None, socket: Socket = None, json: Json = False
) -> None:
    """Follow the motion of a file, smoothed and checked before the first cycle."""
    work = commands.planned_motion.follow
    deliver("follow", json, lambda voice: work(voice, socket, lease, table, law), compiles=False)


@service_app.command(epilog=epilog("my-program | stagectl stream --period-s 0.01"))
def stream(period_s: Period = 0.01, lease: LeaseToken = None, socket: Socket = None, json: Json = False) -> None:
    """Follow positions from standard input, one a line; where none comes in time, the stage brakes."""
    work = commands.planned_motion.stream
    deliver("stream", json, lambda voice: work(voice, socket, lease, period_s), compiles=False)
