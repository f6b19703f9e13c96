"""Calls of compiled functions by their addresses, from Numba code.

What is called takes one pointer to 64-bit words, two for each argument: an array's address and the
length of its last axis, or a whole number; see `native/translate.py`.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def address_of(typing, array):
    """Address of an array's first element."""

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(
            context, builder, value=arguments[0]
        ).data
        return builder.ptrtoint(data, ir.IntType(64))

    return types.int64(array), generate


@intrinsic
def invoke(typing, address, words):
    """Call the function at `address` with the address of `words`, an array of int64."""

    def generate(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[1])(
            context, builder, value=arguments[1]
        ).data
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64).as_pointer()])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [data])
        return context.get_dummy_value()

    return types.void(address, words), generate


def no_prediction(theta, y, seen, u, t, x, w, rng, out):
    """Stands where a filter makes no predictions, and is never called."""


WORD = np.int64
