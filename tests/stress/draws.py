"""What sweeps draw their inputs from: values at the edges of what can be, among ordinary ones."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3, so3

DTYPES = {"float32": torch.float32, "float64": torch.float64}


def uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Float[Tensor, "..."]:
    """Evenly between two numbers, float64."""
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def normal(generator: torch.Generator, *shape: int) -> Float[Tensor, "..."]:
    """Standard normal, float64."""
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def log_uniform(generator: torch.Generator, *shape: int, low: float, high: float) -> Float[Tensor, "..."]:
    """Evenly by their logarithm between two positive numbers."""
    return uniform(generator, *shape, low=math.log(low), high=math.log(high)).exp()


def integer(generator: torch.Generator, low: int, high: int) -> int:
    """A whole number from low to high, both included."""
    return int(torch.randint(low, high + 1, (), generator=generator))


def choice(generator: torch.Generator, options: Sequence[float]) -> float:
    """One of some numbers."""
    return float(options[integer(generator, 0, len(options) - 1)])


def mixed(generator: torch.Generator, parts: Sequence[Tensor]) -> Tensor:
    """Row by row one of some equally shaped tensors."""
    which = torch.randint(len(parts), parts[0].shape[:1], generator=generator)
    stacked = torch.stack(list(parts))
    return stacked[which, torch.arange(parts[0].shape[0])]


def directions(generator: torch.Generator, count: int) -> Float[Tensor, "n 3"]:
    """Unit vectors, a third of them along an axis."""
    free = torch.nn.functional.normalize(normal(generator, count, 3), dim=-1)
    axis = torch.eye(3, dtype=torch.float64)[torch.randint(3, (count,), generator=generator)]
    sign = torch.where(uniform(generator, count, 1) < 0.5, -1.0, 1.0).double()
    return mixed(generator, [free, free, axis * sign])


def angles(generator: torch.Generator, count: int) -> Float[Tensor, "n"]:
    """Angles from 0 to pi: any, near 0, near pi, and both ends themselves."""
    near_pi = math.pi - log_uniform(generator, count, low=1e-9, high=1e-1)
    near_zero = log_uniform(generator, count, low=1e-12, high=1e-1)
    ends = torch.where(uniform(generator, count) < 0.5, 0.0, math.pi).double()
    return mixed(generator, [uniform(generator, count, high=math.pi), near_pi, near_zero, ends])


def rotation_vectors(generator: torch.Generator, count: int) -> Float[Tensor, "n 3"]:
    """Rotation vectors of these angles about these directions."""
    return angles(generator, count)[:, None] * directions(generator, count)


def twists(generator: torch.Generator, count: int, metres: float = 1.0) -> Float[Tensor, "n 6"]:
    """Twists of up to some metres, a part of them tiny."""
    far = uniform(generator, count, 3, low=-metres, high=metres)
    near = far * log_uniform(generator, count, 1, low=1e-9, high=1.0)
    return torch.cat((mixed(generator, [far, near]), rotation_vectors(generator, count)), -1)


def poses(generator: torch.Generator, count: int, metres: float = 1.0) -> Float[Tensor, "n 4 4"]:
    """Transforms, float64, whose origins are within a box of some metres about 0."""
    place = uniform(generator, count, 3, low=-metres, high=metres)
    return se3.make(so3.exp(rotation_vectors(generator, count)), place)


def log_weights(generator: torch.Generator, rows: int, count: int) -> Float[Tensor, "n N"]:
    """Log-weights that are not normalised: of weights from 1e-300 to 1, equal ones, all but one zero, and offsets."""
    wide = uniform(generator, rows, count, low=math.log(1e-300), high=0.0)
    narrow = normal(generator, rows, count)
    equal = torch.zeros(rows, count, dtype=torch.float64)
    lone = torch.full((rows, count), -math.inf, dtype=torch.float64)
    lone[torch.arange(rows), torch.randint(count, (rows,), generator=generator)] = 0.0
    some = torch.where(uniform(generator, rows, count) < 0.5, -math.inf, narrow)
    some[:, 0] = 0.0
    shifted = narrow + uniform(generator, rows, 1, low=-1e4, high=1e4)
    return mixed(generator, [wide, narrow, equal, lone, some, shifted])
