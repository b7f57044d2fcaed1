"""Scores as JSON: every name ends in its unit."""

from dataclasses import asdict
from typing import Any

from stagectl.metrics import Errors
from stagectl.run_page import Scores
from stagectl.run_scores import BacklashScore, CycleScore, MotionScore

_KEYS = {"m": "_m", "N/m": "_n_per_m"}


def scores_json(scores: Scores) -> dict[str, Any]:
    """Describe everything that was scored."""
    return {
        "motions": [_motion(motion) for motion in scores.motions],
        "backlash": None if scores.backlash is None else _backlash(scores.backlash),
        "cycle": None if scores.cycles is None else _cycle(scores.cycles),
        "ended_early": list(scores.ended_early),
    }


def _motion(motion: MotionScore) -> dict[str, Any]:
    settled = motion.settling
    return {
        "trajectory": motion.segment.trajectory,
        "law": motion.segment.law,
        "true": None if motion.true is None else _errors(motion.true),
        "measured": _errors(motion.measured),
        "settling": None if settled is None else asdict(settled),
        "contact_ratio": motion.contact_ratio,
        "missed_cycles_count": motion.missed_cycles_count,
    }


def _errors(errors: Errors) -> dict[str, float]:
    return {
        "max_m": errors.max_m,
        "rms_m": errors.rms_m,
        "settled_max_m": errors.settled.max_m,
        "settled_rms_m": errors.settled.rms_m,
    }


def _backlash(score: BacklashScore) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for edge in score.edges:
        name, unit = edge.name.replace(" ", "_"), _KEYS[edge.unit]
        found[f"{name}{unit}"] = edge.identified
        found[f"{name}_sd{unit}"] = edge.sd
        found[f"{name}_true{unit}"] = edge.true
    return found


def _cycle(score: CycleScore) -> dict[str, Any]:
    names = ["sample_to_sync_ns"] if score.is_virtual else ["lateness_ns", "tick_ns", "sample_to_sync_ns"]
    percentiles = {}
    for name in names:
        timing = score.timing(name)
        percentiles[name] = {"p50": timing.p50_ns, "p99": timing.p99_ns, "max": timing.max_ns}
    return {
        **percentiles,
        "sync_jitter_rms_s": score.sync_jitter_s,
        "cycles_count": score.cycles_count,
        "missed_count": score.missed_count,
        "samples_lost_count": score.samples_lost_count,
        "late_lines_count": score.late_lines_count,
        "is_virtual": score.is_virtual,
    }
