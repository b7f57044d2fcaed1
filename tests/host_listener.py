"""One processor's pauses, for host_pauses.py: a process that sleeps, and writes down when it was woken too late."""

import json
import os
import sys
import time

SLEEP_S = 0.005
PAUSE_S = 0.015


def listen(cpu: int) -> None:
    """Write down each pause of one processor, until nobody wants to know."""
    os.sched_setaffinity(0, {cpu})
    os.set_blocking(0, False)
    while True:
        slept_s = time.monotonic()
        time.sleep(SLEEP_S)
        woke_s = time.monotonic()
        if woke_s - slept_s > SLEEP_S + PAUSE_S:
            os.write(1, f"{json.dumps([slept_s, woke_s])}\n".encode())
        try:
            if not os.read(0, 1):
                return
        except BlockingIOError:
            continue


if __name__ == "__main__":
    listen(int(sys.argv[1]))
