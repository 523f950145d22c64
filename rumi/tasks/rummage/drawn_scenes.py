"""The tasks whose scene the seed draws, by name; experiments on `SCENES` leave them out."""

import math
from dataclasses import replace

from rumi.tasks.rummage.scene_spec import DrawSpec, TaskSpec
from rumi.tasks.rummage.scenes import SCENES, large_handled_mug

DRAWN: dict[str, TaskSpec] = {
    "mug": TaskSpec(
        "mug",
        "a mug whose place, handle, mass and friction the seed draws",
        large_handled_mug,
        SCENES["mug-0"].start,
        draw=DrawSpec((0.97, 1.05), math.radians(20.0), math.radians(100.0), (0.2, 0.6)),
    ),
    "drill": replace(
        SCENES["drill-0"],
        name="drill",
        description="a drill that no camera sees, whose place, yaw, mass and friction the seed draws",
        draw=DrawSpec((0.96, 1.04), math.radians(4.0), math.pi, (0.6, 1.2)),
    ),
    "box": replace(
        SCENES["box-0"],
        name="box",
        description="a box that no camera sees, whose face, place, yaw, mass and friction the seed draws",
        draw=DrawSpec((0.88, 0.98), math.radians(4.0), math.pi, (0.3, 0.6)),
    ),
    "drawn-shelf-mug": replace(
        SCENES["shelf-mug"],
        name="drawn-shelf-mug",
        description="a mug on a shelf that a camera sees after every action, all else as of the task mug",
        draw=DrawSpec((0.80, 0.92), math.radians(10.0), math.radians(100.0), (0.2, 0.6)),
    ),
    "drawn-shelf-box": replace(
        SCENES["shelf-box"],
        name="drawn-shelf-box",
        description="a box that stands on a shelf where no camera sees it, whose place, yaw, mass and friction the "
        "seed draws",
        draw=DrawSpec((0.77, 0.93), math.radians(6.0), math.pi, (0.3, 0.6)),
    ),
}
"""Scenes that the seed draws, by name."""
