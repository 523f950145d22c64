"""Registry of the kinds of evidence that a pose filter may count beside semantic points."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from rumi.registry import Table
from sdf.base import SDF
from sensors.evidence import EvidenceModel


@runtime_checkable
class EvidenceFactory(Protocol):
    """Makes the measurement model of one kind of evidence, such as `ContactPointModel.of`."""

    def of(self, sdf: SDF, surface: Float[Tensor, "n 3"]) -> EvidenceModel:
        """The model for an object, and for a tool with these points on its surface (tool frame, metres)."""
        ...


EVIDENCE = Table[EvidenceFactory]("evidence", "rumi.evidence")
EVIDENCE.add("contact-points", "rumi.belief.contact_evidence:ContactPointModel")
EVIDENCE.add("contact-signals", "rumi.belief.contact_evidence:ContactSignalModel")


def make_evidence(names: Sequence[str], sdf: SDF, surface: Float[Tensor, "n 3"]) -> tuple[EvidenceModel, ...]:
    """Measurement models by name, in that order.

    Args:
        names: of kinds of evidence, see `EVIDENCE`.
        sdf: of the object.
        surface: (n, 3), points on the tool's surface, tool frame, metres.

    Raises:
        UsageError: there is no such kind; the message lists those that there are.
    """
    return tuple(EVIDENCE[name].of(sdf, surface) for name in names)
