"""The fault campaign: seeded faults at drawn instants of every motion, judged by what was true of the rig."""
