"""An .rrd file as tables: one for each entity, rows in the order of time. Every way in which that fails is named."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from rerun.chunk import Chunk, RrdReader

from common.messages import F64

MAGIC = b"RRF"
"""How every recording of Rerun begins."""
TIME = "t"
_OF_RERUN = ("rerun.controls.RowId", "log_time", "log_tick", "frame")


class ReviewError(ValueError):
    """A recording that cannot be reviewed; the text says why and what to do."""


def chunks(path: Path, content: Sequence[str]) -> Iterator[Chunk]:
    """Every chunk of the entities named, in the order of the file.

    Raises:
        ReviewError: no such file, no recording, or one that is cut short.
    """
    try:
        with path.open("rb") as f:
            head = f.read(4)
    except FileNotFoundError:
        raise ReviewError(
            f"{path}: no such recording; `forefield run --scenario demo --record {path}` makes one"
        ) from None
    except OSError as e:
        raise ReviewError(f"{path}: cannot be read: {e.strerror}") from None
    if not head.startswith(MAGIC):
        raise ReviewError(f"{path}: {'empty' if not head else 'no Rerun recording (.rrd)'}; give what --record wrote")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without an index is read all the same
        try:
            reader = RrdReader(path)
            if not reader.recordings():
                raise ReviewError(f"{path}: holds a layout but no recording; give what --record wrote")
            yield from reader.stream().filter(content=list(content))
        except (RuntimeError, ValueError, OSError) as e:
            if isinstance(e, ReviewError):
                raise
            text = str(e)
            if "exceeds file size" in text or "too small" in text or "end of file" in text.lower():
                raise ReviewError(
                    f"{path}: cut short, as by a crash while it was written; `forefield repair {path}` makes it whole"
                ) from None
            raise ReviewError(f"{path}: damaged: {text.splitlines()[0].rpartition(': ')[2]}") from None


def read(paths: Sequence[Path], content: Sequence[str]) -> dict[str, pa.Table]:
    """The entities named that hold anything, of all pieces together: path → table, sorted by `t` where it has times.

    Raises:
        ReviewError: see `chunks`.
    """
    found: dict[str, list[pa.RecordBatch]] = {}
    for chunk in itertools.chain.from_iterable(chunks(path, content) for path in paths):
        batch = chunk.to_record_batch()
        batch = batch.select([n for n in batch.schema.names if n not in _OF_RERUN])
        found.setdefault(chunk.entity_path, []).append(batch.replace_schema_metadata(None))
    return {entity: _sorted(batches) for entity, batches in found.items()}


def _sorted(batches: list[pa.RecordBatch]) -> pa.Table:
    plain = [pa.Table.from_arrays(b.columns, schema=_plain(b.schema)) for b in batches]
    table = pa.concat_tables(plain, promote_options="default").combine_chunks()
    if TIME not in table.schema.names:
        return table
    order = np.argsort(times(table), kind="stable")
    return table.take(order) if np.any(np.diff(order) != 1) else table


def _plain(schema: pa.Schema) -> pa.Schema:
    return pa.schema([pa.field(f.name, f.type) for f in schema])


def times(table: pa.Table) -> F64:
    """Time of each row [s] of the recording."""
    return np.asarray(table.column(TIME).cast(pa.int64()).to_numpy()) * 1e-9


def numbers(table: pa.Table, column: str) -> tuple[np.ndarray, np.ndarray]:
    """A column of lists as all its values and the offsets of each row's, [n + 1]."""
    if column not in table.schema.names or not table.num_rows:
        return np.zeros(0), np.zeros(table.num_rows + 1, dtype=np.int64)
    array = table.column(column).combine_chunks()
    array = array.chunk(0) if isinstance(array, pa.ChunkedArray) else array
    lengths = np.asarray(array.value_lengths().fill_null(0).to_numpy(zero_copy_only=False))
    flat = array.flatten()
    return np.asarray(flat.to_numpy(zero_copy_only=False)), np.concatenate(([0], np.cumsum(lengths)))


def split(table: pa.Table, column: str) -> list[np.ndarray]:
    """A column of lists as one array for each row."""
    values, offsets = numbers(table, column)
    return [values[a:b] for a, b in itertools.pairwise(offsets)]


def strings(table: pa.Table, column: str) -> list[str]:
    """The first string of each row; empty where there is none."""
    if column not in table.schema.names:
        return [""] * table.num_rows
    return [row[0] if row else "" for row in table.column(column).to_pylist()]
