"""A push model as a package from outside would bring it: found by an entry point, in no row of the table."""

from dataclasses import replace
from typing import Any, Self

from rumi.dynamics.quasi_static import QuasiStaticPush


class RoughPush(QuasiStaticPush):
    """The quasi-static model of a rougher tool."""

    @classmethod
    def make(cls, settings: Any) -> Self:
        return cls(replace(settings.quasi_static, friction=0.8))
