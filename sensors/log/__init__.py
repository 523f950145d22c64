"""Recorded sensor streams and readings in one HDF5 file; `scripts/docs/reference/files.md` describes it.

`columns` says what a row of each table holds, `table` how rows lie in the file, `writer` and `reader` are what others
use; `stream` is one raw stream as the reader has it. h5py is loaded by these alone.
"""

from sensors.log.errors import LogError

__all__ = ["LogError"]
