"""Records of four numbers, of a node or one number of four particles in a row, and pairs.

The functions on NumPy arrays are their definition; compiled, they are vector registers.
"""

import functools
import math
import operator
from typing import ClassVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

from mpmopt.kernels.compiler import inner_jit


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


@inner_jit
def tensor(array, k):
    """Records k to k + 3: the components of a tensor."""
    return load(array, k), load(array, k + 1), load(array, k + 2), load(array, k + 3)


@inner_jit
def store_tensor(array, k, x00, x01, x10, x11):
    """Write what `tensor` reads."""
    store(array, k, x00)
    store(array, k + 1, x01)
    store(array, k + 2, x10)
    store(array, k + 3, x11)


@inner_jit
def add(array, k, record):
    """Add to what `load` reads."""
    store(array, k, load(array, k) + record)


@inner_jit
def add_four(array, place, record):
    """Add to what `four` reads."""
    put_four(array, place, four(array, place) + record)


@inner_jit
def pair_of(array, a, b, lane):
    """The pair of one number each of records a and b of an array (M, 4)."""
    return pair(number(array, a, lane), number(array, b, lane))


@inner_jit
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


# An instruction that has flags gets none of the kernels' options.
FLAGS, ROUNDED = ("contract", "reassoc", "nsz", "arcp"), ("nsz",)
INT32 = ir.IntType(32)


def _compiled(definition, *ways):
    """Registers type and instructions of a function or an operator.

    What it decorates takes the types of the arguments, and returns a signature and what writes the
    instructions, or none. These stand where the call does: no function of its own is compiled.
    `ways` are the types of arguments that it is for; default: any.
    """

    def decorate(operation):
        @infer_global(definition)
        class Template(AbstractTemplate):
            # asked before what is for all targets
            metadata: ClassVar = {"target": "cpu"}  # type: ignore[misc]

            def generic(self, arguments, _):
                found = operation(*arguments)
                return found and found[0]

        def write(context, builder, signature, arguments):
            return operation(*signature.args)[1](context, builder, signature, arguments)

        for way in ways or [(types.VarArg(types.Any),)]:
            lower_builtin(definition, *way)(write)
        return operation

    return decorate


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


def _as(context, builder, value, of, kind):
    """A number or register as a register of some kind."""
    if not isinstance(of, Register):
        return _spread_out(context, builder, kind, context.cast(builder, value, of, kind.dtype))
    if of == kind:
        return value
    zeros = ir.Constant(_vector(of), None)
    lanes = [lane for k in range(of.lanes) for lane in (k, of.lanes + k)]
    return _shuffle(builder, value, zeros, lanes)


def _real_kind(kind):
    """Of the real parts of a register."""
    return Register(types.float64 if kind.dtype == types.complex128 else kind.dtype, kind.lanes)


def _real_parts(builder, record, vector):
    if record.dtype != types.complex128:
        return vector
    return _shuffle(builder, vector, vector, list(range(0, 2 * record.lanes, 2)))


def _all(builder, lanes):
    return functools.reduce(
        builder.and_, [builder.extract_element(lanes, INT32(k)) for k in range(4)]
    )


def _pointer(context, builder, array_type, array, place, kind):
    """To a number or register at a place of an array; the compiler need not look up strides."""
    array = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(array.data, [place]), kind.as_pointer())


def _record(builder, array, k):
    """The place of record or pair k in an array."""
    return builder.mul(k, k.type(_register(array).lanes))


@_compiled(number)
def _number(array, k, lane):
    def write(context, builder, signature, arguments):
        place = builder.add(_record(builder, array, arguments[1]), arguments[2])
        kind = context.get_data_type(array.dtype)
        return builder.load(_pointer(context, builder, array, arguments[0], place, kind))

    return array.dtype(array, types.intp, types.intp), write


@_compiled(set_number)
def _set_number(array, k, lane, value):
    def write(context, builder, signature, arguments):
        place = builder.add(_record(builder, array, arguments[1]), arguments[2])
        kind = context.get_data_type(array.dtype)
        builder.store(arguments[3], _pointer(context, builder, array, arguments[0], place, kind))
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, array.dtype), write


def _reads(kind, place_of):
    """What reads a register of a kind from the place of an array that a number k tells."""

    def operation(array, k):
        def write(context, builder, signature, arguments):
            place, vector = place_of(builder, array, arguments[1]), _vector(kind(array))
            pointer = _pointer(context, builder, array, arguments[0], place, vector)
            return builder.load(pointer, align=4)

        return kind(array)(array, types.intp), write

    return operation


