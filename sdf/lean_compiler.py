"""Lean compiler: numba's, less what it makes of functions that kernels alone call for others to call them.

The same passes give the same code of a kernel. What is left out is machine code of each function by itself, which
nobody runs, since the function is part of the kernel's; and the compiler's flags are not compared option by option.
"""

from typing import Any, ClassVar

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.environment import lookup_environment
from numba.core.typed_passes import NativeLowering


class _LinkedLibrary(JITCodeLibrary):
    """A library that is linked into those of kernels, and of which there is no machine code."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Lowering of a function that kernels alone call, to a library that is linked."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:  # noqa: ANN401  (numba comes without types)
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        known_by = object()  # in place of what Python would call
        state["cr"] = state["cr"]._replace(cfunc=known_by)
        state.targetctx.insert_user_function(known_by, state["cr"].fndesc, [state.library])
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _KernelLowering(NativeLowering):
    """Lowering of a kernel, which tells the functions in it their environments, as loading kept code does."""

    _name = "kernel_lowering"

    def run_pass(self, state: Any) -> bool:  # noqa: ANN401
        super().run_pass(state)
        for variable in state.library._final_module.global_variables:
            found = lookup_environment(variable.name)
            if found is not None:
                state.library.codegen.set_env(variable.name, found)
        return True


class _LeanCompiler(Compiler):
    """Numba's compiler with another lowering."""

    _lowering: type[NativeLowering]

    def define_pipelines(self) -> list[PassManager]:
        made = DefaultPassBuilder.define_nopython_pipeline(self.state)
        made.passes = [(self._lowering if one is NativeLowering else one, why) for one, why in made.passes]
        return [made]


class InnerCompiler(_LeanCompiler):
    """Compiler of a function that kernels alone call."""

    _lowering = _InnerLowering


class KernelCompiler(_LeanCompiler):
    """Compiler of a kernel."""

    _lowering = _KernelLowering


class _Flags(Flags):
    """Flags of the compiler, all copies of which are one object.

    Numba looks up what it knows by a copy of the flags, 10^4 times for the kernels of a run, and compares two that are
    not one object by all their options.
    """

    _copies: ClassVar[dict[str, "_Flags"]] = {}
    _hash: int | None = None  # of a copy, which nobody changes

    def copy(self) -> "_Flags":
        made = self._copies.setdefault(self.summary(), type(self)(self))
        made._hash = super().__hash__()
        return made

    def __hash__(self) -> int:
        return super().__hash__() if self._hash is None else self._hash

    def __eq__(self, other: object) -> bool:
        copies = self._hash is not None and isinstance(other, _Flags) and other._hash is not None
        return self is other if copies else bool(super().__eq__(other))


def quick_to_look_up(dispatcher: Any) -> Any:  # noqa: ANN401
    """A compiled function whose flags are quick to look up; itself."""
    dispatcher._compiler._customize_flags = _Flags
    return dispatcher
