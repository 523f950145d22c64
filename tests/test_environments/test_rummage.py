"""The environments: gymnasium's own checks, the same runs as the loop's, seeds, predictions, vectors of them."""

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

import gymnasium
from gymnasium.utils.env_checker import check_env

import rumi
import rumi.environments
from rumi.environments.rummage import PoseLoss, pose_of, vector_of
from rumi.environments.views import VIEWS
from rumi.errors import UsageError
from rumi.runs.replay import digest
from sdf import se3
from sdf.symmetry import Symmetries

pytestmark = pytest.mark.sim
SMALL = {"initialise.particles": 12, "initialise.starts": 40, "initialise.polished": 12, "steps": 3}


def make(name="rumi/Mug-v0", cache=None, **options):
    return gymnasium.make(name, cache_dir=cache, disable_env_checker=True, **SMALL, **options)


@pytest.mark.parametrize("view", list(VIEWS))
def test_gymnasium_finds_nothing_wrong(cache, view):
    env = make(cache=cache, view=view)
    with pytest.warns(UserWarning) as said:
        check_env(env.unwrapped)
    hints = ("infinity", "symmetric")  # positions have no bounds
    told = [str(one.message) for one in said if issubclass(one.category, UserWarning)]  # not what others leave open
    assert not [message for message in told if not any(hint in message for hint in hints)]
    env.close()


@pytest.mark.parametrize("name", ["rumi/Drill-v0", "rumi/Box-v0"])
def test_tasks_in_space_have_four_controls(all_in_reach, name):
    env = make(name, all_in_reach)
    observation, info = env.reset(seed=3)
    assert env.action_space.shape == (4,) and env.observation_space.contains(observation)
    observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation) and np.isfinite(info["truth"]).all()
    env.close()


def test_an_episode_is_the_run_of_its_seed(cache):
    settings = rumi.preset("default", task="mug", seed=7, method="slide", **SMALL)
    beliefs, controls = [], []

    def keep(step):
        beliefs.append(digest(step.belief))
        controls.append(step.control)

    with rumi.build(settings, cache_dir=cache) as (task, agent):
        rumi.run(task, agent, seed=7, steps=3, on_step=keep)
    env = make(cache=cache)
    env.reset(seed=7)
    assert digest(env.unwrapped.state.record.belief) == beliefs[0]
    for control, belief in zip(controls[1:], beliefs[1:], strict=True):
        *_, terminated, truncated, info = env.step(control.numpy())
        assert digest(env.unwrapped.state.record.belief) == belief
    assert terminated or (truncated and info["contacts"] >= 0)
    env.close()


def test_a_seed_is_a_scene_and_others_follow(cache):
    env = make("rumi/Rummage-v0", cache, task="mug", view="reading", predicts=False)
    scenes = [env.reset(seed=seed)[1]["truth"] for seed in (5, 6, 5)]
    assert np.array_equal(scenes[0], scenes[2]) and not np.allclose(scenes[0], scenes[1])
    following = [env.reset()[1]["truth"] for _ in range(2)]
    assert not np.allclose(*following)
    env.reset(seed=5)
    assert np.array_equal(env.reset()[1]["truth"], following[0]), "the seed decides those that follow"
    env.close()


def test_a_prediction_is_paid_by_its_loss(cache):
    env = make(cache=cache, view="reading")
    _, info = env.reset(seed=4)
    target = info["prediction"]["target"]
    assert np.allclose(pose_of(torch.as_tensor(target)), info["truth"], atol=1e-5)
    action = {"action": np.zeros(3, np.float32), "prediction": target}
    assert env.action_space.contains(action)
    _, reward, *_, info = env.step(action)
    assert info["base_reward"] == 0.0 and reward == pytest.approx(0.0, abs=1e-5), "nothing moved, and it was right"
    action["prediction"] = target + np.array([0.1, 0, 0, 0, 0, 0], np.float32)
    _, reward, *_, info = env.step(action)
    assert reward == pytest.approx(-1.0, abs=1e-4) and info["prediction"]["loss"] == pytest.approx(1.0, abs=1e-4)
    env.close()


def test_the_loss_of_a_pose():
    turned = Symmetries.none()
    loss, generator = PoseLoss(turned), torch.Generator().manual_seed(0)
    target = vector_of(se3.exp(0.5 * torch.randn(4, 6, dtype=torch.float64, generator=generator)))
    guess = (target + 0.1 * torch.randn(4, 6, dtype=torch.float64, generator=generator)).requires_grad_()
    assert loss(target, target).abs().max() < 1e-6
    assert torch.autograd.gradcheck(lambda one: loss(one, target), guess)
    assert np.allclose(loss(guess.detach().numpy(), target.numpy()), loss(guess, target).detach())


def test_a_vector_of_them_is_each_alone(cache):
    make_one = {"cache_dir": cache, "view": "particles", **SMALL}
    envs = gymnasium.make_vec("rumi/Mug-v0", num_envs=2, vectorization_mode="sync", **make_one)
    together, _ = envs.reset(seed=[3, 4])
    control = np.full((2, 3), 0.5, np.float32)
    further, *_ = envs.step(control)
    alone = make(cache=cache, view="particles")
    for row, seed in enumerate((3, 4)):
        first, _ = alone.reset(seed=seed)
        second, *_ = alone.step(control[row])
        for name in first:
            assert np.array_equal(together[name][row], first[name])
            assert np.array_equal(further[name][row], second[name])
    alone.close()
    envs.close()


def test_what_cannot_be_is_refused():
    with pytest.raises(UsageError, match="view"):
        gymnasium.make("rumi/Mug-v0", view="nothing")
    with pytest.raises(UsageError, match="which is another one"):
        gymnasium.make("rumi/Rummage-v0", task="peg")
