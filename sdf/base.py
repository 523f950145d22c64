"""Base class of signed distance functions: callables on object-frame points."""

import math
from contextlib import nullcontext
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sdf.check import is_eager


class SDFQuery(NamedTuple):
    """Signed distance and its gradient at some points.

    Attributes:
        distance: (*b), metres, positive outside.
        gradient: (*b, 3), d distance / d point in the object frame, pointing outward.
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]


class SDF(nn.Module):
    """Signed distance function of one rigid object, in the object's own frame.

    Members implement `distance` (value only, differentiable) and `forward` (value and gradient).
    `bounds` (2, 3), metres, is an axis-aligned box that holds the object.
    """

    bounds: Float[Tensor, "2 3"]

    def __init__(self, bounds: Float[Tensor, "2 3"]) -> None:
        super().__init__()
        self.register_buffer("bounds", bounds)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance of object-frame points, metres; autograd reaches the points."""
        raise NotImplementedError  # abstract: every member has one

    def forward(self, points_o: Float[Tensor, "*b 3"]) -> SDFQuery:
        """Signed distance and outward gradient of object-frame points (*b, 3).

        Where grad is enabled, autograd goes through both to the points and to the member's own tensors.
        """
        if not is_eager():
            found: tuple[Any, ...] = torch.func.vjp(self.distance, points_o)
            return SDFQuery(found[0], found[1](torch.ones_like(found[0]))[0])
        graph = torch.is_grad_enabled() and any(t.requires_grad for t in (points_o, *self.tensors()))
        # a gradient is needed in inference mode too, and there no tensor has any
        mode = torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext()
        with mode, torch.enable_grad():
            if graph and points_o.requires_grad:
                points = points_o
            else:
                points = (points_o.clone() if points_o.is_inference() else points_o).detach().requires_grad_()
            distance = self.distance(points)
            (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=graph)
        return SDFQuery(distance if graph else distance.detach(), gradient)

    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors that a look-up draws on, trained or not."""
        return (*self.buffers(), *self.parameters())

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, metres (the papers' l_c)."""
        return float((self.bounds[1] - self.bounds[0]).norm())


class Sized(SDF):
    """An SDF with numbers that are no tensors: its state carries them, and fits only a member that has the same."""

    numbers: ClassVar[tuple[str, ...]]
    """Names of the attributes, each a number or a tuple of numbers."""

    def get_extra_state(self) -> dict[str, list[float]]:
        """The numbers, for `state_dict`."""
        return {name: self._numbers(name) for name in self.numbers}

    def set_extra_state(self, state: dict[str, list[float]]) -> None:
        """Refuse the state of another size or lattice; tensors of equal shapes have been loaded by then.

        Raises:
            ValueError: with the number that differs.
        """
        for name in self.numbers:
            own, loaded = self._numbers(name), state.get(name, [])
            alike = len(own) == len(loaded) and all(
                math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9) for a, b in zip(own, loaded, strict=True)
            )
            if not alike:
                raise ValueError(
                    f"Expected the state of a {type(self).__name__} with {name} {own}, got {loaded}: make one with the "
                    "same numbers to load it into"
                )

    def _numbers(self, name: str) -> list[float]:
        value = getattr(self, name)
        return [float(x) for x in value] if isinstance(value, tuple) else [float(value)]