def _writes(kind, place_of):
    """The same, of what writes it."""

    def operation(array, k, record):
        def write(context, builder, signature, arguments):
            place, vector = place_of(builder, array, arguments[1]), _vector(kind(array))
            pointer = _pointer(context, builder, array, arguments[0], place, vector)
            builder.store(arguments[2], pointer, align=4)
            return context.get_dummy_value()

        return types.none(array, types.intp, kind(array)), write

    return operation


def _of_four(array):
    """What `four` reads from an array."""
    return Register(array.dtype, 4)


def _itself(builder, array, place):
    return place


_compiled(load)(_reads(_register, _record))
_compiled(store)(_writes(_register, _record))
_compiled(four)(_reads(_of_four, _itself))
_compiled(put_four)(_writes(_of_four, _itself))


@_compiled(nothing)
def _nothing(array):
    kind = _register(array)
    return kind(array), lambda *_: ir.Constant(_vector(kind), None)


@_compiled(pack)
@_compiled(pair)
def _pack(*numbers):
    dtype = types.complex128 if types.complex128 in numbers else numbers[0]
    kind = Register(dtype, len(numbers))

    def write(context, builder, signature, arguments):
        pairs = zip(arguments, numbers, strict=True)
        values = [context.cast(builder, value, of, dtype) for value, of in pairs]
        return _filled(context, builder, kind, values)

    return kind(*numbers), write


@_compiled(real)
def _real(x):
    return _real_kind(x)(x), lambda _, builder, __, arguments: _real_parts(builder, x, *arguments)


@_compiled(whole)
def _whole(x):
    def write(context, builder, signature, arguments):
        vector = _vector(x)
        name = f"llvm.trunc.v4f{32 if x.dtype == types.float32 else 64}"
        kind = ir.FunctionType(vector, [vector])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return x(x), write


@_compiled(cell_coordinate)
def _cell_coordinate(x, per_dx):
    def write(context, builder, signature, arguments):
        value, scale = arguments
        half = ir.Constant(value.type, x.lanes * [0.5] if isinstance(x, Register) else 0.5)
        if isinstance(x, Register):
            scale = _as(context, builder, scale, per_dx, x)
        else:
            scale = context.cast(builder, scale, per_dx, x)
        cells = builder.fmul(value, scale, flags=ROUNDED)
        return builder.fsub(cells, half, flags=ROUNDED)

    return x(x, per_dx), write


@intrinsic
def _fused(typingctx, a, b, c):
    kind = types.float64 if types.float64 in (a, b, c) else a

    def generate(context, builder, signature, arguments):
        numbers = zip(arguments, signature.args, strict=True)
        return builder.fma(*(context.cast(builder, value, of, kind) for value, of in numbers))

    return kind(a, b, c), generate


@overload(fused)  # a function of its own: options would let the compiler take it apart
def _overload_fused(a, b, c):
    if types.complex128 in (a, b, c):
        return lambda a, b, c: complex(_fused(a.real, b.real, c.real), (a * b + c).imag)
    return lambda a, b, c: _fused(a, b, c)


@_compiled(within)
def _within(x, low, high):
    def write(context, builder, signature, arguments):
        bounds = zip(arguments[1:], (low, high), strict=True)
        least, most = (_as(context, builder, value, of, x) for value, of in bounds)
        inside = builder.fcmp_ordered("<=", least, arguments[0])
        return _all(builder, builder.and_(inside, builder.fcmp_ordered("<", arguments[0], most)))

    return types.boolean(x, low, high), write


def _extreme(symbol):
    def operation(x, y):
        def write(context, builder, signature, arguments):
            return builder.select(builder.fcmp_ordered(symbol, *arguments), *arguments)

        return x(x, y), write

    return operation


_compiled(least)(_extreme("<"))
_compiled(greatest)(_extreme(">"))


def _joined(x, y):
    """The register that a sum, difference or product is, of two registers or one and a number."""
    kind = x if isinstance(x, Register) else y
    complex_too = types.complex128 in (getattr(x, "dtype", x), getattr(y, "dtype", y))
    return Register(types.complex128, kind.lanes) if complex_too else kind


