"""Profiles edited to nonsense, drawn from a seed: the true text with one thing wrong, and what must be said of it.

None of them is a profile, by what a profile's keys are there for; nothing here asks who reads it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stagectl.profile import PROFILES_FOLDER
from tests.faults.draws import one_of

# fmt: off
_OPTIONAL = frozenset((
    "predicted_samples_count", "bitrate_bit_per_s", "temperature", "temperature_degc", "pressure_pa", "co2_ppm",
    "relative_humidity_percent", "subindex", "force_noise_n", "mode", "standstill", "endian", "checksum", "incremental",
    "micro_bandwidth_hz", "eta_ratio", "gamma_ratio", "sliding_ratio", "micro_drift_n_per_sqrt_s", "rest_drift_ratio",
    "travel_drift_n_per_sqrt_m", "adaptive_gain_ceiling_ratio", "park_error_m",
))
# fmt: on
"""Keys without which a profile may still be one."""
_SIGNED = frozenset(("warning_degc", "temperature_degc"))
_KIND_KEYS = frozenset(("name", "format"))  # by these it is known which keys there are
_OTHER_UNIT = {"m": "mm", "s": "ms", "kg": "g", "hz": "khz", "n": "kn", "a": "ma", "pa": "bar"}
_SENTENCE = re.compile(r"^(kept as it was: )?\S+\.toml: .+; .+")
_KEY = re.compile(r"(?<![\w.#])(?P<key>[a-z]\w*) = (?P<value>\"[^\"\n]*\"|\[[^\[\]{}\n]*\]|[-+\w.]+)")
_HEADER = re.compile(r"^\[+(?P<table>[\w.]+)\]+", re.MULTILINE)


@dataclass(frozen=True)
class Nonsense:
    """What stands in a profile's place."""

    what: str
    named: tuple[str, ...]
    """What a refusal must name, in one sentence."""
    content: bytes | None = None  # None: there is no file
    is_folder: bool = False

    def put(self, path: Path) -> None:
        """Put it where the profile is."""
        path.unlink()
        if self.is_folder:
            path.mkdir()
        elif self.content is not None:
            path.write_bytes(self.content)

    def missed(self, said: list[str]) -> list[str]:
        """Return what is wrong with what was said when it was read: a refusal names place, value, limit and remedy."""
        if not said:
            return [f"nobody said that {self.what} was read"]
        return [f"{self.what}: said was {text[:500]!r}" for text in said if not self._refused_by(text)]

    def _refused_by(self, text: str) -> bool:
        clear = [line for line in text.splitlines() if _SENTENCE.match(line)]
        return text.startswith("kept as it was: ") and any(all(name in line for name in self.named) for line in clear)


@dataclass(frozen=True)
class _Entry:
    """A key of a profile's text, with its table, and where in the text it is."""

    table: str
    key: str
    value: str
    begin: int
    value_begin: int
    end: int
    is_line: bool  # begins one; the others are in tables of one line

    @property
    def place(self) -> str:
        return f"{self.table}.{self.key}" if self.table else self.key


def _entries(text: str) -> list[_Entry]:
    found: list[_Entry] = []
    table = ""
    at = 0
    for line in text.splitlines(keepends=True):
        header = _HEADER.match(line)
        table = header["table"] if header else table
        said = line.partition("#")[0]
        for match in _KEY.finditer(said):
            begin, value_begin, end = (at + one for one in (match.start(), match.start("value"), match.end()))
            found.append(_Entry(table, match["key"], match["value"], begin, value_begin, end, match.start() == 0))
        at += len(line)
    return found


def _is_number(one: _Entry) -> bool:
    return one.value[0] not in '"[' and one.value not in ("true", "false")


def _with_value(text: str, one: _Entry, value: str, *named: str) -> Nonsense:
    content = text[: one.value_begin] + value + text[one.end :]
    return Nonsense(f"{one.place} = {value}", (one.table, one.key, *named), content.encode())


def wrong_number(rng: np.random.Generator, text: str) -> Nonsense:
    """Write what is no number, or one that nothing has."""
    one = one_of(rng, [one for one in _entries(text) if _is_number(one)])
    writings = [("nan", "= nan"), ("-inf", "= -inf"), ("1e30", "= 1e+30"), ('"12"', '= "12"'), ("true", "= true")]
    writings += [("[1.0]", "= [1.0]"), ("1979-05-27", "= 1979-05-27"), ("1" + "0" * 400, "bits")]
    if one.key not in _SIGNED and one.value[0] != "-":
        writings.append(("-1", "= -1"))
    value, named = one_of(rng, writings)
    return _with_value(text, one, value, named)


def wrong_text(rng: np.random.Generator, text: str) -> Nonsense:
    """Write a number for a word, or a word that nothing is called."""
    one = one_of(rng, [one for one in _entries(text) if one.value[0] == '"'])
    value = one_of(rng, ("3", "nan", '"no such thing"', '""', "[]", r'"\u001b[31m\u0000"'))
    return _with_value(text, one, value, "= ")


