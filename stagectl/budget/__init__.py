"""The dynamic error budget: what the end's error while holding or scanning is made of, and how little is possible.

`lqg` computes the least hold that sensor, delay and torque step allow. `shares` predicts each source's share from the
linearised loop, `measured` takes the same shares from the machine behind the value seam or from a run, `advice` says
what to improve next, `page` and `figures` show it.
"""
