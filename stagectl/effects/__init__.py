"""Every physical law of the stage, once. A file holds a family; `declaration` says what an effect is.

friction    losses that depend on velocity, pre-sliding included
stiffness   forces that depend on position: springs, cables, tilt, position-dependent friction
periodic    forces that repeat with position: cogging, ripple of the motor's force
inertia     reaction, wrong mass, a flexible mode, a shaking base
contact     the joint's contact and the edges of its gap
drive       from the commanded current to the force
sensor      from the true position to the reading
table       forces without a law, as knots over one quantity
"""

from stagectl.effects import contact, drive, friction, inertia, periodic, sensor, stiffness, table
from stagectl.effects.declaration import (
    CATALOGUE,
    CONTACT_QUANTITIES,
    MOTIONS,
    PLACES,
    QUANTITIES,
    QUANTITIES_OF,
    TAGS,
    Effect,
    Trait,
    effect,
)

__all__ = ["CATALOGUE", "CONTACT_QUANTITIES", "MOTIONS", "PLACES", "QUANTITIES", "QUANTITIES_OF", "TAGS"]
__all__ += ["Effect", "Trait", "effect"]
__all__ += ["contact", "drive", "friction", "inertia", "periodic", "sensor", "stiffness", "table"]
