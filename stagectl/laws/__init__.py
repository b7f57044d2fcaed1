"""Control laws. Each module gives the same four functions, compiled into the tick (`stagectl.tick`):

init(profile) -> LAW array          parameters and state, named
middle(after, later, q, l, dt_s)    motion at which known forces are taken (predicted or reference)
precision(...)                      force of the axis that carries the end
carrier(...)                        force of the macro under a micro
"""
