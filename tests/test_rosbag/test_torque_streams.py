"""Joint torques in a bag: when the hand was pushed, and what is named where something lacks."""

import math

import numpy as np
import pytest
import torch

from rumi.belief.contact_evidence import SignalSettings
from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.scene import contact_models, rummager_of_map, settings_of
from rumi.runs.replay import replay
from sensors.semantics import Semantics
from sensors.touch.contact_model import robot_distance

pytestmark = pytest.mark.sim

TORQUES = """
schema = 1
[topics]
"/joint_states" = "torques"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "box"
within = [[-1, -1, -1], [1, 1, 1]]
prior_mean_m = [0.5, 0.0]
[robot]
file = "ROBOT"
[torques]
threshold_nm = 1.0
rest_s = 0.3
[actions]
view_s = 0.3
every_s = 0.4
instants = 4
"""


@pytest.fixture(scope="module")
def pushed_arm(bags, tmp_path_factory):
    """An arm that holds itself under gravity while its hand is pushed from 0.7 s to 0.9 s; its bag and its model."""
    import mujoco

    from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, arm_xml

    folder = tmp_path_factory.mktemp("arm")
    model = mujoco.MjModel.from_xml_string(arm_xml(ArmPhysics()))
    (folder / "arm.xml").write_text(arm_xml(ArmPhysics()))
    data = mujoco.MjData(model)
    place = [model.joint(name).qposadr[0] for name in ARM_JOINTS]
    dof = [model.joint(name).dofadr[0] for name in ARM_JOINTS]
    data.qpos[place] = target = np.array([0.1, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0])
    hand = model.body("tool").id
    maker = bags.Maker(folder / "bag")
    for step in range(1500):
        mujoco.mj_forward(model, data)
        wave = 0.1 * math.sin(2.0 * step / 1000) * np.ones(7)
        data.ctrl[:7] = 400 * (target + wave - data.qpos[place]) - 40 * data.qvel[dof] + data.qfrc_bias[dof]
        data.xfrc_applied[hand, :3] = (0.0, 15.0, 0.0) if 700 <= step < 900 else 0.0
        stamp = bags.START + step * bags.SECOND // 1000
        if step % 2 == 0:
            # in another order, with a joint that the arm does not have
            maker.joints(
                "/joint_states",
                stamp,
                ["gripper", *reversed(ARM_JOINTS)],
                [0.0, *data.qpos[place][::-1]],
                effort=[0.0, *data.ctrl[:7][::-1]],
                velocity=[0.0, *data.qvel[dof][::-1]],
            )
        if step % 100 == 0 or step == 1499:
            maker.tf(stamp, "base", "gripper", torch.eye(4))
        mujoco.mj_step(model, data)
    return maker.close(), folder / "arm.xml"


def told(pushed_arm, **changes):
    from rumi.sim.arm_scene import ARM_JOINTS

    _, model = pushed_arm
    joints = ", ".join(f'"{name}"' for name in ARM_JOINTS)
    text = TORQUES.replace("ROBOT", str(model)).replace("rest_s = 0.3", f"rest_s = 0.3\njoints = [{joints}]")
    for old, new in changes.items():
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def torques(pushed_arm, bags, tmp_path_factory):
    """Readings of its bag."""
    return bags.readings_of(pushed_arm[0], told(pushed_arm), tmp_path_factory.mktemp("torques") / "log.h5")


def test_joint_torques_of_a_bag_tell_when_the_hand_was_pushed(torques):
    made = torques
    assert made.problems == []
    assert "samples beyond 1 N m" in made.notes[0]
    touched = torch.cat([one.reading.in_contact for one in made.taken[1:]])
    ends = 0.3 + 0.1 * torch.arange(1, len(touched) + 1)
    # a residual of gain 25 goes on for a while after the push
    assert touched[(ends > 0.75) & (ends < 0.95)].all()
    assert not touched[(ends < 0.7) | (ends > 1.15)].any()


