"""The value seam a cycle at a time, in Python: so that lines, cycles and commands can go missing."""

import numpy as np

from stagectl.batch import Simulation


class Loop:
    """A second, slow hand on what `stagectl.batch` compiles; noise is drawn as there."""

    def __init__(self, simulation: Simulation) -> None:
        """Start at the simulation's present instant."""
        self.simulation = simulation
        self.true_macro_m = self.true_end_m = 0.0
        self._late: tuple[int, int, float, float] | None = None

    @property
    def stop(self) -> int:
        """Stop code of the last cycle."""
        return int(self.simulation.controller.command["stop"][0])

    def _advance(self, until_s: float) -> None:
        one, d = self.simulation, self.simulation.devices[0]
        plant = one.module.plant_module
        plant.advance(
            one.state, one.parameters, one.effects, until_s, d["longest_substep_s"], d["macro_a"], d["micro_a"], 1, 1
        )

    def skip(self) -> None:
        """Let a cycle pass in which the host sleeps: the sample is taken, the drives hold their words."""
        d = self.simulation.devices[0]
        self.simulation.noise.standard_normal(2)
        d["sample"] += 1.0
        self._advance(d["sample"] * d["period_s"])

    def cycle(
        self,
        setpoint,
        *,
        fresh: bool = True,
        silent: bool = False,
        lost: bool = False,
        added_micro_n: float = 0.0,
        **measured: float,
    ) -> None:
        """Run one cycle. Not fresh: its line comes a cycle late; silent: never. `measured` overwrites what is seen.

        `added_micro_n` is put on the micro's command behind the controller, which does not know of it.
        """
        one = self.simulation
        d, m, c = one.devices[0], one.controller.measurement, one.controller.command
        t_s = d["sample"] * d["period_s"]
        self._advance(t_s)
        sensed_m = one.module.plant_module.sense(one.state, one.parameters, one.effects, t_s - d["sampled_s"])
        d["sampled_s"] = t_s
        self.true_macro_m = float(one.state["macro_position_m"][0])
        self.true_end_m = float(one.state["end_position_m"][0])
        noise_m = one.noise.standard_normal(2) * one.noise_m
        seen = [
            float(np.floor((true_m + added_m + n) / step + 0.5) * step)
            for true_m, added_m, n, step in zip(
                (self.true_macro_m, self.true_end_m),
                sensed_m,
                noise_m,
                (d["macro_resolution_m"], d["end_resolution_m"]),
                strict=True,
            )
        ]
        m["cycle"] = int(d["sample"])
        m["t_ns"] = int((t_s + d["latch_delay_s"]) * 1e9)
        m["lease_left_ns"] = 1_000_000_000
        m["latched_after_s"] = d["latched_after_s"]
        m["samples_new"] = 0
        m["earlier_sequence"] = -1
        this = (int(d["sample"]), int(t_s * 1e9), *seen)
        fresh = fresh and not silent
        for line in (self._late, this if fresh else None):
            if line is not None:
                if m["samples_new"][0]:
                    m["earlier_sequence"], m["macro_earlier_m"], m["end_earlier_m"] = (
                        m["sequence"], m["macro_position_m"], m["end_position_m"]
                    )  # fmt: skip
                m["sequence"], m["sample_t_ns"], m["macro_position_m"], m["end_position_m"] = line
                m["samples_new"] += 1
        self._late = None if fresh or silent else this
        for name, value in measured.items():
            m[name] = value
        one.controller.setpoint[0] = setpoint
        one.controller.step()
        m["command_lost"] = int(lost)  # known when the next cycle begins
        self._advance(t_s + d["latch_delay_s"])
        d["latched_after_s"] = (t_s + d["latch_delay_s"]) - t_s
        if not lost:
            d["macro_a"] = c["macro_word"][0] * d["macro_amperes_per_word"]
            d["micro_a"] = c["micro_word"][0] * d["micro_amperes_per_word"]
            d["micro_a"] += added_micro_n / one.controller.belief["micro_force_constant_n_per_a"][0]
        d["sample"] += 1.0
        self._advance(d["sample"] * d["period_s"])
