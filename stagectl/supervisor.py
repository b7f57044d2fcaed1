"""The supervisor object: everything that commands, API and tests ask of a stage goes through it.

Configures the drives, starts the servo, asks it by requests and segments, drains the ring into the run folder. It
never computes a command and nothing that the servo waits for. Its parts, by reason to change: the connection
(`stagectl.session`), motion (`stagectl.motion`), zeros and joint (`stagectl.homing`).
"""

from stagectl.homing import Homing


class Supervisor(Homing):
    """One stage, one holder. Use as a context; leaving it brings the stage to rest and closes the run."""
