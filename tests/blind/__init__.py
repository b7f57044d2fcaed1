"""Truth generator of the hidden-effect suite: it shares no code with what it judges."""
