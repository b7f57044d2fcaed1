"""What each motion command does to the state, and what it asks of the supervisor: one line each."""

from collections.abc import Callable
from typing import Any, NamedTuple

from stagectl.outcome import Outcome
from stagectl.service.states import Event
from stagectl.supervisor import Supervisor

Work = Callable[[Supervisor, Any], Outcome]
"""Takes the stage and the order (body, its plan where it has one, and for a jog what is wanted now)."""


class Motion(NamedTuple):
    """A command that needs power."""

    event: Event
    work: Work
    needs_homing: bool = True
    identifies: bool = False


def _by_distance(stage: Supervisor, order: Any) -> Outcome:
    return stage.move(float(stage.status()["setpoint_position_m"]) + order.body.distance_m, order.body.law)


MOTIONS: dict[str, Motion] = {
    "arm": Motion(Event.ARM, lambda stage, order: stage.armed(order.body.law)),
    "home": Motion(Event.HOME, lambda stage, order: stage.home(), needs_homing=False, identifies=True),
    "move": Motion(Event.MOVE, lambda stage, order: stage.move(order.body.target_m, order.body.law)),
    "jog": Motion(Event.MOVE, _by_distance),
    "jogging": Motion(Event.MOVE, lambda stage, order: stage.jog(order.wanted_m_per_s)),
    "scan": Motion(Event.MOVE, lambda stage, order: stage.scan(order.plan, order.body.law)),
    "follow": Motion(Event.MOVE, lambda stage, order: stage.run(order.plan, order.body.law)),
    "setpoints": Motion(Event.MOVE, lambda stage, order: stage.follow_stream(order.plan)),
    "probe": Motion(Event.IDENTIFY, lambda stage, order: stage.probe(), identifies=True),
    "identify": Motion(
        Event.IDENTIFY,
        lambda stage, order: stage.identify(order.body.frequency_hz, order.body.duration_s),
        identifies=True,
    ),
}
"""By the name of the command."""
