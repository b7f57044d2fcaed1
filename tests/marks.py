"""Marked blind sets, put together by hand."""

from bench.blind_sets import Searched, marked


def member(name="coulomb_friction", inseparable=(), level_n=2.0):
    return {
        "name": name, "acts_on": "macro_force", "both_axes": False, "outside": False, "amplitude": "level_n",
        "parameters": {"level_n": level_n}, "d_prime": 500.0, "limit": 0.01, "above_twice_limit": True,
        "above_ten_times_limit": True, "inseparable": [list(key) for key in inseparable],
    }  # fmt: skip


def found(name="coulomb_friction", value=2.0, half=0.1, aliases=()):
    return {
        "name": name, "acts_on": "macro_force", "alias_set": [list(alias) for alias in aliases],
        "parameters": {"level_n": value}, "interval": {"level_n": [value - half, value + half]},
    }  # fmt: skip


def one(seed, kind, effects=(), *members, reducible=(0.0, 0.0), sd=1.0, held=1, verdict=None):
    truth = {"seed": seed, "kind": kind, "effects": list(members), "parameter_errors": []}
    said = {
        "verdict": verdict or ("found" if effects else "nothing"),
        "effects": list(effects),
        "parameter_errors": [],
        "not_excited": [],
    }
    return marked(Searched(seed, truth, said, held, reducible, sd, 1.0))
