"""Records of four numbers, of a node or one number of four particles in a row, and pairs.

The functions on NumPy arrays are their definition; compiled, they are vector registers.
"""

import functools
import math
import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from mpmopt.kernels.compiler import jit


def load(array, k):
    """Record k of an array (M, 4), or pair k of a flat array."""
    return array[k].copy() if array.ndim == 2 else array[2 * k : 2 * k + 2].copy()


def nothing(array):
    """The zeros of what `load` reads from such an array."""
    return np.zeros(4 if array.ndim == 2 else 2, array.dtype)


def store(array, k, record):
    """Write what `load` reads."""
    if array.ndim == 2:
        array[k] = record
    else:
        array[2 * k : 2 * k + 2] = record


def four(array, place):
    """The record of four numbers from a place on, counted through an array without gaps."""
    return array.reshape(-1)[place : place + 4].copy()


def put_four(array, place, record):
    """Write what `four` reads."""
    array.reshape(-1)[place : place + 4] = record


def number(array, k, lane):
    """One number of record k of an array (M, 4)."""
    return array[k, lane]


def set_number(array, k, lane, value):
    """Write what `number` reads."""
    array[k, lane] = value


def pack(a, b, c, d):
    """The record of four numbers."""
    return np.array([a, b, c, d])


def pair(a, b):
    """The pair of two numbers."""
    return np.array([a, b])


def total(x):
    """The sum of the numbers of a record or pair."""
    return x.sum()


def positive(x):
    """Whether the real parts of a record are all above zero; what is not a number is not."""
    return bool(np.all(np.real(x) > 0.0))


def above(x, limit):
    """Which real parts of a record are above a number, as 1 and 0."""
    return (np.real(x) > limit).astype(float)


def chosen(which, x, y):
    """Of two records, numbers of x where `which` is 1, else of y."""
    return np.where(which > 0.5, x, y)


def reciprocal(x):
    """One over each number of a record."""
    return 1.0 / x


def logarithm(x):
    """The natural logarithms of a record of positive numbers."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(x)


def cell_coordinate(x, per_dx):
    """A coordinate in cells from the middle of the first one; its whole part is the first node.

    What decides, here and in `fused`, is rounded alike wherever it stands, forward and adjoint: no
    compiler may contract it into what is around it.
    """
    return per_dx * x - 0.5


def fused(a, b, c):
    """Number a b + c, whose real part is rounded once."""
    return a * b + c


def product(x, y):
    """x y of records, rounded by itself: no compiler may take it apart or contract it."""
    return x * y


def real(x):
    """The real parts of a record."""
    return np.real(x)


def whole(x):
    """The numbers of a real record without their fractions."""
    return np.trunc(x)


def within(x, low, high):
    """Whether low <= x < high for all of a real record; not if one is not a number."""
    return bool(np.all((low <= x) & (x < high)))


def least(x, y):
    """The smaller numbers of two real records."""
    return np.minimum(x, y)


def greatest(x, y):
    """The larger numbers of two real records."""
    return np.maximum(x, y)


@jit
def tensor(array, k):
    """Records k to k + 3: the components of a tensor."""
    return load(array, k), load(array, k + 1), load(array, k + 2), load(array, k + 3)


@jit
def store_tensor(array, k, x00, x01, x10, x11):
    """Write what `tensor` reads."""
    store(array, k, x00)
    store(array, k + 1, x01)
    store(array, k + 2, x10)
    store(array, k + 3, x11)


@jit
def add(array, k, record):
    """Add to what `load` reads."""
    store(array, k, load(array, k) + record)


@jit
def add_four(array, place, record):
    """Add to what `four` reads."""
    put_four(array, place, four(array, place) + record)


@jit
def pair_of(array, a, b, lane):
    """The pair of one number each of records a and b of an array (M, 4)."""
    return pair(number(array, a, lane), number(array, b, lane))


@jit
def add_number(array, k, lane, value):
    """Add to what `number` reads."""
    set_number(array, k, lane, number(array, k, lane) + value)


class Register(types.Type):
    """A record or a pair in a vector register; a complex number takes two of its places."""

    def __init__(self, dtype, lanes):
        self.dtype, self.lanes = dtype, lanes
        super().__init__(f"Register({dtype}, {lanes})")


@register_model(Register)
class RegisterModel(models.PrimitiveModel):
    """As a vector of LLVM."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, _vector(kind))


