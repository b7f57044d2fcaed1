"""Rows as an Arrow IPC stream: one message a batch, so that a cut file is whole up to its last whole message.

Each batch is an encapsulated message of its own (no dictionaries, LZ4 body), written behind the schema message;
the end marker says that the run was closed. Knows no run folder and no clock.
"""

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa

from stagectl.errors import RecordError
from stagectl.row import ROW, absent_value
from stagectl.units import unit_of

END_MARKER = bytes.fromhex("ffffffff00000000")
"""End of an Arrow IPC stream: continuation, then a length of zero."""

BATCH_NS = 200_000_000
"""Rows of this time make a batch: with a reader's poll of 50 ms a row is in the file within 0.25 s."""

BATCH_ROWS_COUNT = 2048
"""Longest batch, whatever the times of its rows say."""

_CHECKED_COUNT = 150
"""Batches at the end of a left file that are read whole: 15 s and more, far beyond what is not on the disk yet."""

_OPTIONS = pa.ipc.IpcWriteOptions(compression="lz4")
_ARROW_TYPES = {np.dtype("f8"): pa.float64(), np.dtype("i8"): pa.int64()}


@dataclass(frozen=True)
class Piece:
    """A whole batch of a samples file, the schema it came under, and where it ends in the file."""

    batch: pa.RecordBatch | None  # None for the schema message
    schema: pa.Schema
    end_bytes: int


def schema_of(fields: Sequence[str] | None = None) -> pa.Schema:
    """Return the Arrow schema of the given ROW fields (all by default), with the unit of each in its metadata."""
    columns = []
    for name in ROW.names or () if fields is None else fields:
        dtype = ROW[name]
        arrow_type = _ARROW_TYPES[dtype] if dtype.shape == () else pa.binary(dtype.itemsize)
        unit = unit_of(name)
        columns.append(pa.field(name, arrow_type, nullable=False, metadata={"unit": unit} if unit else None))
    return pa.schema(columns)