def wrong_list(rng: np.random.Generator, text: str) -> Nonsense:
    """Give the ends of a range in disorder, or no range."""
    one = one_of(rng, [one for one in _entries(text) if one.value[0] == "["])
    low, high = one.value.strip("[]").split(", ")
    value = one_of(
        rng, (f"[{high}, {low}]", f"[{low}]", f"[nan, {high}]", f"[{low}, {high}, 1.0]", "{}", f"[{low}, {low}]")
    )
    return _with_value(text, one, value)


def other_unit(rng: np.random.Generator, text: str) -> Nonsense:
    """Rename a key to another unit."""
    one = one_of(rng, [one for one in _entries(text) if one.key.rpartition("_")[2] in _OTHER_UNIT and "_" in one.key])
    stem, _, unit = one.key.rpartition("_")
    return _renamed(text, one, f"{stem}_{_OTHER_UNIT[unit]}")


def misspelt(rng: np.random.Generator, text: str) -> Nonsense:
    """Leave a letter of a key out, or write it twice."""
    one = one_of(rng, [one for one in _entries(text) if len(one.key) > 3])
    at = int(rng.integers(1, len(one.key) - 1))
    key = one.key[:at] + one.key[at + 1 :] if rng.random() < 0.5 else one.key[:at] + one.key[at] + one.key[at:]
    return _renamed(text, one, key)


def _renamed(text: str, one: _Entry, key: str) -> Nonsense:
    content = text[: one.begin] + key + text[one.begin + len(one.key) :]
    named = (one.key, "is missing") if one.is_line and one.table and one.key in _KIND_KEYS else (key,)
    return Nonsense(f"{one.place} called {key}", (one.table, *named), content.encode())


def no_key(rng: np.random.Generator, text: str) -> Nonsense:
    """Take a line's key out."""
    one = one_of(rng, [one for one in _entries(text) if one.is_line and one.key not in _OPTIONAL])
    line_end = text.index("\n", one.end) + 1
    return Nonsense(
        f"no {one.place}", (one.table, one.key, "is missing"), (text[: one.begin] + text[line_end:]).encode()
    )


def doubled_key(rng: np.random.Generator, text: str) -> Nonsense:
    """Write a line's key twice."""
    one = one_of(rng, [one for one in _entries(text) if one.is_line])
    again = f"{one.key} = {one.value}\n"
    content = text[: one.begin] + again + text[one.begin :]
    line = text.count("\n", 0, one.begin) + 2
    return Nonsense(f"{one.place} twice", (f"line {line}",), content.encode())


def no_table(rng: np.random.Generator, text: str) -> Nonsense:
    """Take a table out, or call it otherwise."""
    headers = [one for one in _HEADER.finditer(text) if one["table"] != "effects"]
    one = one_of(rng, headers)
    following = [other.start() for other in _HEADER.finditer(text) if other.start() > one.start()]
    if rng.random() < 0.5:
        content = text[: one.start()] + text[following[0] :]
        return Nonsense(f"no [{one['table']}]", (one["table"],), content.encode())
    name = one["table"] + "s"
    content = text[: one.start("table")] + name + text[one.end("table") :]
    return Nonsense(f"[{one['table']}] called [{name}]", (one["table"],), content.encode())


def no_text(rng: np.random.Generator, text: str) -> Nonsense:
    """Put bytes in it that are no UTF-8, or no TOML."""
    content = text.encode()
    at = int(rng.integers(len(content)))
    odd, named = one_of(rng, ((b"\xff", "is not UTF-8"), (b"\xed\xa0\x80", "is not UTF-8"), (b"\x00", "is not TOML")))
    return Nonsense(f"bytes {odd.hex()} at {at}", (named,), content[:at] + odd + content[at:])


def cut(rng: np.random.Generator, text: str) -> Nonsense:
    """Cut it off before the last table that it needs."""
    content = text.encode()
    at = int(rng.integers(1, text.index("\n[control]")))
    return Nonsense(f"cut behind {at} bytes", (), content[:at])


def no_file(rng: np.random.Generator, text: str) -> Nonsense:
    """Leave nothing, a folder, or what is no profile at all."""
    return one_of(
        rng,
        (
            Nonsense("empty", ("is missing",), b""),
            Nonsense("no file", ("No such file",)),
            Nonsense("a folder", ("Is a directory",), is_folder=True),
            Nonsense("noise", (), b"\x80" + rng.bytes(4096)),
            Nonsense("a drive's EDS", (), (PROFILES_FOLDER / "stagectl-linear-motor.eds").read_bytes()),
            Nonsense("nested", ("nested",), b"x = " + b"[" * 100_000),
            Nonsense("name = 3", ("name",), b"name = 3\n"),
        ),
    )


DRAWS: tuple[Callable[[np.random.Generator, str], Nonsense], ...] = (
    wrong_number,
    wrong_number,
    wrong_text,
    wrong_list,
    other_unit,
    misspelt,
    no_key,
    doubled_key,
    no_table,
    no_text,
    cut,
    no_file,
)


def nonsense(rng: np.random.Generator, profile: str) -> Nonsense:
    """Draw what a shipped profile is edited to."""
    return one_of(rng, DRAWS)(rng, (PROFILES_FOLDER / f"{profile}.toml").read_text())