FLAGS = ("contract", "reassoc", "nsz", "arcp")
INT32 = ir.IntType(32)


def _vector(kind):
    """LLVM's type of a register."""
    number = ir.FloatType() if kind.dtype == types.float32 else ir.DoubleType()
    return ir.VectorType(number, kind.lanes * (2 if kind.dtype == types.complex128 else 1))


def _register(array):
    """What `load` reads from an array."""
    return Register(array.dtype, 4 if array.ndim == 2 else 2)


def _shuffle(builder, x, y, lanes):
    mask = ir.Constant(ir.VectorType(INT32, len(lanes)), lanes)
    return builder.shuffle_vector(x, y, mask)


def _parts(context, builder, dtype, value):
    """A number, or the parts of a complex one."""
    if dtype != types.complex128:
        return [value]
    value = context.make_complex(builder, dtype, value)
    return [value.real, value.imag]


def _filled(context, builder, kind, values):
    """The register of some numbers of its type."""
    vector = ir.Constant(_vector(kind), ir.Undefined)
    parts = [part for value in values for part in _parts(context, builder, kind.dtype, value)]
    for lane, value in enumerate(parts):
        vector = builder.insert_element(vector, value, INT32(lane))
    return vector


def _spread_out(context, builder, kind, value):
    """The register of so many times the same number."""
    parts = _parts(context, builder, kind.dtype, value)
    vector = ir.Constant(_vector(kind), ir.Undefined)
    for lane, part in enumerate(parts):
        vector = builder.insert_element(vector, part, INT32(lane))
    return _shuffle(builder, vector, vector, list(range(len(parts))) * kind.lanes)


def _pointer(context, builder, array_type, array, k, vector, lane=None):
    """To what `load` reads, or to one of its numbers; the compiler need not look up strides."""
    array = context.make_array(array_type)(context, builder, array)
    place = builder.mul(k, k.type(_register(array_type).lanes))
    if lane is not None:
        place = builder.add(place, lane)
    return builder.bitcast(builder.gep(array.data, [place]), vector.as_pointer())


@intrinsic
def _number(typingctx, array, k, lane):
    def generate(context, builder, signature, arguments):
        kind = context.get_data_type(array.dtype)
        return builder.load(_pointer(context, builder, array, *arguments[:2], kind, arguments[2]))

    return array.dtype(array, types.intp, types.intp), generate


@intrinsic
def _set_number(typingctx, array, k, lane, value):
    def generate(context, builder, signature, arguments):
        kind = context.get_data_type(array.dtype)
        pointer = _pointer(context, builder, array, *arguments[:2], kind, arguments[2])
        builder.store(arguments[3], pointer)
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, array.dtype), generate


@intrinsic
def _load(typingctx, array, k):
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, *arguments, _vector(kind))
        return builder.load(pointer, align=4)

    return kind(array, types.intp), generate


def _place(context, builder, array_type, array, place, vector):
    """To what `four` reads."""
    array = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(array.data, [place]), vector.as_pointer())


@intrinsic
def _four(typingctx, array, place):
    kind = Register(array.dtype, 4)

    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments, _vector(kind))
        return builder.load(pointer, align=4)

    return kind(array, types.intp), generate


@intrinsic
def _put_four(typingctx, array, place, record):
    kind = Register(array.dtype, 4)

    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments[:2], _vector(kind))
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, kind), generate


@intrinsic
def _nothing(typingctx, array):
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        return ir.Constant(_vector(kind), None)

    return kind(array), generate


@intrinsic
def _store(typingctx, array, k, record):
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, *arguments[:2], _vector(kind))
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, kind), generate


@intrinsic
def _pack(typingctx, numbers):
    dtype = types.complex128 if types.complex128 in numbers.types else numbers.types[0]
    kind = Register(dtype, len(numbers))

    def generate(context, builder, signature, arguments):
        values = cgutils.unpack_tuple(builder, arguments[0])
        values = [
            context.cast(builder, v, of, dtype) for v, of in zip(values, numbers.types, strict=True)
        ]
        return _filled(context, builder, kind, values)

    return kind(numbers), generate


