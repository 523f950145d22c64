"""CPU time of a step of an environment and of its parts: python -m scripts.environment_steps [ID] [JSON of options]."""

import functools
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.environments import register
from rumi.robot.tool import Tool
from rumi.sim.world import World
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.simulated import SimTask

SEEDS, STEPS = range(1000, 1006), 15  # the first run loads what is compiled, and does not count


def timed(kind: type, name: str, seconds: dict[str, float]) -> None:
    """Add the CPU time of a method's calls to `seconds`."""
    method: Callable[..., Any] = getattr(kind, name)

    @functools.wraps(method)
    def measured(*values: Any, **options: Any) -> Any:  # noqa: ANN401  (the method's)
        start = time.process_time()
        try:
            return method(*values, **options)
        finally:
            seconds[f"{kind.__name__}.{name}"] += time.process_time() - start

    setattr(kind, name, measured)


def main(name: str, options: dict[str, Any]) -> None:
    """Run episodes by a policy that goes straight at the object, and print means."""
    torch.set_num_threads(1)
    register()
    seconds: dict[str, float] = defaultdict(float)
    env = gymnasium.make(name, cache_dir=cache_folder(), disable_env_checker=True, **{"conditions": "ideal", **options})
    inner: Any = env.unwrapped
    for kind, method in (
        (SimTask, "step"),
        (Tool, "free_path"),
        (World, "move"),
        (Rummager, "update"),
        (type(inner.view), "__call__"),
    ):
        timed(kind, method, seconds)
    random, taken = np.random.default_rng(0), []
    for seed in SEEDS:
        observation, info = env.reset(seed=seed)
        if seed == SEEDS[1]:
            taken.clear()
            seconds.clear()
        for step in range(STEPS):
            way = info["truth"][:2, 3] - observation["configuration"][:2]
            control = np.zeros(inner.inner_action_space.shape, np.float32)
            control[:2] = way / np.linalg.norm(way) + 0.3 * random.normal(size=2)
            if len(control) == 4:
                control[2] = -0.5 * (step < 2)
            control = control.clip(-1.0, 1.0)
            action = {"action": control, "prediction": np.zeros(6, np.float32)} if inner.predicts else control
            start = time.process_time()
            observation, _, terminated, truncated, info = env.step(action)
            taken.append(time.process_time() - start)
            if terminated or truncated:
                break
    print(
        f"{name} {options}: {len(taken)} steps, mean {1e3 * np.mean(taken):.1f} ms, median {1e3 * np.median(taken):.1f}"
    )
    for part, total in sorted(seconds.items(), key=lambda one: -one[1]):
        print(f"  {part:<20} {1e3 * total / len(taken):.1f} ms a step")


if __name__ == "__main__":
    name, options = sys.argv[1:2] or ["rumi/Mug-v0"], sys.argv[2:3] or ["{}"]
    script(lambda: main(name[0], json.loads(options[0])))
