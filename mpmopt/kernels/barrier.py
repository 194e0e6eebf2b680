"""Where threads that share a step wait for each other."""

import sys

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from mpmopt.kernels.simd import INT32


def meet(barrier_state, threads):
    """Wait until all threads are here; whether they came, and none gave up."""
    return True


def _place(context, builder, array_type, array, k):
    """To number k of a flat array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [k])


@intrinsic
def _atomic_add(typingctx, array, k, amount):
    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments[:2])
        return builder.atomic_rmw("add", pointer, arguments[2], "seq_cst")

    return types.int64(array, types.intp, types.int64), generate


@intrinsic
def _atomic_load(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments)
        return builder.load_atomic(pointer, "seq_cst", align=8)

    return types.int64(array, types.intp), generate


# Turns of waiting before the processor is left to others, should they be more than processors.
TURNS = 500


@intrinsic
def _give_way(typingctx):
    name = "SwitchToThread" if sys.platform == "win32" else "sched_yield"

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(INT32, [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [])
        return context.get_dummy_value()

    return types.none(), generate


@overload(meet)
def _overload_meet(barrier_state, threads):
    # Threads at this meeting in meeting[0], meetings so far in [8], whether one gave up in [16].
    def implementation(barrier_state, threads):
        if threads == 1:
            return True
        before = _atomic_load(barrier_state, 8)
        if _atomic_add(barrier_state, 0, 1) == threads - 1:
            _atomic_add(barrier_state, 0, -threads)
            _atomic_add(barrier_state, 8, 1)
            return True
        turns = 0
        while _atomic_load(barrier_state, 8) == before:
            turns += 1
            if turns > TURNS:
                if _atomic_load(barrier_state, 16) != 0:
                    return False
                _give_way()
        return True

    return implementation
