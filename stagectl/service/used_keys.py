"""Keys of requests: the same key is the same request, and what was asked for once is never done a second time.

What the last thousand keys were used for is remembered with its answer. Of all before them, since the service began, it
is remembered that they were used, in memory of one size: a filter that forgets no key, and takes few for used that are
new. After two million commands that is one new key in 200,000, after six million one in 200; another key helps.
"""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

ANSWERS_COUNT = 1000
"""Of how many keys the answers are remembered."""

_FILTER_BYTES = 1 << 23
_BITS_PER_KEY = 8
_BYTES_PER_BIT = 4  # of a digest, to say which bit


def digest(asked: BaseModel | str) -> bytes:
    """Return what tells one request from another."""
    text = asked if isinstance(asked, str) else asked.model_dump_json()
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).digest()


@dataclass(frozen=True, slots=True)
class Used:
    """What a key was used for."""

    name: str
    digest: bytes
    answer: Any

    def is_for(self, name: str, asked: BaseModel | str) -> bool:
        """Tell whether this is the same request."""
        return self.name == name and self.digest == digest(asked)


class UsedKeys:
    """All keys that were used since the service began; never grows."""

    def __init__(self) -> None:
        """None was used yet."""
        self._newest: OrderedDict[str, Used] = OrderedDict()
        self._filter = bytearray(b"\0" * _FILTER_BYTES)  # written to now, so that the memory is taken now

    def find(self, key: str) -> Used | None:
        """Return what a key was used for, where that is remembered."""
        return self._newest.get(key)

    def was_used_long_ago(self, key: str) -> bool:
        """Tell whether a key was used and its answer is forgotten; may be wrong for a new one, never for a used one."""
        return all(self._filter[bit >> 3] & (1 << (bit & 7)) for bit in _bits(key))

    def keep(self, key: str, used: Used) -> None:
        """Remember what a new key was used for."""
        self._newest[key] = used
        while len(self._newest) > ANSWERS_COUNT:
            oldest, _ = self._newest.popitem(last=False)
            for bit in _bits(oldest):
                self._filter[bit >> 3] |= 1 << (bit & 7)


def _bits(key: str) -> list[int]:
    content = hashlib.blake2b(key.encode(), digest_size=_BITS_PER_KEY * _BYTES_PER_BIT).digest()
    places = range(0, len(content), _BYTES_PER_BIT)
    return [int.from_bytes(content[k : k + _BYTES_PER_BIT], "big") % (8 * _FILTER_BYTES) for k in places]