@intrinsic
def _as(typingctx, x, like):
    """A number or register as a register that can be combined with another one, or a number."""
    kind = x if isinstance(x, Register) else like
    if types.complex128 in (getattr(x, "dtype", x), getattr(like, "dtype", like)):
        kind = Register(types.complex128, kind.lanes)

    def generate(context, builder, signature, arguments):
        value = arguments[0]
        if not isinstance(x, Register):
            value = context.cast(builder, value, x, kind.dtype)
            return _spread_out(context, builder, kind, value)
        if x == kind:
            return value
        zeros = ir.Constant(_vector(x), None)
        lanes = [lane for k in range(x.lanes) for lane in (k, x.lanes + k)]
        return _shuffle(builder, value, zeros, lanes)

    return kind(x, like), generate


def _real_parts(builder, record, vector):
    if record.dtype != types.complex128:
        return vector
    return _shuffle(builder, vector, vector, list(range(0, 2 * record.lanes, 2)))


def _all(builder, lanes):
    return functools.reduce(
        builder.and_, [builder.extract_element(lanes, INT32(k)) for k in range(4)]
    )


@intrinsic
def _real(typingctx, x):
    dtype = types.float64 if x.dtype == types.complex128 else x.dtype

    def generate(context, builder, signature, arguments):
        return _real_parts(builder, x, arguments[0])

    return Register(dtype, x.lanes)(x), generate


@intrinsic
def _whole(typingctx, x):
    def generate(context, builder, signature, arguments):
        vector = _vector(x)
        name = f"llvm.trunc.v4f{32 if x.dtype == types.float32 else 64}"
        kind = ir.FunctionType(vector, [vector])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return x(x), generate


@intrinsic
def _cell_coordinate(typingctx, x, per_dx):
    def generate(context, builder, signature, arguments):
        kind = arguments[0].type
        half = ir.Constant(kind, x.lanes * [0.5] if isinstance(x, Register) else 0.5)
        per_dx_ = arguments[1] if per_dx == x else context.cast(builder, arguments[1], per_dx, x)
        # Having a flag, these get none of the options', which would let them be contracted.
        cells = builder.fmul(arguments[0], per_dx_, flags=("nsz",))
        return builder.fsub(cells, half, flags=("nsz",))

    return x(x, per_dx), generate


@intrinsic
def _fused(typingctx, a, b, c):
    kind = types.float64 if types.float64 in (a, b, c) else a

    def generate(context, builder, signature, arguments):
        numbers = zip(arguments, signature.args, strict=True)
        return builder.fma(*(context.cast(builder, value, of, kind) for value, of in numbers))

    return kind(a, b, c), generate


@intrinsic
def _within(typingctx, x, low, high):
    def generate(context, builder, signature, arguments):
        above = builder.fcmp_ordered("<=", arguments[1], arguments[0])
        below = builder.fcmp_ordered("<", arguments[0], arguments[2])
        return _all(builder, builder.and_(above, below))

    return types.boolean(x, low, high), generate


