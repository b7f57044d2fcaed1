"""A service in this process: the real desk, stage and API, on the rig in virtual time, behind a socket."""

import threading
import time
from dataclasses import replace

from stagectl.client import Client
from stagectl.service.access import Access
from stagectl.service.api import application
from stagectl.service.listener import Listener
from stagectl.service.places import listen_unix
from tests.service.test_stage_loop import Bench
from tests.struck_stage import home_by_truth

PATIENCE_S = 60.0
_BREATH_S = 1e-4  # for the thread that answers


class Served:
    """A bench whose loop works in a thread of its own.

    Leases run out where `now_s` is set ahead, and only then; with a clock of their own as they do on it.
    """

    def __init__(self, folder, profile="single-axis", machine=None, clock_s=None):
        self.bench = Bench(folder, str(profile), clock_s=clock_s)
        self.bench.loop.settings = replace(self.bench.settings, machine=machine)
        self.desk, self.log = self.bench.desk, self.bench.log
        self.bench.until(lambda: self.bench.loop._state == "idle")
        self.bench.loop.step()
        stage = self.bench.loop._stage
        home_by_truth(stage, stage.backend.rig.plant_state())
        self.bench.loop._homed = True
        self.bench.loop.step()
        self.socket = folder / "stage.socket"
        api = application(self.desk, self.log, self.bench.figures, folder / "runs", "0")
        self._listener = Listener([(listen_unix(self.socket), Access(api, None))])
        self._over, self._step = threading.Event(), threading.Lock()
        self._working = threading.Thread(target=self._work, daemon=True)
        self.client = Client(self.socket)
        self._listener.start()
        self._working.start()

    def _work(self):
        while not self._over.is_set():
            with self._step:
                self.bench.loop.step()
            time.sleep(_BREATH_S)

    @property
    def stage(self):
        """The supervisor object."""
        return self.bench.loop._stage

    @property
    def plant(self):
        """What is true of the stage now, where no command is under way."""
        with self._step:
            return self.stage.backend.rig.plant_state()

    @property
    def truth(self):
        """What was true so far, one element a sample."""
        with self._step:
            return self.stage.backend.truth()

    def until(self, done):
        """Look again and again; fails after a while."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not (found := done()):
            assert time.monotonic() < give_up_s, self.desk.status()
            time.sleep(0.01)
        return found

    def state_is(self, *states):
        """Wait for one of these states."""
        return self.until(lambda: self.desk.status().state in states)

    def recovers(self):
        """Leave it idle, without a lease, a fault, a run or a trigger."""
        self.bench.now_s += 100.0
        self.until(lambda: self.desk.lease_state() is None)
        self.state_is("idle", "fault")
        fault = self.desk.status().fault
        if fault is not None:
            with Client(self.socket) as client:
                client.take_lease("the test's end", 30.0)
                client.acknowledge(fault.number)
                client.give_lease_back()
        self.state_is("idle")

    def close(self):
        """End the service."""
        self.client.close()
        self._listener.close()
        self._over.set()
        self._working.join(PATIENCE_S)
        self.bench.loop.leave()
        self.bench.loop.run()