def _arithmetic(name, flags=FLAGS):
    """An operation with the name that LLVM has for it."""

    def operation(x, y):
        if not isinstance(x, Register) and not isinstance(y, Register):
            return None
        kind = _joined(x, y)

        def write(context, builder, signature, arguments):
            a = _as(context, builder, arguments[0], x, kind)
            b = _as(context, builder, arguments[1], y, kind)
            if kind.dtype != types.complex128 or name in ("fadd", "fsub"):
                return getattr(builder, name)(a, b, flags=flags)
            # (a.re + i a.im) b = a.re b + a.im (i b)
            re, im, turn = ([2 * k + place for k in range(kind.lanes) for place in pair]
                            for pair in ((0, 0), (1, 1), (1, 0)))  # fmt: skip
            turned = _shuffle(builder, b, b, turn)
            signs = ir.Constant(_vector(kind), kind.lanes * [-1.0, 1.0])
            turned = builder.fmul(turned, signs, flags=flags)
            real = builder.fmul(_shuffle(builder, a, a, re), b, flags=flags)
            imaginary = builder.fmul(_shuffle(builder, a, a, im), turned, flags=flags)
            return builder.fadd(real, imaginary, flags=flags)

        return kind(x, y), write

    return operation


WAYS = (Register, Register), (Register, types.Number), (types.Number, Register)
_compiled(operator.add, *WAYS)(_arithmetic("fadd"))
_compiled(operator.sub, *WAYS)(_arithmetic("fsub"))
_compiled(operator.mul, *WAYS)(_arithmetic("fmul"))
_compiled(product)(_arithmetic("fmul", ROUNDED))


@_compiled(operator.truediv, (Register, Register), (Register, types.Number))
def _divide(x, y):
    if isinstance(x, Register) and _joined(x, y).dtype != types.complex128:
        return _arithmetic("fdiv")(x, y)
    return None


@_compiled(reciprocal)
def _reciprocal(x):
    if x.dtype == types.complex128:
        return None

    def write(context, builder, signature, arguments):
        ones = ir.Constant(_vector(x), x.lanes * [1.0])
        return builder.fdiv(ones, arguments[0], flags=FLAGS)

    return x(x), write


@_compiled(operator.getitem, (Register, types.Integer))
def _lane(record, k):
    if not isinstance(record, Register):
        return None

    def write(context, builder, signature, arguments):
        lane = builder.trunc(arguments[1], INT32)
        if record.dtype != types.complex128:
            return builder.extract_element(arguments[0], lane)
        value = context.make_complex(builder, record.dtype)
        lane = builder.shl(lane, INT32(1))
        value.real = builder.extract_element(arguments[0], lane)
        value.imag = builder.extract_element(arguments[0], builder.add(lane, INT32(1)))
        return value._getvalue()

    return record.dtype(record, types.intp), write


@_compiled(total)
def _total(x):
    def write(context, builder, signature, arguments):
        parts = 2 if x.dtype == types.complex128 else 1
        sums = []
        for part in range(parts):
            places = [INT32(parts * k + part) for k in range(x.lanes)]
            numbers = [builder.extract_element(arguments[0], place) for place in places]
            while len(numbers) > 1:  # (0 + 1) + (2 + 3)
                neighbours = zip(numbers[::2], numbers[1::2], strict=True)
                numbers = [builder.fadd(a, b, flags=FLAGS) for a, b in neighbours]
            sums += numbers
        if parts == 1:
            return sums[0]
        value = context.make_complex(builder, x.dtype)
        value.real, value.imag = sums
        return value._getvalue()

    return x.dtype(x), write


@_compiled(above)
def _above(x, limit):
    kind = _real_kind(x)

    def write(context, builder, signature, arguments):
        value = _real_parts(builder, x, arguments[0])
        bound = _as(context, builder, arguments[1], limit, kind)
        return builder.uitofp(builder.fcmp_ordered(">", value, bound), _vector(kind))

    return kind(x, limit), write


@_compiled(chosen)
def _chosen(which, x, y):
    def write(context, builder, signature, arguments):
        mask = arguments[0]
        if x.dtype == types.complex128:
            mask = _shuffle(builder, mask, mask, [k // 2 for k in range(2 * x.lanes)])
        half = ir.Constant(mask.type, mask.type.count * [0.5])
        return builder.select(builder.fcmp_ordered(">", mask, half), *arguments[1:])

    return x(which, x, y), write


@_compiled(positive)
def _positive(record):
    def write(context, builder, signature, arguments):
        value = _real_parts(builder, record, arguments[0])
        zeros = ir.Constant(value.type, None)
        return _all(builder, builder.fcmp_ordered(">", value, zeros))

    return types.boolean(record), write


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


@inner_jit
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


@overload(reciprocal)
def _overload_reciprocal(x):
    return lambda x: pack(1.0 / x[0], 1.0 / x[1], 1.0 / x[2], 1.0 / x[3])


@overload(logarithm)
def _overload_logarithm(x):
    if x.dtype != types.complex128:
        return lambda x: _log(x)
    return lambda x: pack(np.log(x[0]), np.log(x[1]), np.log(x[2]), np.log(x[3]))
