"""Rows as an Arrow IPC stream: one message a batch, so that a cut file is whole up to its last whole message.

Each batch is an encapsulated message of its own (no dictionaries, LZ4 body), written behind the schema message;
the end marker says that the run was closed. Knows no run folder and no clock.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

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
