"""How long a line takes from its sample to the host: adapter, USB and driver, drawn from a seeded generator.

Lines never overtake each other. Pure; knows no clock.
"""

import numpy as np

_BLOCK = 4096
_USB_FRAME_NS = 125_000
_FTDI_LATENCY_NS = 16_000_000


class Transport:
    """Arrival instants of successive lines."""

    def __init__(self, sensor, generator: np.random.Generator) -> None:
        self._constant_ns = 1e9 * sensor.transport_s
        self._jitter_ns = 1e9 * sensor.transport_jitter_s
        self._grid_ns = {"usb-125us": _USB_FRAME_NS, "ftdi-16ms": _FTDI_LATENCY_NS}.get(sensor.transport, 0)
        self._generator = generator
        self._draws: list[float] = []
        self._last_t_ns = 0

    def arrival_t_ns(self, sample_t_ns: int) -> int:
        """Return when the next line is readable to its last byte: constant + exponential, on the host's USB grid."""
        if not self._draws:
            self._draws = self._generator.standard_exponential(_BLOCK).tolist()
            self._draws.reverse()
        arrival_t_ns = sample_t_ns + round(self._constant_ns + self._jitter_ns * self._draws.pop())
        if self._grid_ns:
            arrival_t_ns = -(-arrival_t_ns // self._grid_ns) * self._grid_ns
        self._last_t_ns = max(self._last_t_ns, arrival_t_ns)
        return self._last_t_ns
