"""Arrays of real numbers in NumPy's files, .npz and .npy."""

import io

import numpy as np


def read_arrays(data: bytes, *names: str) -> dict[str, np.ndarray]:
    """Arrays of real numbers by name, those of `names` that are there; pickles are refused.

    Args:
        data: an .npz file, or an .npy file, whose one array has the first name.
        names: of arrays.

    Raises:
        ValueError: it is neither of the two, or an array is of no real numbers; `sdf.cache.DAMAGED` has what else a
            damaged file may raise.
    """
    if not data.startswith((b"PK", b"\x93NUMPY")):
        raise ValueError("expected an archive of arrays, as numpy.savez writes it, or a NumPy array, and it is neither")
    loaded = np.load(io.BytesIO(data), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        arrays = {names[0]: loaded}
    else:
        with loaded:
            arrays = {name: loaded[name] for name in names if name in loaded}
            if not arrays:
                raise ValueError(f"expected one of the arrays {', '.join(names)}, found {', '.join(loaded) or 'none'}")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"expected `{name}` to be real numbers, got {array.dtype}")
    return arrays
