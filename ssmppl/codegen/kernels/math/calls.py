"""Calls of compiled functions by their addresses, from Numba code.

What is called takes one pointer to 64-bit words, two for each argument: an array's address and the
length of its last axis, or a whole number; see `native/translate.py`.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic


@intrinsic
def address_of(typing, array):
    """Address of an array's first element; its rows have to stand one after the other."""
    if array.layout != "C":
        raise TypingError(f"{array} has gaps between its elements: hand over a contiguous one")

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(
            context, builder, value=arguments[0]
        ).data
        return builder.ptrtoint(data, ir.IntType(64))

    return types.int64(array), generate


@intrinsic
def invoke(typing, address, words):
    """Call the function at `address` with the address of `words`, a tuple of int64.

    The tuple lies on the stack: an array for it would cost more than a pass over few particles.
    """

    def generate(context, builder, signature, arguments):
        where = cgutils.alloca_once_value(builder, arguments[1])
        pointer = ir.IntType(64).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        builder.call(function, [builder.bitcast(where, pointer)])
        return context.get_dummy_value()

    return types.void(address, words), generate
