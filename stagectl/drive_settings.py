"""What each drive must be and do for a profile; arming writes it and reads it back."""

from drivers.arming import DriveSettings, StaleTorque
from stagectl.profile import AxisName, Profile

_QUICK_STOP_HOLD, _QUICK_STOP_OFF = 6, 2
_STALE_SHARE = 1.0 / 3.0  # of the micro's way to a stop that each drive may use up before it misses a dead servo


def drive_settings(profile: Profile, vendor_id: int | None) -> dict[AxisName, DriveSettings]:
    """Say what each drive must be and do."""
    settings: dict[AxisName, DriveSettings] = {}
    for axis_name in profile.axes:
        axis = profile.axis(axis_name)
        is_macro = axis_name == "macro"
        step_m = getattr(axis, "encoder_step_m", None)
        asked = axis.identity
        own = (asked.vendor_id, asked.product_code, asked.revision_number, asked.serial_number)
        ramp = profile.macro.stop_deceleration_m_per_s2 / (step_m or profile.macro.encoder_step_m)
        hold = profile.macro.standstill == "hold"
        settings[axis_name] = DriveSettings(
            node_id=axis.node_id,
            eds_path=str(profile.eds_path(axis_name)),
            identity=own if vendor_id is None else (vendor_id,),  # the rig plays whatever unit the profile names
            mode=profile.macro.mode if is_macro else "torque",
            rated_torque_word=round(axis.rated_force_n * 1e3),
            max_torque_word=round(axis.force_limit_n / axis.rated_force_n * 1e3),
            quick_stop_deceleration_word=round(ramp),
            quick_stop_option=_QUICK_STOP_HOLD if is_macro and hold else _QUICK_STOP_OFF,
            heartbeat_ms=round(profile.trip.heartbeat_s * 1e3),
            rpdo_deadline_ms=round(profile.trip.rpdo_deadline_s * 1e3),
            stale_torque=_stale_torque(profile, axis_name),
            cycle_us=round(1e6 / profile.cycle.rate_hz),
            rated_current_word=round(axis.rated_current_a * 1e3),
            encoder_step_m=step_m if is_macro else None,
        )
    return settings


def _stale_torque(profile: Profile, axis: AxisName) -> StaleTorque | None:
    """Say what may become of the micro while a drive keeps up a dead servo's torque; None on a stage without one.

    The macro's force moves the macro alone away from a limp micro; the micro's acts on both, one against the other.
    """
    macro, micro = profile.macro, profile.micro
    if micro is None:
        return None
    both_kg = macro.mass_kg * micro.mass_kg / (macro.mass_kg + micro.mass_kg)
    way_m = _STALE_SHARE * min(-micro.stroke_m[0], micro.stroke_m[1])
    needed_n = min(profile.motion_force_n(axis), profile.axis(axis).force_limit_n)
    return StaleTorque(macro.mass_kg if axis == "macro" else both_kg, way_m, needed_n)
