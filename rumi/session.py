"""Runs of a batch of scenes side by side: `rumi.loop.run` for each, step in and step out."""

from collections.abc import Callable, Sequence
from functools import partial
from operator import methodcaller
from typing import Any

from rumi.agent import Agent, StopReason
from rumi.loop import Episode, carry_out, episode
from rumi.task import Task


class Session:
    """Runs of a batch of scenes, step in and step out: readings go in, actions come out, whoever asks carries them out.

    A scene's run is what it is alone, to the bit: nothing is shared, and what is decided, skipped or over is so by
    scene. They think one after the other. Of the clock's stages, "simulate" is how long a scene waited for a reading,
    for the others' thoughts too.

    Args:
        agents: of each scene; the same one may be of many.
        seeds: of each scene's randomness.
        steps: actions at most, of each; None for as many as an agent allows itself.
        on_step: called with a scene's number and the record of its step.

    Attributes:
        results: of each scene, the agent's `result`; None while it goes on.
        stopped_by: why each ended; None while it goes on.

    Raises:
        ValueError: there are not as many seeds as agents.
    """

    def __init__(
        self,
        agents: Sequence[Agent[Any]],
        *,
        seeds: Sequence[int],
        steps: int | None = None,
        on_step: Callable[[int, Any], None] = lambda scene, record: None,
    ) -> None:
        if len(agents) != len(seeds):
            raise ValueError(f"Expected an agent and a seed for each scene, got {len(agents)} and {len(seeds)}")
        self.results: list[Any] = [None] * len(agents)
        self.stopped_by: list[StopReason | None] = [None] * len(agents)
        self._runs: list[Episode | None] = []
        for scene, (agent, seed) in enumerate(zip(agents, seeds, strict=True)):
            run = episode(agent, seed=seed, steps=steps, on_step=partial(on_step, scene))
            next(run)
            self._runs.append(run)

    def step(self, readings: Sequence[Any]) -> list[Any]:
        """The next action of each scene; None for those that are over, a `Last` for the last one of a scene.

        Args:
            readings: of each scene what came of its action, at first the first reading; of one that is over, anything.

        Raises:
            ValueError: there are not as many as scenes.
        """
        if len(readings) != len(self._runs):
            raise ValueError(f"Expected a reading for each of {len(self._runs)} scenes, got {len(readings)}")
        actions: list[Any] = []
        for scene, reading in enumerate(readings):
            actions.append(self._on(scene, methodcaller("send", reading)))
            if self.stopped_by[scene] == "interrupted":  # Ctrl-C while one thinks is meant for all
                self.interrupt()
                return [None] * len(readings)
        return actions

    def interrupt(self) -> None:
        """End all scenes with what they have, as Ctrl-C does.

        Raises:
            KeyboardInterrupt: a scene has no reading yet.
        """
        for scene in range(len(self._runs)):
            self._on(scene, methodcaller("throw", KeyboardInterrupt))

    def _on(self, scene: int, go: Callable[[Episode], Any]) -> Any:  # noqa: ANN401  (an action)
        run = self._runs[scene]
        if run is None:
            return None
        try:
            return go(run)
        except StopIteration as ended:
            self._runs[scene] = None
            self.stopped_by[scene], self.results[scene] = ended.value
        return None


def run_scenes(
    tasks: Sequence[Task],
    agents: Sequence[Agent[Any]],
    *,
    seeds: Sequence[int],
    steps: int | None = None,
    on_step: Callable[[int, Any], None] = lambda scene, record: None,
) -> list[Any]:
    """Let agents do tasks, a scene each, side by side (`Session`); their results.

    Same seeds, same tasks, same device and no budget: the same runs, byte for byte, each as alone. Ctrl-C ends all with
    what they have.

    Args:
        tasks: simulators, hardware or logs.
        agents: what they believe and do, one a task; the same one may be of many.
        seeds: of all randomness, one a task.
        steps: actions at most, of each; None for as many as an agent allows itself.
        on_step: called with a scene's number and the record of every step of it, the first reading's included.

    Raises:
        ValueError: there are not as many tasks, agents and seeds.
    """
    if len(tasks) != len(agents):
        raise ValueError(f"Expected an agent for each of {len(tasks)} tasks, got {len(agents)}")
    session = Session(agents, seeds=seeds, steps=steps, on_step=on_step)
    try:
        actions = session.step([task.reset(seed) for task, seed in zip(tasks, seeds, strict=True)])
        while any(action is not None for action in actions):
            pairs = zip(tasks, actions, strict=True)
            actions = session.step([None if action is None else carry_out(task, action) for task, action in pairs])
    except KeyboardInterrupt:
        session.interrupt()
    return session.results
