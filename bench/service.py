"""The service under faults: seeded runs in virtual time and with real processes, losses, pages, soak, mutants.

`--seeds 7` or `13000-13099` plays runs of the batch campaign, with `--part processes` those with real processes, and
says what was seen of each; `--part NAME` does one part. Without `--full`
the parts take 15 minutes together on a host of their own: every kind of fault in virtual time, ten runs with real
processes, every sixth mutant; the last figure says how long they took. With it, an interrupted campaign goes on where
its journal ends.
"""

import time
import traceback
from collections.abc import Callable, Iterator

from bench import service_batch, service_mutants, service_processes, ten_pages
from bench.figure import Bar, Figure, judged

ABOUT = (
    "Faults are injected in the rig, over the wire; judges read the rig's own log (`tests/faults/judge.py`). "
    "A run is drawn from its seed: `python -m bench service --seeds N` plays it again."
)

Say = Callable[[str], None]

PARTS: dict[str, Callable[..., Iterator[Figure]]] = {
    "mutants": service_mutants.figures,  # first: its modules are to be imported uncompiled
    "batch": service_batch.figures,
    "processes": service_processes.figures,
    "losses": service_processes.loss_figures,
    "pages": ten_pages.figures,
    "soak": service_processes.soak_figures,
}
"""By the name that `--part` takes."""
SEEDED: dict[str, Callable[..., Iterator[Figure]]] = {name: PARTS[name] for name in ("batch", "processes")}
"""Of which `--seeds` plays runs."""
ENDED = "parts that came to their end"
TIME, TIME_FULL = Bar("all parts together", "s", 900.0), Bar("all parts together", "s")


def figures(*, full: bool, say: Say, seeds: list[int] | None = None, part: str | None = None) -> Iterator[Figure]:
    """Measure every row, or those of one part; with `seeds`, of these runs."""
    if seeds is not None:
        yield from SEEDED[part or "batch"](full=False, say=say, seeds=seeds)
        return
    begin_s, took, broken, ended = time.monotonic(), [], [], 0
    if part is None and (reason := ten_pages.lacking()):
        say(f"pages will not be measured: {reason}")
    for name, measure in PARTS.items():
        if part in (None, name):
            say(name)
            part_begin_s = time.monotonic()
            try:
                yield from measure(full=full, say=say)
                ended += 1
            except Exception as error:  # noqa: BLE001 - it takes no other part along, and is a missed bar
                say(traceback.format_exc())
                broken.append(f"{name}: {type(error).__name__}: {error}")
            took.append(f"{name} {time.monotonic() - part_begin_s:.0f} s")
    wanted = len(PARTS) if part is None else 1
    yield judged(Bar(ENDED, "parts", wanted, True), ended, reason="; ".join(broken))
    if part is None:
        yield judged(TIME_FULL if full else TIME, time.monotonic() - begin_s, reason=", ".join(took))
