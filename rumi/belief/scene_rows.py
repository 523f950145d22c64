"""Some scenes of a batch: what one scene needs is done for it alone, as if it were by itself."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.seeding import Generators


def differ(rows: Bool[Tensor, "*b"], generator: Generators) -> bool:
    """Whether some scenes of a batch differ from the others, and draws can be made for them alone."""
    single = isinstance(generator, torch.Generator)
    return rows.ndim > 0 and (single or rows.ndim == 1) and not bool(rows.all())


def generators_of(generator: Generators, rows: Bool[Tensor, "*b"]) -> Generators:
    """The generators of the scenes `rows`; one for all is theirs too."""
    if isinstance(generator, torch.Generator):
        return generator
    return [one for one, kept in zip(generator, rows.tolist(), strict=True) if kept]


def bare(belief: PoseBelief) -> PoseBelief:
    """The belief without its evidence, whose tensors may be of all scenes at once."""
    return replace(belief, evidence=None)


def put(values: Tensor, rows: Bool[Tensor, "*b"], some: Tensor) -> Tensor:
    """The values of a batch with those of the scenes `rows` replaced; gradients go to both."""
    return values.index_put((rows,), some)


def put_rows(belief: PoseBelief, rows: Bool[Tensor, "*b"], some: PoseBelief) -> PoseBelief:
    """The belief with the particles of the scenes `rows` replaced."""
    return replace(
        belief,
        attached_T_object=put(belief.attached_T_object, rows, some.attached_T_object),
        log_weights=put(belief.log_weights, rows, some.log_weights),
        discrepancy=put(belief.discrepancy, rows, some.discrepancy),
    )


def where_rows(rows: Bool[Tensor, "*b"], a: PoseBelief, b: PoseBelief) -> PoseBelief:
    """Particles of a in the scenes `rows`, of b in the others."""
    return replace(
        b,
        attached_T_object=torch.where(rows[..., None, None, None], a.attached_T_object, b.attached_T_object),
        log_weights=torch.where(rows[..., None], a.log_weights, b.log_weights),
        discrepancy=torch.where(rows[..., None], a.discrepancy, b.discrepancy),
    )