def _extreme(symbol):
    @intrinsic
    def extreme(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            return builder.select(builder.fcmp_ordered(symbol, *arguments), *arguments)

        return x(x, y), generate

    return extreme


_least, _greatest = _extreme("<"), _extreme(">")


def _arithmetic(name):
    @intrinsic
    def operate(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            a, b = arguments
            if x.dtype != types.complex128 or name in ("fadd", "fsub"):
                return getattr(builder, name)(a, b, flags=FLAGS)
            # (a.re + i a.im) b = a.re b + a.im (i b)
            re, im, turn = ([2 * k + place for k in range(x.lanes) for place in pair] for pair in (
                (0, 0), (1, 1), (1, 0)
            ))  # fmt: skip
            turned = _shuffle(builder, b, b, turn)
            signs = ir.Constant(_vector(x), x.lanes * [-1.0, 1.0])
            turned = builder.fmul(turned, signs, flags=FLAGS)
            real = builder.fmul(_shuffle(builder, a, a, re), b, flags=FLAGS)
            imaginary = builder.fmul(_shuffle(builder, a, a, im), turned, flags=FLAGS)
            return builder.fadd(real, imaginary, flags=FLAGS)

        return x(x, x), generate

    return operate


def _overload_arithmetic(symbol, name):
    operate = _arithmetic(name)

    @overload(symbol)
    def arithmetic(x, y):
        if isinstance(x, Register) or isinstance(y, Register):
            return lambda x, y: operate(_as(x, y), _as(y, x))


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
):
    _overload_arithmetic(_symbol, _name)


@intrinsic
def _divide(typingctx, x, y):
    def generate(context, builder, signature, arguments):
        return builder.fdiv(*arguments, flags=FLAGS)

    return x(x, x), generate


@overload(operator.truediv)
def _overload_divide(x, y):
    if isinstance(x, Register) and types.complex128 not in (x.dtype, getattr(y, "dtype", y)):
        return lambda x, y: _divide(x, _as(y, x))


@intrinsic
def _product(typingctx, x, y):
    def generate(context, builder, signature, arguments):
        return builder.fmul(*arguments, flags=("nsz",))

    return x(x, y), generate


@intrinsic
def _lane(typingctx, record, k):
    def generate(context, builder, signature, arguments):
        lane = builder.trunc(arguments[1], INT32)
        if record.dtype != types.complex128:
            return builder.extract_element(arguments[0], lane)
        value = context.make_complex(builder, record.dtype)
        lane = builder.shl(lane, INT32(1))
        value.real = builder.extract_element(arguments[0], lane)
        value.imag = builder.extract_element(arguments[0], builder.add(lane, INT32(1)))
        return value._getvalue()

    return record.dtype(record, types.intp), generate


@overload(operator.getitem)
def _getitem(record, k):
    if isinstance(record, Register):
        return lambda record, k: _lane(record, k)


@intrinsic
def _above(typingctx, x, limit):
    kind = Register(types.float64 if x.dtype == types.complex128 else x.dtype, x.lanes)

    def generate(context, builder, signature, arguments):
        value = _real_parts(builder, x, arguments[0])
        truth = builder.fcmp_ordered(">", value, arguments[1])
        return builder.uitofp(truth, _vector(kind))

    return kind(x, limit), generate


@intrinsic
def _chosen(typingctx, which, x, y):
    def generate(context, builder, signature, arguments):
        mask = arguments[0]
        if x.dtype == types.complex128:
            mask = _shuffle(builder, mask, mask, [k // 2 for k in range(2 * x.lanes)])
        half = ir.Constant(mask.type, mask.type.count * [0.5])
        return builder.select(builder.fcmp_ordered(">", mask, half), *arguments[1:])

    return x(which, x, y), generate


@intrinsic
def _positive(typingctx, record):
    def generate(context, builder, signature, arguments):
        value = _real_parts(builder, record, arguments[0])
        zeros = ir.Constant(value.type, None)
        return _all(builder, builder.fcmp_ordered(">", value, zeros))

    return types.boolean(record), generate


@intrinsic
def _exponent_and_fraction(typingctx, record):
    """x = 2^k m with m from sqrt(1/2) to sqrt(2): the records of k and m."""
    result = types.UniTuple(record, 2)
    single = record.dtype == types.float32
    width, fraction, bias = (32, 23, 127) if single else (64, 52, 1023)
    numbers = np.float32 if single else np.float64

    def generate(context, builder, signature, arguments):
        integers = ir.VectorType(ir.IntType(width), 4)

        def constant(value):
            return ir.Constant(integers, 4 * [value])

        def bits_of(number):
            return int(numbers(number).view(np.int32 if single else np.int64))

        bits = builder.bitcast(arguments[0], integers)
        shifted = builder.add(bits, constant(bits_of(1.0) - bits_of(0.5**0.5)))
        exponent = builder.lshr(shifted, constant(fraction))
        power = builder.shl(exponent, constant(fraction))
        m = builder.sub(builder.add(bits, constant(bits_of(1.0))), power)
        short = ir.VectorType(INT32, 4)  # processors convert no longer integers in a register
        k = exponent if single else builder.trunc(exponent, short)
        k = builder.sitofp(builder.sub(k, ir.Constant(short, 4 * [bias])), _vector(record))
        return context.make_tuple(builder, result, [k, builder.bitcast(m, _vector(record))])

    return result(record), generate


@jit
def _log(x):
    """ln x = k ln 2 + 2 artanh(s), s = (m - 1) / (m + 1), where x = 2^k m; |s| < 0.1716."""
    k, m = _exponent_and_fraction(x)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    odd = 1.0 / 25.0 + z2 * 0.0
    even = 1.0 / 23.0 + z2 * 0.0
    for power in (21.0, 17.0, 13.0, 9.0, 5.0):
        odd = 1.0 / power + z2 * odd
    for power in (19.0, 15.0, 11.0, 7.0, 3.0):
        even = 1.0 / power + z2 * even
    series = even + z * odd  # 1/3 + z/5 + z^2/7 + ...
    return k * LN2 + (2.0 * s + 2.0 * s * z * series)


LN2 = math.log(2.0)


@overload(load)
def _overload_load(array, k):
    return lambda array, k: _load(array, k)


@overload(nothing)
def _overload_nothing(array):
    return lambda array: _nothing(array)


@overload(store)
def _overload_store(array, k, record):
    return lambda array, k, record: _store(array, k, record)


@overload(four)
def _overload_four(array, place):
    return lambda array, place: _four(array, place)


@overload(put_four)
def _overload_put_four(array, place, record):
    return lambda array, place, record: _put_four(array, place, record)


@overload(number)
def _overload_number(array, k, lane):
    return lambda array, k, lane: _number(array, k, lane)


@overload(set_number)
def _overload_set_number(array, k, lane, value):
    return lambda array, k, lane, value: _set_number(array, k, lane, value)


@overload(pair)
def _overload_pair(a, b):
    return lambda a, b: _pack((a, b))


@overload(pack)
def _overload_pack(a, b, c, d):
    return lambda a, b, c, d: _pack((a, b, c, d))


@overload(total)
def _overload_total(x):
    if x.lanes == 2:
        return lambda x: x[0] + x[1]
    return lambda x: (x[0] + x[1]) + (x[2] + x[3])


@overload(real)
def _overload_real(x):
    return lambda x: _real(x)


@overload(whole)
def _overload_whole(x):
    return lambda x: _whole(x)


@overload(cell_coordinate)
def _overload_cell_coordinate(x, per_dx):
    if isinstance(x, Register):
        return lambda x, per_dx: _cell_coordinate(x, _as(per_dx, x))
    return lambda x, per_dx: _cell_coordinate(x, per_dx)


@overload(fused)
def _overload_fused(a, b, c):
    if types.complex128 in (a, b, c):
        return lambda a, b, c: complex(_fused(a.real, b.real, c.real), (a * b + c).imag)
    return lambda a, b, c: _fused(a, b, c)


@overload(product)
def _overload_product(x, y):
    if types.complex128 in (x.dtype, y.dtype):
        return lambda x, y: x * y
    return lambda x, y: _product(x, y)


@overload(within)
def _overload_within(x, low, high):
    return lambda x, low, high: _within(x, _as(low, x), _as(high, x))


@overload(least)
def _overload_least(x, y):
    return lambda x, y: _least(x, y)


@overload(greatest)
def _overload_greatest(x, y):
    return lambda x, y: _greatest(x, y)


@overload(above)
def _overload_above(x, limit):
    return lambda x, limit: _above(x, _as(limit, real(x)))


@overload(chosen)
def _overload_chosen(which, x, y):
    return lambda which, x, y: _chosen(which, x, y)


@overload(positive)
def _overload_positive(x):
    return lambda x: _positive(x)


@overload(reciprocal)
def _overload_reciprocal(x):
    if x.dtype != types.complex128:
        return lambda x: _divide(_as(1.0, x), x)
    return lambda x: _pack((1.0 / x[0], 1.0 / x[1], 1.0 / x[2], 1.0 / x[3]))


@overload(logarithm)
def _overload_logarithm(x):
    if x.dtype != types.complex128:
        return lambda x: _log(x)
    return lambda x: _pack((np.log(x[0]), np.log(x[1]), np.log(x[2]), np.log(x[3])))
