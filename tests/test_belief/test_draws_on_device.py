"""Draws of the touch beliefs: on the generator's device, whatever the default is, and then where the belief is."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from rumi.belief.prior import PlanarPrior
from rumi.belief.static_filter import ResampleMoveFilter, ResampleMoveSettings
from rumi.belief.trajectory_belief import TouchAction
from rumi.belief.trajectory_filter import TrajectoryFilter, TrajectorySettings
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline
from rumi.information.contact_gain import add_noise
from rumi.information.neighbours import StateMetric
from sensors.touch.contact_model import ContactModel
from sensors.touch.rectangle_touch import RectangleTouches
from sensors.touch.touch_likelihood import TouchNoise

F64 = torch.float64
DRAWS = (torch.rand, torch.randn, torch.randint, torch.randperm)


class Spy(TorchFunctionMode):
    """Refuses draws that do not say that they are made where their generator is."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in DRAWS:
            self.drawn += 1
            assert kwargs.get("device") == kwargs["generator"].device, (func, kwargs)
        return func(*args, **kwargs)


def on(device: str) -> dict[str, Any]:
    mean, spread = torch.tensor([[0.0] * 3, [0.05, 0.05, 0.5]], dtype=F64, device=device)
    return {"dtype": F64, "device": device, "prior": PlanarPrior(mean[None], spread)}


def fixed(generator: torch.Generator, prior: PlanarPrior, **like: Any) -> Tensor:
    half = torch.tensor([0.1, 0.05], **like)
    point, normal = torch.tensor([[0.1, 0.0], [1.0, 0.0]], **like)
    touches = RectangleTouches.none(half, TouchNoise(), 0.01).with_touch(point, normal)
    settings = ResampleMoveSettings(trigger=1.0, moves=2)
    follow = ResampleMoveFilter(StateMetric.planar(0.1), prior.log_density, settings)
    belief = follow.start(prior.sample(40, generator=generator))
    return follow.update(belief, touches, touches, generator=generator)[0].states


def pushed(resampling: Any) -> Callable[..., Tensor]:
    def run(generator: torch.Generator, prior: PlanarPrior, **like: Any) -> Tensor:
        pusher = Pusher.disc(0.01, torch.zeros(2, 3, **like))
        settings = TrajectorySettings(resampling, trigger=1.0, noise=0.1)
        model, outline = ContactModel(0.9, 0.05, 200.0).to(like["device"]), RectangleOutline((0.1, 0.05))
        follow = TrajectoryFilter(outline, torch.zeros(2, **like), pusher, model, prior, settings)
        path = torch.tensor([[[0.2, 0.0, 0.0], [0.1, 0.0, 0.0], [0.08, 0.0, 0.0]]], **like)
        action = TouchAction(path, torch.tensor([[False, True]], device=like["device"]))
        return follow.step(follow.initial(2, 20, generator=generator), [action], generator=generator)[0].pose

    return run


def noisy(generator: torch.Generator, prior: PlanarPrior, **like: Any) -> Tensor:
    points = torch.eye(2, **like)
    return torch.stack(add_noise(points, points, TouchNoise(), generator=generator))


OPERATIONS: dict[str, Callable[..., Tensor]] = {
    "fixed": fixed,
    "replayed": pushed("replay"),
    "newcomers": pushed("newcomers"),
    "noise of a touch": noisy,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_draws_are_made_where_the_generator_is(name: str) -> None:
    with Spy() as spy:
        found = OPERATIONS[name](torch.Generator().manual_seed(0), **on("cpu"))
    assert spy.drawn > 0 and found.device.type == "cpu"


@pytest.mark.gpu
@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("of", ["cpu", "cuda"])
def test_a_belief_on_a_gpu_takes_a_generator_of_either_device(name: str, of: str) -> None:
    found = OPERATIONS[name](torch.Generator(of).manual_seed(0), **on("cuda"))
    assert found.device.type == "cuda" and bool(found.isfinite().all())
