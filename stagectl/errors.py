"""Exceptions of stagectl, each named after what to go and look at.

    StagectlError
      ProfileError    fix the file           (unknown key, wrong unit, out of range)
      LinkError       check the cable        (CAN silent, serial garbage, port taken)
      DriveError      read the drive         (fault state, EMCY, wrong identity or mapping)
      TimingError     check the host         (deadlines missed, sensor clock not found)
      RequestError    ask for something else (outside travel, unknown effect, not homed)
      RecordError     check the run folder   (disk full, truncated, made by another version)

Expected ends of a run are not exceptions: they are `stagectl.signals.Stop` values.
"""


class StagectlError(Exception):
    """Root of every error that stagectl raises on purpose."""


class ProfileError(StagectlError):
    """A profile or machine file is wrong; the text names file, key, value, limit and remedy."""


class LinkError(StagectlError):
    """A bus or a serial line does not carry what it should."""


class DriveError(StagectlError):
    """A drive refuses, reports a fault, or is not the drive that the profile describes."""


class TimingError(StagectlError):
    """The host or the sensor does not keep time."""


class RequestError(StagectlError):
    """The request can't be carried out on this machine in this state."""


class JogOver(RequestError):
    """The jog that a request wants to go on with is over; a new one has to be begun."""


class RecordError(StagectlError):
    """A run folder can't be written or read."""
