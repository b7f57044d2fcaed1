"""What the servo rehearses before a cycle must leave no trace in it."""

from bench import replaying
from stagectl.backend import BatchTransport


def test_a_rehearsed_run_is_the_same_bit_for_bit(tmp_path, monkeypatch):
    plain = replaying.record("oled-printer-umd2", 3, tmp_path / "plain")
    rehearsed_count = 0

    def sleep(transport, deadline_t_ns, inbox):
        nonlocal rehearsed_count
        rehearsed_count += 1
        return True

    monkeypatch.setattr(BatchTransport, "sleep", sleep)
    rehearsed = replaying.record("oled-printer-umd2", 3, tmp_path / "rehearsed")
    assert rehearsed_count == rehearsed.rows.size == plain.rows.size > 1000
    assert rehearsed.rows.tobytes() == plain.rows.tobytes()
