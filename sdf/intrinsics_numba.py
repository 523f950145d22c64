"""Compiler intrinsics for CPU kernels: reads, writes and conversions that keep a loop free of branches and of aliasing.

An innermost loop that reads and writes by these can become vector instructions. None checks its index.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic


def _reads(builder):
    """What tells the compiler that reads by `at` and writes by `put` never meet; without it no loop becomes vectors."""
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "rumi")])
    scope = module.add_metadata([ir.MetaDataString(module, "rumi.reads"), domain])
    return module.add_metadata([scope])


@intrinsic
def at(typingctx, array, index):
    """array[index] of a flat contiguous array that the kernel does not write to; the index must be within it."""

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0]).data
        loaded = builder.load(builder.gep(data, [arguments[1]]))
        loaded.set_metadata("alias.scope", _reads(builder))
        return loaded

    return array.dtype(array, index), generate


@intrinsic
def pair(typingctx, array, index):
    """array[index] and array[index + 1] of an array as `at` takes it; numbers of single precision by one load of both.

    Loads of a vector's numbers from anywhere take a time for each number, whatever its size.
    """

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0]).data
        place = builder.gep(data, [arguments[1]])
        number = place.type.pointee
        if number == ir.FloatType():
            both, half = ir.IntType(64), ir.IntType(32)
            loaded = builder.load(builder.bitcast(place, both.as_pointer()), align=4)
            loaded.set_metadata("alias.scope", _reads(builder))
            parts = loaded, builder.lshr(loaded, ir.Constant(both, 32))
            found = [builder.bitcast(builder.trunc(part, half), number) for part in parts]
        else:
            found = []
            for there in (place, builder.gep(place, [ir.Constant(ir.IntType(32), 1)])):
                found.append(builder.load(there))
                found[-1].set_metadata("alias.scope", _reads(builder))
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(array.dtype, 2)(array, index), generate


@intrinsic
def put(typingctx, array, index, value):
    """array[index] = value in a flat contiguous array that the kernel does not read; the index must be within it."""

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0]).data
        stored = builder.store(arguments[2], builder.gep(data, [arguments[1]]))
        stored.set_metadata("noalias", _reads(builder))
        return context.get_dummy_value()

    return types.void(array, index, array.dtype), generate


@intrinsic
def whole(typingctx, x):
    """A number not below 0 without its fraction, 32 bits."""

    def generate(context, builder, signature, arguments):
        return builder.fptosi(arguments[0], ir.IntType(32))

    return types.int32(x), generate


@intrinsic
def bits(typingctx, x):
    """The bits of a float as a whole number of as many: in the same order, of floats that are not below 0."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))

    return (types.int64 if x == types.float64 else types.int32)(x), generate


@intrinsic
def from_bits(typingctx, number, like):
    """The float of the kind of `like` that has these bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))

    return like(number, like), generate


@intrinsic
def node(typingctx, i, j, k, stride_i, stride_j):
    """Place of a node in a flat table: i * stride_i + j * stride_j + k in 32 bits."""

    def generate(context, builder, signature, arguments):
        i, j, k, stride_i, stride_j = arguments
        flags = ("nsw",)
        row = builder.add(builder.mul(i, stride_i, flags=flags), builder.mul(j, stride_j, flags=flags), flags=flags)
        return builder.add(row, k, flags=flags)

    return types.int32(i, j, k, stride_i, stride_j), generate


@intrinsic
def next_to(typingctx, index, stride):
    """Place of a neighbour: index + stride in 32 bits."""

    def generate(context, builder, signature, arguments):
        return builder.add(*arguments, flags=("nsw",))

    return types.int32(index, stride), generate
