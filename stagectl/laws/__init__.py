"""Control laws. Each module gives the same four functions, compiled into the tick (`stagectl.tick`):

init(profile) -> LAW array          parameters and state, named
middle(after, later, q, l, dt_s)    motion at which known forces are taken (predicted or reference)
precision(...)                      force of the axis that carries the end, between low_n and high_n
carrier(...)                        force of the macro under a micro, likewise
LINEAR_STATES                       fields of LAW that a linear loop carries from cycle to cycle

The bounds are what the motor makes at its limits, so that what is asked of it keeps within them.
"""