def to_batch(rows: np.ndarray, schema: pa.Schema) -> pa.RecordBatch:
    """Copy rows, shape (n,), to an Arrow batch of the fields of `schema`; every bit stays (nan payloads too)."""
    columns = [
        pa.Array.from_buffers(field.type, len(rows), [None, pa.py_buffer(np.ascontiguousarray(rows[field.name]))])
        for field in schema
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def encode_schema(schema: pa.Schema) -> bytes:
    """Return the message that opens a stream."""
    return schema.serialize().to_pybytes()


def encode_batch(batch: pa.RecordBatch) -> bytes:
    """Return one batch as a message of a stream whose schema is already written."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema, options=_OPTIONS) as writer:
        writer.write_batch(batch)
    opening = len(encode_schema(batch.schema))
    return sink.getvalue().to_pybytes()[opening : -len(END_MARKER)]


def scan(path: Path) -> Iterator[Piece]:
    """Yield the schema, then every whole batch of the file; ends silently where it is cut or damaged."""
    try:
        with open(path, "rb") as file:  # Arrow opens no path that is not UTF-8; nothing is read ahead, so tell() holds
            messages = pa.ipc.MessageReader.open_stream(pa.PythonFile(file, mode="r"))
            schema = None
            while True:
                try:
                    message = messages.read_next_message()
                    if schema is None:
                        schema = pa.ipc.read_schema(message)
                        batch = None
                    else:
                        batch = pa.ipc.read_record_batch(message, schema)
                        batch.validate()
                except (StopIteration, EOFError, pa.ArrowInvalid):
                    return
                except OSError as error:
                    if error.errno is not None:
                        raise
                    return  # Arrow's word for a message that is cut
                yield Piece(batch, schema, file.tell())
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error}; check folder, permissions and disk") from error


@dataclass(frozen=True)
class Extent:
    """What a samples file holds, without its rows."""

    schema: pa.Schema | None  # None where not even that is whole
    end_bytes: int  # of the last whole message
    rows_count: int
    first: pa.RecordBatch | None
    last: pa.RecordBatch | None


def extent(path: Path) -> Extent:
    """Return what a samples file holds up to its last whole batch; of all but the last batches headings only are read.

    What a process or a host left is damaged at its end: batches that had been on the disk for long are taken as they
    are. An hour at 1 kHz takes 1 s; to read its batches 13 s, to make rows of them, twice, 64 s. Errors: RecordError.
    """
    pieces = scan(path)
    opening = next(pieces, None)
    if opening is None:
        return Extent(None, 0, 0, None, None)
    end_bytes, rows_count = opening.end_bytes, 0
    first = next((piece.batch for piece in pieces if piece.batch is not None and len(piece.batch)), None)
    last = None
    try:
        with open(path, "rb") as file:
            spans = list(_spans(file, opening.end_bytes))
            unread = max(len(spans) - _CHECKED_COUNT, 0)
            if unread:
                rows_count, end_bytes = sum(span.rows_count for span in spans[:unread]), spans[unread - 1].end_bytes
            for span in spans[unread:]:
                batch = _batch_at(file, span, opening.schema)
                if batch is None:
                    break
                rows_count, end_bytes = rows_count + len(batch), span.end_bytes
                last = batch if len(batch) else last
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error}; check folder, permissions and disk") from error
    return Extent(opening.schema, end_bytes, rows_count, first, last)


@dataclass(frozen=True)
class _Span:
    """Where a message lies in the file, and how many rows its heading names."""

    begin_bytes: int
    end_bytes: int
    rows_count: int


def _spans(file: BinaryIO, begin_bytes: int) -> Iterator[_Span]:
    """Yield the messages from there on that the file is long enough for, by their headings."""
    size_bytes = os.fstat(file.fileno()).st_size
    while True:
        file.seek(begin_bytes)
        prefix = file.read(8)
        if len(prefix) < 8 or prefix[:4] != END_MARKER[:4] or prefix == END_MARKER:
            return
        metadata = file.read(struct.unpack("<i", prefix[4:])[0])
        try:
            body_bytes, rows_count = _heading(metadata)
        except struct.error:
            return
        end_bytes = begin_bytes + 8 + len(metadata) + body_bytes
        if body_bytes < 0 or end_bytes > size_bytes:
            return
        yield _Span(begin_bytes, end_bytes, rows_count)
        begin_bytes = end_bytes


def _heading(metadata: bytes) -> tuple[int, int]:
    """Return (length of the body, rows) of a record batch's message: Arrow's Message.fbs, bodyLength and header.length.

    A flatbuffer: a table begins with the way back to its vtable, which has the place of each field, 0 where it is
    absent. Errors: struct.error where there is no sense in it.
    """

    def field(table: int, slot: int) -> int:
        vtable = table - struct.unpack_from("<i", metadata, table)[0]
        (length,) = struct.unpack_from("<H", metadata, vtable)
        place = struct.unpack_from("<H", metadata, vtable + 4 + 2 * slot)[0] if 4 + 2 * slot < length else 0
        return table + place if place else 0

    def long(place: int) -> int:
        return struct.unpack_from("<q", metadata, place)[0] if place else 0

    (message,) = struct.unpack_from("<I", metadata)
    header = field(message, 2)
    batch = header + struct.unpack_from("<I", metadata, header)[0]
    return long(field(message, 3)), long(field(batch, 0))


def _batch_at(file: BinaryIO, span: _Span, schema: pa.Schema) -> pa.RecordBatch | None:
    """Read one batch; None where it is damaged."""
    file.seek(span.begin_bytes)
    try:
        batch = pa.ipc.read_record_batch(pa.ipc.read_message(file.read(span.end_bytes - span.begin_bytes)), schema)
        batch.validate()
    except (EOFError, pa.ArrowInvalid):
        return None
    except OSError as error:
        if error.errno is not None:
            raise
        return None  # Arrow's word for a message that is cut
    return batch


def is_closed(path: Path, end_bytes: int) -> bool:
    """Tell whether nothing but the end marker follows the last whole batch."""
    with open(path, "rb") as file:
        file.seek(end_bytes)
        return file.read(len(END_MARKER) + 1) == END_MARKER


def fill_rows(rows: np.ndarray, batch: pa.RecordBatch, place: str) -> None:
    """Write a batch into ROWs of the same length by name; fields that only one side has stay as they are.

    Bytes shorter than today's field are padded with zeros. Errors: RecordError where a field has another meaning.
    """
    for field in batch.schema:
        if field.name not in (ROW.names or ()):
            continue
        target = ROW[field.name]
        buffer = batch.column(field.name).buffers()[1]
        if target.shape == ():
            if field.type != _ARROW_TYPES[target]:
                raise RecordError(
                    f"{place}: {field.name} is {field.type} and {_ARROW_TYPES[target]} is expected; "
                    "read it with the version of stagectl that the manifest names"
                )
            rows[field.name] = np.frombuffer(buffer, target, len(batch))
            continue
        if not pa.types.is_fixed_size_binary(field.type) or field.type.byte_width > target.itemsize:
            raise RecordError(
                f"{place}: {field.name} is {field.type} and at most {target.itemsize} bytes are expected; "
                "read it with the version of stagectl that the manifest names"
            )
        width = field.type.byte_width
        rows[field.name][:, :width] = np.frombuffer(buffer, "u1", len(batch) * width).reshape(-1, width)


def batch_ends(t_ns: np.ndarray) -> list[int]:
    """Cut rows with these times into batches of BATCH_NS; return where each ends."""
    ends, start = [], 0
    while start < len(t_ns):
        window = t_ns[start : start + BATCH_ROWS_COUNT]
        outside = np.flatnonzero(window >= window[0] + BATCH_NS)
        start += int(outside[0]) if outside.size else len(window)
        ends.append(start)
    return ends


def empty_rows(count: int, schema: pa.Schema) -> np.ndarray:
    """Make rows, shape (count,), that say "absent" in the fields that `schema` lacks."""
    rows = np.zeros(count, ROW)
    for name in ROW.names or ():
        if schema.get_field_index(name) < 0 and absent_value(name) != 0:
            rows[name] = absent_value(name)
    return rows
