"""What was written goes onto the disk itself at once, from a thread: the power may go at any time.

A kernel keeps what a process wrote in memory for up to half a minute. Waiting for the disk takes as long as the disk
likes, so whoever records does not wait: it says that there is something, and hears of trouble with its next piece.
"""

import threading
from collections.abc import Sequence

from stagectl.whole_file import WholeFile


class OntoDisk:
    """A thread that syncs files whenever something was written to them."""

    def __init__(self, files: Sequence[WholeFile]):
        """Begin; `close` before the files are closed."""
        self._files = files
        self._written = threading.Event()
        self._over = False
        self._trouble: OSError | None = None
        self._thread = threading.Thread(target=self._work, name="onto-disk", daemon=True)
        self._thread.start()

    def hurry(self) -> None:
        """Say that something was written. Errors: OSError, of an earlier piece that the disk did not take."""
        trouble, self._trouble = self._trouble, None
        if trouble is not None:
            raise trouble
        self._written.set()

    def close(self) -> None:
        """Sync no more; what is under way is waited for."""
        self._over = True
        self._written.set()
        self._thread.join()

    def _work(self) -> None:
        while self._written.wait() and not self._over:
            self._written.clear()
            try:
                for file in self._files:
                    file.put_onto_disk()
            except OSError as error:
                self._trouble = error