def test_signals_count_as_touches_of_some_point_of_the_gripper(pushed_arm, torques, bags, tmp_path):
    """A box that may be anywhere nearby is at the gripper when its arm was pushed; a flag alone does not say so."""
    text = told(pushed_arm).replace("prior_mean_m = [0.5, 0.0]", "prior_mean_m = [0.1, 0.0]\nprior_spread_m = 0.08")
    text += "[settings]\nfilter.motion = 'sticking'\nstop.rule = 'never'\ninitialise = { particles = 80 }\n"
    likely = text.replace("[torques]", "[torques]\nlikelihood = true\nmost = 3")
    far = {}
    for name, one in (("flags", text), ("signals", likely)):
        mapping, made = mapping_of(one), bags.readings_of(pushed_arm[0], one, tmp_path / f"{name}.h5")
        for ours, theirs in zip(made.taken[1:], torques.taken[1:], strict=True):
            assert torch.equal(ours.reading.in_contact, theirs.reading.in_contact)
            assert torch.equal(ours.reading.observation.points, theirs.reading.observation.points)
            if name == "signals":
                assert torch.equal(ours.reading.signals, ours.reading.in_contact)
        places = torch.cat([taken.reading.tool_pose[:, :3, 3] for taken in made.taken])
        rummager = rummager_of_map(mapping, settings_of(mapping), places)
        belief = replay(made.taken, rummager, seed=1000).last.belief
        _, signals = contact_models(mapping_of(likely), rummager.model.sdf)
        assert signals.signals == SignalSettings(most=3) and (rummager.filter.further == ()) == (name == "flags")
        distance = robot_distance(rummager.model.sdf, belief.world_T_object, signals.surface[None])[..., 0]
        far[name] = float((belief.weights * distance.clamp_min(0.0)).sum())
        assert (belief.evidence is None) == (name == "flags")
    assert far["signals"] < 0.5 * far["flags"], far


def test_a_model_whose_meshes_lie_beside_it(pushed_arm, torques, bags, tmp_path):
    """As an MJCF's do, from wherever the replay is started."""
    import trimesh

    bag, model = pushed_arm
    (tmp_path / "assets").mkdir()
    trimesh.creation.box((0.01, 0.01, 0.01)).export(tmp_path / "assets" / "mark.stl")
    text = model.read_text().replace("<worldbody>", '<worldbody><geom type="mesh" mesh="mark"/>', 1)
    assert "<asset" not in text  # the one of the mesh is all there will be
    mesh = '<asset><mesh name="mark" file="assets/mark.stl"/></asset>'
    (tmp_path / "arm.xml").write_text(text.replace("<worldbody>", f"{mesh}<worldbody>", 1))
    made = bags.readings_of(bag, told((bag, tmp_path / "arm.xml")), tmp_path / "log.h5")
    assert made.notes == torques.notes


def test_a_touch_that_nobody_knows_the_place_of_leaves_no_free_space(torques):
    made = torques
    for one in made.taken[1:]:
        reading = one.reading
        for k in reading.in_contact.nonzero()[:, 0].tolist():
            assert not (reading.instant == k).any()
    assert sum(int(one.reading.observation.of_class(Semantics.FREE).sum()) for one in made.taken) > 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"joint_1", ', '"shoulder", ', "Expected the joint 'shoulder' in joint_states, which has gripper, joint_7"),
        ("arm.xml", "none.xml", "Cannot read robot.file .*none.xml"),
        ("[torques]\nthreshold_nm = 1.0", "[settings]", r"Expected tables \[torques\] and \[robot\]"),
        ("threshold_nm = 1.0", "threshold_nm = -1.0", "Expected threshold_nm above 0"),
        (
            "threshold_nm = 1.0",
            "threshold_nm = 1.0\ntrue_positive = 0.01",
            "Expected true_positive above",
        ),
        ("threshold_nm = 1.0", "threshold_nm = 1.0\ndecay = 0.0", r"Expected decay in \(0, 1e\+06\)"),
        ("threshold_nm = 1.0", "threshold_nm = 1.0\nspacing_m = 0.0", r"Expected spacing_m in \[0.001, 1\]"),
    ],
)
def test_what_torques_lack_is_named(pushed_arm, bags, tmp_path, old, new, message):
    text = told(pushed_arm).replace(old, new)
    if new == "[settings]":
        text = text.split("[settings]")[0] + "[actions]" + text.split("[actions]")[1]
    with pytest.raises(UsageError, match=message):
        bags.readings_of(pushed_arm[0], text, tmp_path / "log.h5")
