"""How the servo's numbers are laid out for clients. Pure; what is not finite or not known is None."""

import math
from collections.abc import Mapping

import numpy as np

from stagectl.motion import PLAN_SHARE
from stagectl.outcome import BacklashEstimate
from stagectl.profile import Profile
from stagectl.service import messages
from stagectl.temperatures import DriveTemperature

_STALE_S = 0.1  # older than that a position is not shown; the guard's limit is far below

BANNERS = {
    "hardware": "HARDWARE: what moves here is real",
    "rig": "SOFTWARE RIG: nothing real moves",
    "rig-drives": "MIXED: simulated drives on a real interferometer; nothing real moves",
    "rig-sensor": "MIXED: real drives on a SIMULATED interferometer; to be watched only, nothing may be armed",
    "batch": "SOFTWARE RIG in virtual time: nothing real moves",
}
"""Which world this is, for every client to show."""


def backlash_message(
    estimate: BacklashEstimate, run: str, profile_name: str, backend: str, at: str, source: str
) -> messages.Backlash:
    """Lay an estimate out with its date and the world that it is of."""
    return messages.Backlash(
        width_m=estimate.width_m,
        centre_m=estimate.centre_m,
        left_m=estimate.left_m,
        right_m=estimate.right_m,
        left_stiffness_n_per_m=estimate.left_stiffness_n_per_m,
        right_stiffness_n_per_m=estimate.right_stiffness_n_per_m,
        width_sd_m=finite(math.hypot(estimate.left_sd_m, estimate.right_sd_m)),
        left_stiffness_sd_n_per_m=finite(estimate.left_stiffness_sd_n_per_m),
        right_stiffness_sd_n_per_m=finite(estimate.right_stiffness_sd_n_per_m),
        source=source,
        at=at,
        run=run,
        profile_name=profile_name,
        backend=backend,
    )


def limits(profile: Profile | None) -> messages.Limits | None:
    """Say what a stage may be asked for."""
    if profile is None:
        return None
    macro = profile.macro
    return messages.Limits(
        travel_m=macro.travel_m,
        velocity_m_per_s=macro.velocity_limit_m_per_s,
        jog_velocity_m_per_s=jog_velocity_m_per_s(profile),
        has_micro=profile.micro is not None,
        rate_hz=profile.cycle.rate_hz,
    )


def jog_velocity_m_per_s(profile: Profile) -> float:
    """Return the fastest jog that a stage plans."""
    return PLAN_SHARE * profile.macro.velocity_limit_m_per_s


def finite(value: float) -> float | None:
    """Return a number that JSON has; None for nan and infinity."""
    return float(value) if math.isfinite(value) else None


def positions(status: np.void | None) -> messages.Positions:
    """Lay the positions of a STATUS out; what the interferometer said too long ago is no position of now."""
    names = ("end_position_m", "macro_position_m", "macro_encoder_m", "setpoint_position_m", "error_m")
    found = {name: None if status is None else finite(float(status[name])) for name in names}
    age_s, relative_m = None, None
    if status is not None:
        relative_m = finite(float(status["end_position_m"]) - float(status["macro_position_m"]))
        if status["sample_t_ns"] > 0:
            age_s = max(int(status["t_ns"]) - int(status["sample_t_ns"]), 0) * 1e-9
    if age_s is None or age_s > _STALE_S:
        relative_m = None
        found |= dict.fromkeys(("end_position_m", "macro_position_m", "error_m"))
    return messages.Positions(**found, relative_position_m=relative_m, sample_age_s=age_s)


def temperatures(found: Mapping[str, tuple[DriveTemperature, float]]) -> dict[str, messages.Temperature]:
    """Lay the drives' temperatures and their ages out, by axis."""
    return {
        axis: messages.Temperature(degc=one.degc, warning=one.warning, age_s=age_s)
        for axis, (one, age_s) in found.items()
    }


def health(status: np.void | None, rate_hz: float, late: tuple[float, float] | None) -> messages.Health:
    """Lay the counters of a STATUS out, with the recent lateness (99th percentile, greatest)."""
    names = {"cycles_count": "rows", "missed_cycles_count": "missed_cycles", "lost_samples_count": "lost_samples"}
    names["discarded_bytes_count"] = "discarded_bytes"
    counts = {name: 0 if status is None else int(status[field]) for name, field in names.items()}
    return messages.Health(
        **counts,
        rate_hz=rate_hz,
        lateness_p99_s=None if late is None else late[0],
        lateness_max_s=None if late is None else late[1],
    )
