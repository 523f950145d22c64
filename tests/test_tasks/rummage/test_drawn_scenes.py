"""Scenes whose pose, mass and friction the seed draws."""

import math

import pytest
import torch

from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.objects import ObjectSettings, with_object
from rumi.tasks.rummage.scenes import SCENES, find_task, make_tool


@pytest.mark.parametrize("name", DRAWN)
def test_what_is_drawn_lies_within_the_ranges_and_is_the_seeds_own(name):
    spec = find_task(name)
    scenes = [spec.drawn(seed) for seed in range(300)]
    assert scenes == [spec.drawn(seed) for seed in range(300)]
    assert len({scene.start for scene in scenes}) == 300 and {scene.start_up for scene in scenes} == set(spec.up)
    for scene in scenes:
        x, y, yaw = scene.start
        ahead = (x - spec.base[0], y - spec.base[1])
        assert spec.draw.distance_m[0] <= math.hypot(*ahead) <= spec.draw.distance_m[1]
        assert abs(math.atan2(ahead[1], ahead[0]) - spec.base[2]) <= spec.draw.bearing_rad
        away = 0.0 if spec.camera is None else math.atan2(y - spec.camera.position[1], x - spec.camera.position[0])
        assert abs(math.remainder(yaw - away, 2 * math.pi)) <= spec.draw.turn_rad + 1e-9
        assert spec.draw.mass_kg[0] <= scene.physics.mass_kg <= spec.draw.mass_kg[1]
        assert spec.draw.friction[0] <= scene.physics.friction <= spec.draw.friction[1]


def test_scenes_of_before_are_not_drawn():
    assert all(spec.drawn(seed) is spec for spec in SCENES.values() for seed in (0, 7))
    assert not DRAWN.keys() & SCENES.keys()


def test_what_is_asked_for_is_not_drawn():
    spec, _ = with_object(find_task("mug"), ObjectSettings(mass_kg=0.3))
    assert {spec.drawn(seed).physics.mass_kg for seed in range(5)} == {0.3}
    assert len({spec.drawn(seed).physics.friction for seed in range(5)}) == 5


@pytest.mark.sim
@pytest.mark.parametrize("name", DRAWN)
def test_the_simulator_puts_the_object_where_its_seed_has_it(name):
    task = make_task(name, tool=make_tool(find_task(name), free_flying=True))
    for seed in (3, 4, 3):
        scene, result = find_task(name).drawn(seed), task.reset(seed)
        torch.testing.assert_close(result.truth[:2, 3], torch.tensor(scene.start[:2]), atol=1e-3, rtol=0)
        assert (task.world.physics.mass_kg, task.world.physics.friction) == (
            scene.physics.mass_kg,
            scene.physics.friction,
        )
