"""Gymnasium environments of the rummaging tasks; importing this registers them.

    import gymnasium
    import rumi.environments

    env = gymnasium.make("rumi/Mug-v0", view="particles")
    envs = gymnasium.make_vec("rumi/Mug-v0", num_envs=4, vectorization_mode="sync")

"rumi/Rummage-v0" takes any rummaging task by its name, as in `gymnasium.make("rumi/Rummage-v0", task="shelf-mug")`.
"""

from sdf.extras import optional

IDS = {"rumi/Mug-v0": "mug", "rumi/Drill-v0": "drill", "rumi/Box-v0": "box", "rumi/Rummage-v0": None}
"""Tasks by the id of their environment; each seed draws a scene of its own. None: the task is named when it is made."""


def register() -> None:
    """Enter the environments in gymnasium's registry; it may be called again."""
    gymnasium = optional("gymnasium", "An environment")
    for name, task in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="rumi.environments.rummage:RummageEnv",
                kwargs={} if task is None else {"task": task},
            )


register()
