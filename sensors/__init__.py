"""Measurements of a robot's sensors, and their likelihoods given the pose of an object.

    observation = sensors.view_observation(sensors.Image(depth, intrinsics, mask=mask), world_T_camera).observation
    contact = sensors.wrench_contact(wrench, tool, noise.covariance())

All other modules can be imported by name: `sensors.vision`, `sensors.force`, `sensors.touch`, `sensors.log`.
"""

from typing import TYPE_CHECKING

from sdf.public import lazily

if TYPE_CHECKING:
    from sensors.evidence import Evidence
    from sensors.force.force_torque import wrench_contact
    from sensors.observation import Observation
    from sensors.reading import Reading
    from sensors.semantics import Semantics, SemanticSensor
    from sensors.touch.bubble import bubble_patch
    from sensors.touch.contact_model import ContactModel
    from sensors.touch.touch_likelihood import touch_log_likelihoods
    from sensors.vision.cloud import cloud_observation
    from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation

__all__ = [
    "ContactModel",
    "Evidence",
    "Image",
    "KnownScene",
    "Observation",
    "Reading",
    "SemanticSensor",
    "Semantics",
    "ViewSettings",
    "bubble_patch",
    "cloud_observation",
    "touch_log_likelihoods",
    "view_observation",
    "wrench_contact",
]

__getattr__ = lazily(
    "sensors",
    {
        "ContactModel": "sensors.touch.contact_model",
        "Evidence": "sensors.evidence",
        "Image": "sensors.vision.view",
        "KnownScene": "sensors.vision.view",
        "Observation": "sensors.observation",
        "Reading": "sensors.reading",
        "SemanticSensor": "sensors.semantics",
        "Semantics": "sensors.semantics",
        "ViewSettings": "sensors.vision.view",
        "bubble_patch": "sensors.touch.bubble",
        "cloud_observation": "sensors.vision.cloud",
        "touch_log_likelihoods": "sensors.touch.touch_likelihood",
        "view_observation": "sensors.vision.view",
        "wrench_contact": "sensors.force.force_torque",
    },
)
