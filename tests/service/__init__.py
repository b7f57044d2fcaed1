"""The service: its table, its lease, its API, and the daemon as a real process on the software rig."""
